"""One RK4 step with its exact sensitivities, chained stage by stage.

The air does not depend on the position, so with s = [q, v, w] the motion is s' = f(s, u), p' = v, and only
S_i = d k_i / d(s, u), (10, 10 + n), of the four slopes k_i = f(s + c_i k_{i-1}, u), c = (0, dt/2, dt/2, dt), is needed:

    S_i = [f_s, f_u] + c_i f_s S_{i-1}
    d s_next = [I, 0] + dt/6 (S_1 + 2 S_2 + 2 S_3 + S_4),        d p_next = [0, I, 0] dt + dt^2/6 (S_1 + S_2 + S_3)|_v

Differentiating the whole step at once gives the same numbers from an expression three to ten times larger. The
residual's own Jacobian enters by the chain rule through z(x, u).

With rotors that lag, the thrusts T are states behind the 13 of the body, and the thrust of a stage is
T_i = u + a_i (T - u), a_i = exp(-c_i / tau) (physics.motor). Then S_i is taken by (s, T, u), (10, 10 + 2 n):

    S_i = [f_s, a_i f_T, (1 - a_i) f_T] + c_i f_s S_{i-1},        dT_next = a dT + (1 - a) du

A known disturbance d, an acceleration in the world and an angular acceleration of the body, is added to every slope; it
does not depend on the state, so the sensitivities keep their form.
"""

from __future__ import annotations

from collections.abc import Callable

from quadexp.compile.symbolic import ca
from quadexp.names import named
from quadexp.physics.expression import Expression, named_function, symbols
from quadexp.physics.motor import lagging_thrust
from quadexp.physics.rigid_body import (
    N_DISTURBANCE,
    N_OUTPUTS,
    Correction,
    body_features,
    disturbed_derivative,
    state_derivative,
)
from quadexp.physics.scalars import as_scalars
from quadexp.physics.state import N_STATE
from quadexp.physics.vehicle import Vehicle

N_MOTION = N_STATE - 3  # s = [q, v, w]
MOTION_VELOCITY = slice(4, 7)  # v within s
FLAT_LIMIT = 100  # scalar operations of a residual; above, functions called at every stage are faster than copies


def rk4_sensitivity_function(
    vehicle: Vehicle, residual: Correction, *, scalar: bool = True, lag: bool = False, added: bool = False,
    disturbed: bool = False,
) -> ca.Function:  # fmt: skip
    """(x (13,), u (n,), theta (p,), dt (s)) -> x_next (13,), A (13, 13), B (13, n).

    lag: rotors lag behind their commands; x (13 + n,) then ends with their thrusts (N), and the last input is the time
    constant tau (s).
    added: a further input (n, 3): thrust (N) added to what u gives, at the start, the middle and the end of the step.
    disturbed: a further input (6,): what is added to v' (world, m/s^2) and to w' (body, rad/s^2) throughout the step.
    scalar: scalar operations without structural zeros, fastest when compiled; otherwise dense matrix products, fastest
    in CasADi's virtual machine. A residual that is large or in matrix operations remains a function call.
    """
    flat = scalar and residual.function.is_a("SXFunction") and residual.function.n_instructions() < FLAT_LIMIT
    kind = ca.SX if flat else ca.MX
    n = vehicle.n_rotors
    start, u, theta, dt, tau, plus, disturbance = symbols(
        kind,
        x=N_STATE + n * lag,
        u=n,
        theta=residual.function.size1_in(1),
        dt=1,
        tau=1,
        added=(n, 3),
        disturbance=N_DISTURBANCE,
    )
    x = start
    thrust = u
    if lag:
        x = start[:N_STATE]
        thrust = start[N_STATE:]
    if added:
        thrust = thrust + plus[:, 0]
    slope = _slope_function(vehicle, residual, dense=not scalar)

    def chained_stage(
        x_stage: Expression, u: Expression, y: Expression, dy_dz: Expression, S: Expression, c: Expression,
        *a: Expression,
    ) -> tuple[Expression, Expression]:  # fmt: skip
        k, G = slope(x_stage, u, y, dy_dz)
        return k, _by_command(G, *a) + c * (G[:, :N_MOTION] @ S)

    stage: Callable[..., Expression] = chained_stage
    combine: Callable[..., Expression] = _combine
    if scalar:
        stage = as_scalars(stage)
        combine = as_scalars(combine)
    compact = scalar and not flat

    def pushed(k: Expression) -> Expression:
        if not disturbed:
            return k
        return as_scalars(disturbed_derivative)(k, disturbance)

    k, S = slope(x, thrust, *residual.function(as_scalars(body_features)(x, thrust), theta))
    k = pushed(k)
    slopes = [k]
    if lag:
        S = ca.horzcat(S, kind(N_MOTION, n))
    sensitivities = [S]
    for c, column in ((dt / 2, 1), (dt / 2, 1), (dt, 2)):
        share = []
        delivered = u
        if lag:
            share = [ca.exp(-c / tau)]
            delivered = lagging_thrust(start[N_STATE:], u, c, tau)
        if added:
            delivered = delivered + plus[:, column]
        x_stage, z = as_scalars(_stage_point)(x, delivered, slopes[-1], c)
        arguments = [x_stage, delivered, *residual.function(z, theta), sensitivities[-1], c, *share]
        if compact and len(slopes) == 1:
            stage = _one_stage_function(chained_stage, arguments)
        k, S = stage(*arguments)
        slopes.append(pushed(k))
        sensitivities.append(S)
    outputs = combine(x, dt, *slopes, *sensitivities)
    if lag:
        x_next, A, by_inputs = outputs
        outputs = _with_thrusts(x_next, A, by_inputs, delivered, ca.exp(-dt / tau))
    if flat:
        outputs = ca.cse(outputs)
    elif not scalar:
        outputs = [ca.densify(output) for output in outputs]
    inputs = {"x": start, "u": u, "theta": theta, "dt": dt}
    if lag:
        inputs["tau"] = tau
    if added:
        inputs["added"] = plus
    if disturbed:
        inputs["disturbance"] = disturbance
    return named_function("node", inputs, named(("x_next", "A", "B"), outputs))


def _one_stage_function(chained_stage: Callable[..., Expression], inputs: list[Expression]) -> ca.Function:
    """A stage as one function for all of them: of S only those zeros are left out that no stage fills.

    inputs: arguments of the first stage that is chained, S the fifth of them.
    """
    patterns = [argument.sparsity() for argument in inputs]
    while True:
        arguments = [ca.SX.sym(f"a{i}", pattern) for i, pattern in enumerate(patterns)]
        k, S = chained_stage(*arguments)
        filled = patterns[4].unite(S.sparsity())
        if filled == patterns[4]:
            return ca.Function("stage", arguments, ca.cse([k, ca.project(S, filled)]))
        patterns[4] = filled


def _by_command(G: Expression, a: Expression | None = None) -> Expression:
    """[f_s, f_T] of a stage, by what the step begins with: where rotors lag, a is the share of the first thrust."""
    if a is None:
        return G
    by_thrust = G[:, N_MOTION:]
    return ca.horzcat(G[:, :N_MOTION], a * by_thrust, (1 - a) * by_thrust)


def _with_thrusts(
    x_next: Expression, A: Expression, by_inputs: Expression, thrust: Expression, a: Expression
) -> list[Expression]:
    """x_next, A, B with the thrusts as states; by_inputs (13, 2 n): by the first thrusts and by the commands."""
    n = thrust.size1()
    unit = type(thrust).eye(n)
    A = ca.blockcat([[A, by_inputs[:, :n]], [type(A)(n, N_STATE), a * unit]])
    B = ca.vertcat(by_inputs[:, n:], (1 - a) * unit)
    return [ca.vertcat(x_next, thrust), A, B]


def _stage_point(x: Expression, u: Expression, k: Expression, c: Expression) -> tuple[Expression, Expression]:
    """State and features of the stage after slope k."""
    x_stage = x + c * k
    return x_stage, body_features(x_stage, u)


def _combine(
    x: Expression, dt: Expression, k1: Expression, k2: Expression, k3: Expression, k4: Expression, S1: Expression,
    S2: Expression, S3: Expression, S4: Expression,
) -> list[Expression]:  # fmt: skip
    """x_next, A, B from the slopes and sensitivities of the four stages."""
    kind = type(x)
    n = S1.size2() - N_MOTION
    start = ca.horzcat(kind.eye(N_MOTION), kind(N_MOTION, n))
    middle = S2 + S3
    three = S1 + middle
    d_motion = start + dt / 6 * (three + middle + S4)
    d_position = dt * start[MOTION_VELOCITY, :] + dt * dt / 6 * three[MOTION_VELOCITY, :]
    d_state = ca.vertcat(d_position, d_motion)
    A = ca.horzcat(ca.vertcat(kind.eye(3), kind(N_MOTION, 3)), d_state[:, :N_MOTION])
    x_next = x + dt / 6 * (k1 + 2 * (k2 + k3) + k4)
    return [x_next, A, d_state[:, N_MOTION:]]


def _slope_function(vehicle: Vehicle, residual: Correction, *, dense: bool) -> ca.Function:
    """(x, u, y, dy/dz) -> x' (13,), G = [f_s, f_u] (10, 10 + n) of the corrected dynamics."""
    x, u, y, dy_dz, correction = symbols(
        ca.SX,
        x=N_STATE,
        u=vehicle.n_rotors,
        y=residual.function.sparsity_out(0),
        dy_dz=residual.function.sparsity_out(1),
        correction=N_OUTPUTS,
    )
    derivative = state_derivative(x, u, vehicle, correction)
    motion = ca.vertcat(x[3:], u)
    features = body_features(x, u)
    by_motion = ca.jacobian(derivative[3:], motion)
    by_correction = ca.jacobian(derivative[3:], correction)
    corrected = [by_motion, by_correction, derivative]
    by_motion, by_correction, derivative = ca.substitute(corrected, [correction], [ca.densify(y)])
    by_features = by_correction @ (dy_dz @ ca.jacobian(features, motion))
    G = by_motion + by_features
    G = ca.densify(G) if dense else ca.sparsify(G)
    return ca.Function("slope", [x, u, y, dy_dz], ca.cse([derivative, G]))
