"""A quadrotor's whole state many steps ahead, with 15 constants fitted to training flights.

    p' = v,   v' = R (k sum T_i e_z - D v_b) - g e_z     4 constants of the force: k, D = diag(d_x, d_y, d_z)
    w' = the replay model of quadexp identify --method torque (11 constants), or blind to the motors (8), or 0
    R' = R [w]x,   T_i = (W_i / HOVER)^2                 v_b: velocity in body axes; W_i: rotor speed

The force first, with the measured attitude: Huber's loss of the change of velocity over SPAN steps. Then the turning,
by output error over half a second. Nothing about the vehicle is known but which rotor is where and how it turns.
Input u_t acts from y_t to y_{t+1}; the velocity that flaps the blades and the rates that are damped are predicted ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.models.regression import solve
from quadexp.plugins.identification.torque import AxisModel, output_error
from quadexp.plugins.identification.turning import Turning, regressors
from quadexp.plugins.public.nanodrone import PARTS, PERIOD, STATES, STEPS, Run

GRAVITY = 9.81  # m/s^2
HOVER = 1700.0  # rad/s, about that of hover; another one scales k and the gains
SPAN = 30  # samples, of a change of velocity
STRIDE = 4  # samples, between two of them
# Rotors of a Crazyflie: front right, back right, back left, front left. Torque of unit thrusts about x, y, z: y_i, -x_i
# (in arms) and the sense of rotation; a quarter of it, so that t is a difference of mean thrusts.
TORQUES = np.array([[-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, -1.0], [1.0, -1.0, 1.0, -1.0]]).T / 4


class Force(NamedTuple):
    """thrust: k, m/s^2 of a rotor at HOVER. drag: (3,), 1/s."""

    thrust: float
    drag: np.ndarray


class Inputs(NamedTuple):
    """Of a run, from each sample to the next: thrusts (k, 4), torque (k, 3), spin (k,): sum of speeds over its mean."""

    thrusts: np.ndarray
    torque: np.ndarray
    spin: np.ndarray


def mean_speed(runs: Sequence[Run]) -> float:
    """Mean sum of the rotor speeds, rad/s."""
    return float(np.concatenate([run.u for run in runs]).sum(axis=1).mean())


def inputs(run: Run, speed: float) -> Inputs:
    thrusts = (run.u / HOVER) ** 2
    return Inputs(thrusts, thrusts @ TORQUES, run.u.sum(axis=1) / speed)


def turning(run: Run, number: int, speed: float) -> Turning:
    """A run as the replay model is fitted to it."""
    _, torque, spin = inputs(run, speed)
    attitude, velocity = _motion(run)
    return Turning(run.y[:, PARTS["w"]], attitude, torque[:-1], spin[:-1], velocity, number, PERIOD)


def _motion(run: Run) -> tuple[Rotation, np.ndarray]:
    """Attitude at every sample (k), and mean velocity of every step in body axes (k - 1, 3) (m/s)."""
    attitude = Rotation.from_quat(run.y[:, PARTS["R"]])
    body = attitude.apply(run.y[:, PARTS["v"]], inverse=True)
    return attitude, (body[:-1] + body[1:]) / 2


def fit_force(runs: Sequence[Run]) -> Force:
    """The four constants of the force."""
    designs = []
    targets = []
    for run in runs:
        velocity = run.y[:, PARTS["v"]]
        attitude, mean_velocity = _motion(run)
        half_turn = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / 2
        middle = attitude[:-1] * Rotation.from_rotvec(half_turn)  # of a step
        axes = middle.as_matrix()
        collective = ((run.u[:-1] / HOVER) ** 2).sum(axis=1)
        thrust = axes[:, :, 2:] * collective[:, None, None]
        drag = -axes * mean_velocity[:, None, :]
        step = PERIOD * np.concatenate([thrust, drag], axis=2)  # (k, 3, 4)
        until = np.concatenate([np.zeros((1, 3, 4)), np.cumsum(step, axis=0)])
        starts = np.arange(0, len(velocity) - SPAN, STRIDE)
        ends = starts + SPAN
        change = velocity[ends] - velocity[starts] + [0.0, 0.0, GRAVITY * SPAN * PERIOD]
        designs.append((until[ends] - until[starts]).reshape(-1, 4))
        targets.append(change.reshape(-1))
    constants, _ = solve(np.concatenate(designs), np.concatenate(targets), "huber")
    return Force(float(constants[0]), constants[1:])


def fit_turning(runs: Sequence[Run], speed: float, *, motors: bool) -> list[AxisModel]:
    """The replay model, or (without motors) the one that is blind to them."""
    data = [turning(run, number, speed) for number, run in enumerate(runs)]
    return [output_error(data, axis, motors=motors) for axis in range(3)]


def predicted(run: Run, force: Force, axes: Sequence[AxisModel] | None, speed: float) -> np.ndarray:
    """States after 1 .. STEPS steps from every start of a run, (starts, STEPS, 13). axes: None: rates held."""
    thrusts, torque, spin = inputs(run, speed)
    starts = run.starts
    position, velocity, quaternion, rate = (run.y[starts, columns] for columns in PARTS.values())
    attitude = Rotation.from_quat(quaternion)  # whose products keep the sign of the quaternion
    states = np.empty((len(starts), STEPS, len(STATES)))
    for step in range(STEPS):
        now = starts + step
        body = attitude.apply(velocity, inverse=True)
        change = np.zeros_like(rate)
        for axis, model in enumerate(axes or ()):
            columns = regressors(axis, torque[now] if model.motors else None, spin[now], body)
            change[:, axis] = model.acceleration(columns, spin[now], rate[:, axis])
        turn = PERIOD * (rate + PERIOD * change / 2)
        push = -force.drag * body
        push[:, 2] += force.thrust * thrusts[now].sum(axis=1)
        middle = attitude * Rotation.from_rotvec(turn / 2)  # of the step
        acceleration = middle.apply(push) - [0.0, 0.0, GRAVITY]
        position = position + PERIOD * velocity + PERIOD**2 / 2 * acceleration
        velocity = velocity + PERIOD * acceleration
        attitude = attitude * Rotation.from_rotvec(turn)
        rate = rate + PERIOD * change
        states[:, step] = np.column_stack([position, velocity, attitude.as_quat(), rate])
    return states
