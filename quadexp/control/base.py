"""The controller seam: a measurement and a window of the reference in, rotor thrusts and a record of the step out.

World ENU, body FLU, SI units. A controller never sees the plant: what a flight stack could not measure does not cross.
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from quadexp.control.mpc.mpc import StepRecord
from quadexp.models.residual import Residual
from quadexp.physics.vehicle import Vehicle


class Measurement(NamedTuple):
    """What is known of the vehicle at a control instant, just before the new command.

    t: s. state: (13,). specific_force: accelerometer reading (3,), body (m/s^2). rotor_speed: (n,) (rad/s), or None
    where the vehicle does not measure it. Both are None where nothing was read, as at the first instant.
    """

    t: float
    state: np.ndarray
    specific_force: np.ndarray | None
    rotor_speed: np.ndarray | None


class Window(NamedTuple):
    """The reference as a controller may see it.

    state: (N + 1, 13) at its node times from now. input: (N, n), N. position: (5, 3), world: position (m) .. snap, now.
    yaw: heading (rad), rate, acceleration (3,), now. Where the trajectory leaves the heading free it is that of the
    reference's attitude, which does not turn about its thrust axis: rate and acceleration are zero, for laws that turn
    the vehicle about that axis by them. drift: the rate at which such a heading changes all the same (rad/s).
    """

    state: np.ndarray
    input: np.ndarray
    position: np.ndarray
    yaw: np.ndarray
    drift: float = 0.0


N_BELIEF = 11  # numbers, in the order of Belief


class Belief(NamedTuple):
    """What an observer believes of the world around the vehicle, beside the controller's model.

        m v' = s T R e_z + c F_air(v - w, ..) + m g + F,    J w' = .. + c tau_air + tau

    force: F, (3,), world (N). torque: tau, (3,), body (N m). wind: w, velocity of the air (3,), world (m/s).
    thrust_scale: s, what a rotor delivers of a commanded newton; air_scale: c, what the air does of what the model
    says; 1 is as the model. A controller that can use it has a method `believe(belief)`, called before each `step`.
    """

    force: np.ndarray
    torque: np.ndarray
    wind: np.ndarray
    thrust_scale: float = 1.0
    air_scale: float = 1.0


def no_belief() -> Belief:
    """The world is as the model: still air, nothing beyond it."""
    return Belief(np.zeros(3), np.zeros(3), np.zeros(3))


def belief_of(numbers: np.ndarray) -> Belief:
    """The belief of N_BELIEF numbers; its vectors are views of them."""
    return Belief(numbers[0:3], numbers[3:6], numbers[6:9], float(numbers[9]), float(numbers[10]))


class Controller(Protocol):
    """Tracks a reference: `forget` before the reference is made, `reset` once, then `step` every control period.

    vehicle: what the controller believes it flies. control_period: s. node_times: (N + 1,), s from now, where it wants
    the reference; the first need not be 0. residual: what references should contain of the air, None for nothing.
    reference_period: s, after which the reference is made anew where `residual` is another object; 0: never.
    residual_name, source: what it knows of the air, and from where. backend: what its functions run on.
    """

    vehicle: Vehicle
    control_period: float
    node_times: np.ndarray
    reference_period: float
    backend: str
    residual_name: str
    source: str

    @property
    def residual(self) -> Residual | None: ...

    def forget(self) -> None:
        """Unlearn what earlier flights taught."""

    def reset(self, x: np.ndarray, window: Window) -> None:
        """Begin a flight in the state x, (13,); nothing of an earlier flight is left."""

    def step(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, StepRecord]:
        """Rotor thrusts, (n,) (N), and how the step went; one whose step is Python may give the thrusts alone."""

    def log(self) -> dict[str, float]:
        """Further columns of the last step, the same names at every step."""
