"""Equations of an error-state Kalman filter on an IMU, 15 states (Solà 2017, arXiv:1711.02508, sections 5.4 and 6).

    nominal   [p, q, v, b_a, b_g]                 16 numbers: world, body to world, world, body, body
    error     [dp, dv, dtheta, db_a, db_g]        15: x_true = x + dx, and q_true = q o Exp(dtheta), dtheta in body axes

Over an IMU interval h with the reading [a_m, w_m], phi = (w_m - b_g) h, u = (a_m - b_a) h in the axes of its middle:

    q' = q o Exp(phi)      v' = v + dv_R,  dv_R = R(q o Exp(phi / 2)) u + g h      p' = p + v h + dv_R h / 2
    P' = F P F' + Q

F is the derivative of this step, exact to first order in the error; Q holds the IMU's white noise and the random walks
of its biases. A fix comes in number by number: innovation z with the derivative H and the variance r,

    K = P H' / (H P H' + r),   dx += K (z - H dx),   P -= K H P

which for independent numbers is the joint update, without a matrix to invert. Then dx goes into the nominal state, and
P into the axes of the new attitude, by I - [dtheta]x / 2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression, symbols, unit
from quadexp.physics.rotation import along_z, exponential, product, rotation_matrix
from quadexp.physics.state import ATTITUDE, POSITION, VELOCITY
from quadexp.plugins.worlds.inertial import N_DENSITIES, N_READING, Aid
from quadexp.plugins.worlds.rotation_vector import cross_matrix, right_jacobian

N_NOMINAL = 16  # position, velocity, attitude (4 numbers), two biases of 3
N_ERROR = 15  # the same with 3 numbers of the attitude
# Of the nominal state; the others as in physics/state.
ACCELEROMETER_BIAS = slice(10, 13)
GYROSCOPE_BIAS = slice(13, 16)
PLACES = D_POSITION, D_VELOCITY, D_ATTITUDE, _, _ = tuple(range(i, i + 3) for i in range(0, N_ERROR, 3))
N_COVARIANCE = N_ERROR * (N_ERROR + 1) // 2  # numbers of the upper triangle
PARTS = [0, 3, 6, 9, 12, 15]  # where position, velocity, attitude and the two biases begin, and the end
N_KNOWN = N_NOMINAL + N_COVARIANCE  # nominal state and covariance


def propagate(
    nominal: Expression, reading: Expression, duration: Expression, gravity: Expression
) -> tuple[Expression, Callable[[Expression], Expression]]:
    """The nominal state (16,) after an IMU interval, and d -> F d, which acts on errors (15, k).

    reading: [a_m (m/s^2), w_m (rad/s)], (6,). duration: s. gravity: m/s^2, downwards.
    """
    p = nominal[POSITION]
    q = nominal[ATTITUDE]
    v = nominal[VELOCITY]
    u = (reading[:3] - nominal[ACCELEROMETER_BIAS]) * duration
    phi = (reading[3:] - nominal[GYROSCOPE_BIAS]) * duration
    half = exponential(phi / 2)
    turned_half = product(q, half)
    middle = rotation_matrix(turned_half)
    pushed = middle @ u
    gained = pushed + along_z(-gravity * duration)
    after = ca.vertcat(p + duration * v + duration / 2 * gained, product(turned_half, half), v + gained)

    by_attitude = -(cross_matrix(pushed) @ rotation_matrix(q))
    by_gyroscope = middle @ cross_matrix(u) @ right_jacobian(phi / 2) * (duration / 2)
    by_force = middle * duration
    turn = rotation_matrix(product(half, half)).T
    turn_by_gyroscope = -right_jacobian(phi) * duration

    def transition(d: Expression) -> Expression:
        dp, dv, turned, of_force, of_rate = ca.vertsplit(d, PARTS)
        gain = by_attitude @ turned - by_force @ of_force + by_gyroscope @ of_rate
        return ca.vertcat(
            dp + duration * dv + duration / 2 * gain,
            dv + gain,
            turn @ turned + turn_by_gyroscope @ of_rate,
            of_force,
            of_rate,
        )

    return ca.vertcat(after, nominal[10:]), transition


def predict(
    nominal: Expression,
    covariance: Expression,
    reading: Expression,
    duration: Expression,
    gravity: Expression,
    densities: Expression,
) -> tuple[Expression, Expression]:
    """Nominal state (16,) and covariance (15, 15), symmetric, after an IMU interval; see `propagate`.

    densities: of the IMU's noise, see quadexp.plugins.worlds.inertial.
    """
    after, transition = propagate(nominal, reading, duration, gravity)
    spread = transition(transition(covariance).T)
    force, rate, force_walk, rate_walk = (densities[i] ** 2 * duration for i in range(4))
    for dp, dv, turned, of_force, of_rate in zip(*PLACES, strict=True):
        spread[dp, dp] += force * duration**2 / 4
        spread[dv, dp] += force * duration / 2
        spread[dv, dv] += force
        spread[turned, turned] += rate
        spread[of_force, of_force] += force_walk
        spread[of_rate, of_rate] += rate_walk
    return after, ca.tril2symm(ca.tril(spread))  # below the diagonal the biases' rows are there after one transition


def update(
    nominal: Expression,
    covariance: Expression,
    innovations: Sequence[tuple[Expression, dict[int, Expression], Expression]],
) -> tuple[Expression, Expression]:
    """Nominal state and covariance after a fix.

    innovations: each its value, its derivative by the error state as {index: coefficient}, and its variance.
    """
    d = type(covariance).zeros(N_ERROR)
    for value, row, variance in innovations:
        PH = sum(coefficient * covariance[:, i] for i, coefficient in row.items())
        seen = sum(coefficient * PH[i] for i, coefficient in row.items())
        predicted = sum(coefficient * d[i] for i, coefficient in row.items())
        gain = PH * (1 / (seen + variance))
        d = d + gain * (value - predicted)
        covariance = ca.triu2symm(ca.triu(covariance - gain @ PH.T))
    return inject(nominal, d), reset(covariance, d)


def inject(nominal: Expression, d: Expression) -> Expression:
    """The nominal state with the error d (15,) added."""
    dp, dv, turned, of_force, of_rate = ca.vertsplit(d, PARTS)
    return ca.vertcat(
        nominal[POSITION] + dp,
        unit(product(nominal[ATTITUDE], exponential(turned))),
        nominal[VELOCITY] + dv,
        nominal[ACCELEROMETER_BIAS] + of_force,
        nominal[GYROSCOPE_BIAS] + of_rate,
    )


def reset(covariance: Expression, d: Expression) -> Expression:
    """The covariance about the nominal state into which the error d has gone."""
    turn = ca.DM.eye(3) - cross_matrix(d[D_ATTITUDE.start : D_ATTITUDE.stop]) / 2

    def apply(P: Expression) -> Expression:
        parts = ca.vertsplit(P, [0, D_ATTITUDE.start, D_ATTITUDE.stop, N_ERROR])
        return ca.vertcat(parts[0], turn @ parts[1], parts[2])

    return ca.triu2symm(ca.triu(apply(apply(covariance).T)))


def packed(covariance: Expression) -> Expression:
    """The upper triangle of a covariance, (120,), column by column."""
    return ca.vertcat(*(covariance[: j + 1, j] for j in range(N_ERROR)))


def unpacked(numbers: Expression) -> Expression:
    """The covariance (15, 15) of its upper triangle (120,)."""
    columns = []
    first = 0
    for j in range(N_ERROR):
        columns.append(ca.vertcat(numbers[first : first + j + 1], type(numbers)(N_ERROR - j - 1, 1)))
        first += j + 1
    return ca.triu2symm(ca.horzcat(*columns))


def prediction() -> ca.Function:
    """([nominal state, covariance], reading (6,), interval, [gravity, densities]) -> [nominal state, covariance]."""
    known, reading, duration, parameters = symbols(
        ca.SX, known=N_KNOWN, reading=N_READING, duration=1, parameters=1 + N_DENSITIES
    )
    covariance = unpacked(known[N_NOMINAL:])
    nominal, covariance = predict(known[:N_NOMINAL], covariance, reading, duration, parameters[0], parameters[1:])
    estimate = ca.vertcat(nominal, packed(covariance))
    return ca.Function("predict", [known, reading, duration, parameters], ca.cse([estimate]))


def correction(aid: Aid) -> ca.Function:
    """(whether there is a fix, [nominal state, covariance], fix, deviations) -> [nominal state, covariance]."""
    known, fix, deviations = symbols(ca.SX, known=N_KNOWN, fix=aid.size, deviations=len(aid.deviations))
    nominal = known[:N_NOMINAL]
    covariance = unpacked(known[N_NOMINAL:])
    innovations = []
    for innovation in aid.compare(nominal, fix):
        innovations.append((innovation.value, innovation.row, deviations[innovation.deviation] ** 2))
    nominal, covariance = update(nominal, covariance, innovations)
    estimate = ca.cse([ca.vertcat(nominal, packed(covariance))])
    arguments = [known, fix, deviations]
    return ca.Function.if_else(
        f"correct_by_{aid.name}",
        ca.Function(f"with_{aid.name}", arguments, estimate),
        ca.Function(f"without_{aid.name}", arguments, [known]),
    )
