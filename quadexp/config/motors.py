"""Settings of what lies between a command and the thrust of the rotors: motors, battery, rotors that fail."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from quadexp.config.settings import Setting, Settings
from quadexp.config.world import WorldPartConfig
from quadexp.errors import UsageError

LAG = "time constant of the rotors that have to turn {}; 0: none"


# -------------------------------------------------------------------------------------------------------- actuator
@dataclass(frozen=True)
class ActuatorKeys(Settings):
    """Motors with a lag, limits of their speed, and rotors that differ; see quadexp/world/actuator.py."""

    prefix: ClassVar[str] = "actuator."

    time_constant_up: Annotated[float, Setting(LAG.format("faster"), "[0, 1]", "s")] = 0.0
    time_constant_down: Annotated[float, Setting(LAG.format("slower"), "[0, 1]", "s")] = 0.0
    lag_of: Annotated[
        Literal["rotor_speed", "thrust"],
        Setting("what follows its command with the lag; controller.motor_lag is that of the thrust"),
    ] = "rotor_speed"
    rotor_speed_min: Annotated[
        float | None,
        Setting("least speed of the rotors; null: none; needs vehicle.thrust_coefficient", "[0, 1e5]", "rad/s"),
    ] = None
    rotor_speed_max: Annotated[
        float | None,
        Setting("largest speed of the rotors; null: none; needs vehicle.thrust_coefficient", "(0, 1e5]", "rad/s"),
    ] = None
    rotor_scale_std: Annotated[
        float,
        Setting("relative standard deviation of each rotor's thrust at its speed, drawn once a flight", "[0, 0.5]"),
    ] = 0.0
    flight_scale_std: Annotated[
        float,
        Setting("relative standard deviation of all rotors' thrust at their speeds, drawn once a flight", "[0, 0.5]"),
    ] = 0.0
    rotor_inertia: Annotated[
        float,
        Setting(
            "of a rotor and its motor's bell about their axis; needs vehicle.thrust_coefficient", "[0, 1]", "kg m^2"
        ),
    ] = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.rotor_speed_min, self.rotor_speed_max
        if low is not None and high is not None and low >= high:
            raise UsageError(
                f"actuator.rotor_speed_min={low:g}: must be less than actuator.rotor_speed_max={high:g} rad/s"
            )


@dataclass(frozen=True, kw_only=True)
class ActuatorConfig(ActuatorKeys, WorldPartConfig):
    """Motors between a command and the thrust; with every value at its default they do nothing."""

    effect = "quadexp.world.actuator:Actuator"

    @property
    def idle(self) -> bool:
        """See WorldPartConfig."""
        numbers = (self.time_constant_up, self.time_constant_down, self.rotor_scale_std, self.flight_scale_std)
        return not any((*numbers, self.rotor_inertia)) and self.rotor_speed_min is None and self.rotor_speed_max is None


# --------------------------------------------------------------------------------------------------------- battery
@dataclass(frozen=True)
class BatteryKeys(Settings):
    """An equivalent circuit of lithium-polymer cells in series; see quadexp/physics/battery.py."""

    prefix: ClassVar[str] = "battery."

    cells: Annotated[int, Setting("cells in series", "[1, 24]", "cells")] = 4
    capacity: Annotated[float, Setting("charge of the full battery", "(0, 1000]", "Ah")] = 1.5
    state_of_charge: Annotated[float, Setting("when a flight begins; 1: full", "(0, 1]")] = 1.0
    resistance: Annotated[float, Setting("in series, of the whole battery", "[0, 10]", "Ohm")] = 0.02
    rc_resistance: Annotated[float, Setting("of the RC pair", "[0, 10]", "Ohm")] = 0.012
    rc_time_constant: Annotated[float, Setting("of the RC pair", "(0, 1e4]", "s")] = 20.0
    hover_power: Annotated[
        float, Setting("electrical power of all rotors in hover; goes with thrust^(3/2)", "[0, 1e4]", "W per kg")
    ] = 150.0
    electronics: Annotated[float, Setting("power of everything else", "[0, 1e4]", "W")] = 5.0
    thrust_exponent: Annotated[
        float, Setting("k of thrust ~ (V / reference_voltage)^k at a fixed throttle", "[0, 4]")
    ] = 2.0
    reference_voltage: Annotated[
        float | None,
        Setting(
            "at which thrusts are as commanded; null: the voltage in hover when the flight begins", "(0, 200]", "V"
        ),
    ] = None
    compensation: Annotated[
        bool, Setting("the flight stack gives more throttle as the voltage falls, up to the full one")
    ] = False
    cutoff_voltage: Annotated[
        float, Setting("below this the electronics stop and the flight is over", "[0, 4]", "V per cell")
    ] = 2.5


@dataclass(frozen=True, kw_only=True)
class BatteryConfig(BatteryKeys, WorldPartConfig):
    """A battery whose voltage sags; see quadexp/world/battery.py."""

    effect = "quadexp.world.battery:Battery"


# ---------------------------------------------------------------------------------------------------------- health
FAILURE = ("rotor", "t", "factor")


@dataclass(frozen=True)
class RotorLossKeys(Settings):
    """Rotors that lose part of their thrust; see quadexp/world/rotor_loss.py."""

    prefix: ClassVar[str] = "health."

    losses: Annotated[
        tuple[Any, ...],
        Setting("{rotor: number from 0, t: s, factor: share of its thrust that it has from then on} each"),
    ] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for loss in self.losses:
            if not isinstance(loss, Mapping) or {*loss} != {*FAILURE}:
                found = sorted(loss) if isinstance(loss, Mapping) else loss
                raise UsageError(f"health.losses: {found}; each loss is {{rotor: number, t: s, factor: 0 .. 1}}")
            numbers = [loss[name] for name in FAILURE]
            if not all(isinstance(one, int | float) and not isinstance(one, bool) for one in numbers):
                raise UsageError(f"health.losses: rotor, t and factor are {numbers}, all must be numbers")
            if int(loss["rotor"]) != loss["rotor"] or loss["rotor"] < 0:
                raise UsageError(f"health.losses: rotor {loss['rotor']}: must be a rotor's number, from 0")
            if not 0 <= loss["factor"] <= 2 or not 0 <= loss["t"] < float("inf"):
                raise UsageError(
                    f"health.losses: t {loss['t']} and factor {loss['factor']}: t must not be negative, the factor in"
                    " [0, 2]"
                )


@dataclass(frozen=True, kw_only=True)
class RotorLossConfig(RotorLossKeys, WorldPartConfig):
    """Rotors that lose part of their thrust in flight."""

    effect = "quadexp.world.rotor_loss:RotorLoss"

    @property
    def idle(self) -> bool:
        """See WorldPartConfig."""
        return not self.losses
