"""Motors: limits of their speed, a first-order lag up and down, rotors that differ, and their angular momentum.

    c_i = clip(u_i, k w_min^2, k w_max^2)        commanded thrusts u, N
    y_i' = (y_c,i - y_i) / tau                   quadexp.physics.motor; y = T, or sqrt(T) for a lag of the rotor speed
    W_i = sqrt(T(y_i) / k)                       speed, rad/s
    T_i = s_0 s_i k W_i^2

The lag is discretised exactly over the integration step; the thrust of its middle is held over it. The factors s_0 of
the flight and s_i of each rotor are log-normal with mean 1 and the standard deviations of the settings, drawn when a
flight begins. They are of the thrust coefficient (density of the air, blades): no speed shows them, and what they
change, (s_0 s_i - 1) T and its torque, acts on the body beside the thrusts k W^2 that the airframe gets. A flight
begins with the rotors in hover, or at the thrusts of the reference where it begins in motion.

Rotors with the inertia I_p about their axes have the angular momentum -I_p d_i W_i along z_body, d_i the sign of the
reaction torque; changing and turning it takes a torque, whose opposite acts on the body (Sun et al. 2022, (4), (7),
(8)):

    tau = I_p [w_y S, -w_x S, S'],   S = sum_i d_i W_i                                          body, N m

S is that of the middle of the step, S' its mean over the step, w that of the beginning.

A flight logs the speeds w = sqrt(T / k) of its rotors by the thrusts that their motors give, or these thrusts where
no k is known: lag, voltage and loss are seen there.

Inner states: y (n,), then what is logged (n,). Parameters: exp(-h / 2 tau) up and down over half
an integration step h, least and largest thrust (N), thrust coefficient; with I_p or factors: (s_0 s_i - 1) times
vehicle.allocation (4 n,), column by column, and I_p d_i / sqrt(k) (n,).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import Expression, limited
from quadexp.physics.motor import decayed, time_constant_towards
from quadexp.physics.rotation import along_z, rotation_matrix
from quadexp.physics.state import ATTITUDE, RATE
from quadexp.physics.vehicle import Vehicle
from quadexp.world.effect import Clock, Effect, Moment, Sizes, Start

LAG = "time constant of the rotors that have to turn {}; 0: none"

NO_LAG = 1e-9  # s, in place of 0: the decay over any step is then exactly 0
N_FIXED = 5  # parameters without I_p and factors


@keyed
class Actuator(Effect):
    """Motors with a lag, limits of their speed, and rotors that differ."""

    prefix = "actuator."

    time_constant_up: float = key(0.0, LAG.format("faster"), "[0, 1]", "s")
    time_constant_down: float = key(0.0, LAG.format("slower"), "[0, 1]", "s")
    lag_of: Literal["rotor_speed", "thrust"] = key(
        "rotor_speed", "what follows its command with the lag; controller.motor_lag is that of the thrust"
    )
    rotor_speed_min: float | None = key(
        None, "least speed of the rotors; null: none; needs vehicle.thrust_coefficient", "[0, 1e5]", "rad/s"
    )
    rotor_speed_max: float | None = key(
        None, "largest speed of the rotors; null: none; needs vehicle.thrust_coefficient", "(0, 1e5]", "rad/s"
    )
    rotor_scale_std: float = key(
        0.0, "relative standard deviation of each rotor's thrust at its speed, drawn once a flight", "[0, 0.5]"
    )
    flight_scale_std: float = key(
        0.0, "relative standard deviation of all rotors' thrust at their speeds, drawn once a flight", "[0, 0.5]"
    )
    rotor_inertia: float = key(
        0.0, "of a rotor and its motor's bell about their axis; needs vehicle.thrust_coefficient", "[0, 1]", "kg m^2"
    )

    def check_together(self) -> None:
        low = self.rotor_speed_min
        high = self.rotor_speed_max
        if low is not None and high is not None and low >= high:
            raise UsageError(
                f"actuator.rotor_speed_min={low:g}: must be less than actuator.rotor_speed_max={high:g} rad/s"
            )

    stage = "actuator"

    @property
    def loop_lag(self) -> float:
        return max(self.time_constant_up, self.time_constant_down)

    def among(self, effects: Sequence[Effect]) -> Effect:
        """Without inertia and factors of the rotors nothing is added to a step."""
        if not (self.rotor_inertia or self.flight_scale_std or self.rotor_scale_std):
            return self
        return PushingActuator(**asdict(self))

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        """Raises UsageError for what needs speeds where the vehicle has no thrust coefficient."""
        asked = {"rotor_speed_min": self.rotor_speed_min, "rotor_speed_max": self.rotor_speed_max}
        asked["rotor_inertia"] = self.rotor_inertia or None
        for name, value in asked.items():
            if value is not None and vehicle.thrust_coefficient is None:
                raise UsageError(
                    f"actuator.{name}={value:g}: needs vehicle.thrust_coefficient, which"
                    f" vehicle={vehicle.name} does not state"
                )
        return Sizes(inner=2 * vehicle.n_rotors, parameters=N_FIXED)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        vehicle = start.vehicle
        k = vehicle.thrust_coefficient or 0.0
        low = k * (self.rotor_speed_min or 0.0) ** 2
        high = math.inf
        if self.rotor_speed_max is not None:
            high = k * self.rotor_speed_max**2
        if not low <= vehicle.hover_thrust <= high:
            raise UsageError(
                f"actuator: rotors between {low:.3g} and {high:.3g} N by their speeds, hovering takes"
                f" {vehicle.hover_thrust:.3g} N"
            )
        constants = [max(constant, NO_LAG) for constant in (self.time_constant_up, self.time_constant_down)]
        decays = [math.exp(-start.clock.step / 2 / constant) for constant in constants]
        thrust = np.clip(start.thrust, low, high)
        lagging = np.array(self._lagging(thrust)).ravel()
        inner = np.concatenate([lagging, first_rotor_column(vehicle, thrust)])
        return inner, np.array([*decays, low, high, rotor_column_factor(vehicle)])

    def columns(self, clock: Clock, vehicle: Vehicle) -> Mapping[str, int]:
        return rotor_column_names(vehicle, vehicle.n_rotors)

    def thrusts(self, at: Moment) -> Expression:
        return self._thrust(self._after(at)[0])

    def advance(self, at: Moment) -> Expression:
        y = self._after(at)[1]
        return ca.vertcat(y, at.inner[y.numel() :])

    def end(self, at: Moment) -> Expression:
        """What is logged."""
        y = at.inner[: at.inner.numel() // 2]
        return ca.vertcat(y, rotor_column(self._thrust(y), at.parameters[4]))

    def _lagging(self, thrust: Any) -> Any:
        """Y of a thrust."""
        if self.lag_of == "thrust":
            return thrust
        return ca.sqrt(thrust)

    def _after(self, at: Moment) -> tuple[Expression, Expression]:
        """y (n,) in the middle and at the end of the step."""
        y = at.inner[: at.command.numel()]
        up, down, low, high = ca.vertsplit(at.parameters[:4])
        command = self._lagging(limited(at.command, low, high))
        half = time_constant_towards(y, command, up, down)  # of the decays: which of the two holds
        return decayed(y, command, half), decayed(y, command, half**2)

    def _thrust(self, y: Expression) -> Expression:
        """k W^2 (n,) (N)."""
        if self.lag_of == "thrust":
            return y
        return y**2

    @property
    def idle(self) -> bool:
        numbers = (self.time_constant_up, self.time_constant_down, self.rotor_scale_std, self.flight_scale_std)
        return not any((*numbers, self.rotor_inertia)) and self.rotor_speed_min is None and self.rotor_speed_max is None


@dataclass(frozen=True)
class PushingActuator(Actuator):
    """Motors whose rotors have angular momentum, or thrust coefficients of their own; Actuator.among makes it."""

    def among(self, effects: Sequence[Effect]) -> Effect:
        return self

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        sizes = super().sizes(clock, vehicle)
        return sizes._replace(parameters=sizes.parameters + 5 * vehicle.n_rotors)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        inner, parameters = super().start(rng, start)
        vehicle = start.vehicle
        drawn = rng.standard_normal(1 + vehicle.n_rotors)  # whatever the settings: neither changes the other's draws
        scale = log_normal(self.flight_scale_std, drawn[0]) * log_normal(self.rotor_scale_std, drawn[1:])
        more = ((scale - 1) * vehicle.allocation).ravel(order="F")
        factor = self.rotor_inertia / math.sqrt(vehicle.thrust_coefficient or 1.0)  # no inertia where it is not known
        return inner, np.concatenate([parameters, more, factor * np.array(vehicle.rotor_spin, float)])

    def wrench(self, at: Moment) -> tuple[Expression, Expression]:
        middle, end = self._after(at)
        n = middle.numel()
        per_root = at.parameters[-n:]
        before = ca.dot(per_root, self._root(at.inner[:n]))
        between = ca.dot(per_root, self._root(middle))
        after = ca.dot(per_root, self._root(end))
        w = at.x[RATE]
        torque = ca.vertcat(w[1] * between, -w[0] * between, (after - before) / at.step)
        more = ca.reshape(at.parameters[N_FIXED:-n], 4, n) @ at.thrust
        return rotation_matrix(at.x[ATTITUDE]) @ along_z(more[0]), torque + more[1:]

    def _root(self, y: Expression) -> Expression:
        """Root of the thrusts (n,) that the motors give."""
        if self.lag_of == "thrust":
            y = ca.sqrt(ca.fmax(y, 0))
        return y


def log_normal(std: float, drawn: Any) -> Any:
    """Positive factors with mean 1 and this standard deviation, from standard normal numbers."""
    spread = math.log1p(std**2)
    return np.exp(math.sqrt(spread) * drawn - spread / 2)


def rotor_column_names(vehicle: Vehicle, first: int) -> Mapping[str, int]:
    """Columns of n inner states from `first` on."""
    name = "rotor_speed"
    if vehicle.thrust_coefficient is None:
        name = "delivered"
    return {f"{name}_{i}": first + i for i in range(vehicle.n_rotors)}


def rotor_column_factor(vehicle: Vehicle) -> float:
    """The parameter that `rotor_column` needs: thrust coefficient (N s^2), 0 where it is not known."""
    return vehicle.thrust_coefficient or 0.0


def rotor_column(thrust: Expression, factor: Expression) -> Expression:
    """Rotor speeds (n,) (rad/s) of thrusts (n,) (N); the thrusts where the factor is 0."""
    speed = ca.sqrt(ca.fmax(thrust, 0) / ca.fmax(factor, 1e-300))
    return ca.if_else(factor > 0, speed, thrust)


def first_rotor_column(vehicle: Vehicle, thrust: np.ndarray) -> Any:
    """The columns at thrusts (n,) (N); (n,)."""
    k = vehicle.thrust_coefficient
    if k is None:
        return thrust
    return np.sqrt(thrust / k)
