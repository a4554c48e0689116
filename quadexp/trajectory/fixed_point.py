"""The air's share of a reference: the residual outputs that agree with the motion they ask for.

    y = [a_air, tau_air] = r(z),    z = [v_body, w, u],    body frame

depends on the attitude, rates and rotor thrusts that follow from y itself. Unknown is y as a function of time, the
lateral part of a_air seen in the tilt frame as l; the flatness map (flat_map.py) under a given y gives z, and

    l     <-  l + (1 - M)^-1 (r_l(z) - l),    M = d r_l / d l through the tilt's effect on v_body  (quasi-Newton)
    rest  <-  r(z) + dr/du du,    (G + diag(m, 1, 1, 1) dr/du) du = diag(m, 1, 1, 1) (rest - r(z))

until nothing changes. Where the thrusts that l'' asks for act on l again (rotors near their limits), this does not
settle; then l' and l'' are taken as zero in the rates and torques. The second line solves for thrusts whose own effect
on the air counts: a rotor's true thrust may grow twice as fast as its static one, and then rest <- r(z) alone would not
settle. M: d l turns the tilt frame by d theta, (d theta x f)_xy = -d l, which changes the velocity seen in it by
v x d theta. The step is taken as a turn of f, at most MAX_TURN, since |f| is given and l near |f| is where l itself
would be a bad coordinate. Rotor thrusts, with G the vehicle's allocation:

    u = G^+ [T, tau],    T = m (c - a_air,z),    tau = J w' + w x J w - tau_air

World ENU, body FLU, SI. Arrays are component first, (d, k) at k times.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import numpy as np

from quadexp.errors import UsageError
from quadexp.residual.base import N_OUTPUTS
from quadexp.trajectory.air_model import AirModel
from quadexp.trajectory.demand import Demand
from quadexp.trajectory.flat_map import Tilt, cross, free_body_rates, heading_body_rates, twisted, untwisted
from quadexp.vehicle import Vehicle

MAX_TURN = 0.3  # rad, by which one iteration may turn the specific force in the tilt frame
MIN_SHARE = 0.02  # share of the specific force that an iteration leaves to the rotors' axis
MIN_DETERMINANT = 0.3  # of 1 - M: below it the step is the plain one, l <- r_l
PLAIN_ITERATIONS, SHORT_STEP = 30, 0.3  # with l' = l'' = 0: iterations before shorter steps, and their length
KINK = 0.5  # m/s^2, N m: change that may be left at the instants where a rotor meets its limit
SETTLED = 0.3  # m/s^2: until l changes by less in an iteration its differences in time are noise, and taken as zero


class Calculus(Protocol):
    """Derivatives and integrals in time of values (d, k) or (k,) at k times; see TimeGrid."""

    def differentiate(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]: ...

    def integrate(self, values: np.ndarray, derivative: np.ndarray) -> np.ndarray: ...


@dataclass(frozen=True)
class Held:
    """The calculus of what does not change, at a known twist chi, (k,) rad."""

    chi: np.ndarray

    def differentiate(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros_like(values), np.zeros_like(values)

    def integrate(self, values: np.ndarray, derivative: np.ndarray) -> np.ndarray:
        return self.chi


@dataclass(frozen=True)
class Settings:
    """tolerance: on the last change, m/s^2 and N m."""

    tolerance: float
    max_iterations: int


@dataclass(frozen=True)
class Air:
    """What the air does to a motion.

    outputs: l (tilt frame), a_air,z (m/s^2), tau_air (body, N m), (6, k). lateral_1, lateral_2: l', l'', (2, k).
    """

    outputs: np.ndarray
    lateral_1: np.ndarray
    lateral_2: np.ndarray

    @classmethod
    def still(cls, k: int) -> Air:
        """No air at k times."""
        return cls(np.zeros((N_OUTPUTS, k)), np.zeros((2, k)), np.zeros((2, k)))


@dataclass(frozen=True)
class Motion:
    """A demand met. chi: twist, (k,), rad. rate: w, (3, k), body (rad/s). thrusts: (n, k), N."""

    frame: Tilt
    chi: np.ndarray
    rate: np.ndarray
    thrusts: np.ndarray


def flat_motion(demand: Demand, vehicle: Vehicle, air: Air, calculus: Calculus) -> Motion:
    """The flatness map under given air; `calculus` integrates the twist of a free heading."""
    frame = demand.tilt(air.outputs[:2])
    o, o_dot = frame.rates(demand.path[3], demand.path[4], air.lateral_1, air.lateral_2)
    if demand.yaw is None:
        chi = calculus.integrate(-o[2], -o_dot[2])
        w, w_dot = free_body_rates(o, o_dot, chi)
    else:
        chi = frame.heading_twist(demand.yaw[0])
        w, w_dot = heading_body_rates(frame, o, o_dot, chi, demand.yaw)
    thrust = vehicle.mass * (frame.force[2] - air.outputs[2])
    return Motion(frame, chi, w, rotor_thrusts(vehicle, thrust, w, w_dot, air.outputs[3:]))


def rotor_thrusts(
    vehicle: Vehicle, thrust: np.ndarray, rate: np.ndarray, rate_derivative: np.ndarray, air_torque: np.ndarray
) -> np.ndarray:
    """u = G^+ [T, J w' + w x J w - tau_air], (n, k) (N); the least-norm thrusts for more than four rotors.

    thrust: T, (k,), N. rate: w, (3, k), body (rad/s). rate_derivative: w', (3, k) (rad/s^2).
    air_torque: (3, k), body (N m).
    """
    inertia = vehicle.inertia_matrix
    torque = inertia @ rate_derivative + cross(rate, inertia @ rate) - air_torque
    return _allocation_inverse(vehicle) @ np.concatenate([thrust[None], torque])


@lru_cache(maxsize=64)
def _allocation_inverse(vehicle: Vehicle) -> np.ndarray:
    """G^+, (n, 4)."""
    return np.linalg.pinv(vehicle.allocation)


def agreeing_air(
    demand: Demand,
    vehicle: Vehicle,
    model: AirModel | None,
    calculus: Calculus,
    settings: Settings,
    start: np.ndarray | None = None,
) -> tuple[Air, Motion]:
    """The air that agrees with the motion it causes, and the motion, under a residual model or none.

    calculus: of the demand's times. start: a first guess of the air's outputs, (6, k).
    Raises UsageError where there is no agreement after settings.max_iterations.
    """
    air, settled = Air.still(len(demand.t)), False
    if start is not None:
        lateral = reachable(start[:2], np.linalg.norm(demand.specific_force, axis=0))
        air = Air(np.concatenate([lateral, start[2:]]), *calculus.differentiate(lateral))
    if model is None:
        return air, flat_motion(demand, vehicle, air, calculus)
    for held in (False, True):
        for i in range(settings.max_iterations):
            motion = flat_motion(demand, vehicle, air, calculus)
            velocity = motion.frame.into_frame(demand.path[1])
            thrusts = _within_limits(motion.thrusts, vehicle)
            y, gradient, by_thrust = model(np.concatenate([twisted(velocity, motion.chi), motion.rate, thrusts]))
            asked = np.concatenate([untwisted(y[:2], motion.chi), y[2:]])
            change = np.abs(asked - air.outputs).max(axis=0)
            lateral = _next_lateral(asked[:2] - air.outputs[:2], motion, velocity, gradient)
            settled = settled or np.abs(lateral - air.outputs[:2]).max() < SETTLED
            slopes = calculus.differentiate(lateral if settled and not held else np.zeros_like(lateral))
            by_thrust = by_thrust * (motion.thrusts == thrusts)  # a rotor at its limit answers no more
            rest = _next_rest(air.outputs[2:], asked[2:], by_thrust, vehicle)
            outputs = np.concatenate([lateral, rest])
            if held and i >= PLAIN_ITERATIONS:
                outputs = air.outputs + SHORT_STEP * (outputs - air.outputs)
            if settled and change.max() < (KINK if held and i == settings.max_iterations - 1 else settings.tolerance):
                return Air(outputs, *slopes), motion
            air = Air(outputs, *slopes)
    worst = int(np.argmax(change))
    raise UsageError(
        f"the reference under residual {model.name!r} does not converge: still changing by {change[worst]:.2g}"
        f" (m/s^2, N m) after {settings.max_iterations} iterations, most at t = {demand.t[worst]:.2f} s;"
        " lower trajectory.speed or check the model"
    )


def reachable(lateral: np.ndarray, size: np.ndarray) -> np.ndarray:
    """l, (2, k), shortened where need be so that MIN_SHARE of the specific force `size`, (k,) (m/s^2), is left to c."""
    largest = size * np.sqrt(1 - MIN_SHARE**2)
    return lateral * np.minimum(1.0, largest / np.maximum(np.linalg.norm(lateral, axis=0), 1e-300))


def _within_limits(thrusts: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """Rotor thrusts, (n, k) (N), with the torque reduced until they are within the limits, the collective kept.

    A residual model knows nothing of thrusts beyond them, which a reference that cannot be flown may ask for.
    """
    collective = _allocation_inverse(vehicle)[:, :1] * thrusts.sum(axis=0)
    torque = thrusts - collective
    room = np.where(torque > 0, vehicle.thrust_max, vehicle.thrust_min) - collective
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(torque == 0, 1.0, room / torque).min(axis=0)
    return collective + np.clip(share, 0.0, 1.0) * torque


def _next_rest(used: np.ndarray, asked: np.ndarray, by_thrust: np.ndarray, vehicle: Vehicle) -> np.ndarray:
    """The next a_air,z and tau_air, (4, k).

    used, asked: (4, k), m/s^2 and N m. by_thrust: their derivative by the rotor thrusts, (4, n, k).
    """
    if not by_thrust.any():
        return asked
    weight = np.array([vehicle.mass, 1.0, 1.0, 1.0])
    gradient = by_thrust.transpose(2, 0, 1)
    system = vehicle.allocation + weight[:, None] * gradient
    right = (weight[:, None] * (used - asked)).T[..., None]
    turned = system.transpose(0, 2, 1)
    change = turned @ np.linalg.solve(system @ turned, right)  # the smallest one where there are more than four rotors
    return asked + (gradient @ change)[..., 0].T


def _next_lateral(difference: np.ndarray, motion: Motion, velocity: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """The next l, (2, k) (m/s^2).

    difference: r_l - l, (2, k), m/s^2. velocity: (3, k), tilt frame (m/s).
    gradient: d(a_x, a_y)/d v_body, (2, 3, k) (1/s).
    """
    columns = []
    for d_l in ((1.0, 0.0), (0.0, 1.0)):
        turn = motion.frame.solve(-d_l[0], -d_l[1])
        moved = twisted(cross(velocity, turn), motion.chi)
        lateral = untwisted((gradient * moved).sum(axis=1), motion.chi)
        columns.append((d_l[0] - lateral[0], d_l[1] - lateral[1]))
    (a, c), (b, d) = columns
    x, y = difference
    determinant = a * d - b * c
    contracting = (determinant > MIN_DETERMINANT) & (a + d > 0)
    newton = np.stack([d * x - b * y, a * y - c * x]) / np.where(contracting, determinant, 1.0)
    step = np.where(contracting, newton, difference)

    force = motion.frame.force
    across = np.stack([*step, -(force[:2] * step).sum(axis=0) / force[2]])  # along the sphere of constant |f|
    size, length = np.linalg.norm(force, axis=0), np.linalg.norm(across, axis=0)
    angle = np.minimum(length / size, MAX_TURN)
    turned = force * np.cos(angle) + across * (size * np.sin(angle) / np.maximum(length, 1e-300))
    over = turned[2] < MIN_SHARE * size  # past the equator: out to its edge
    return reachable(np.where(over, 1e3, 1.0) * turned[:2], size)
