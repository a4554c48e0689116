"""A battery that the rotors draw from, and the thrust that its voltage leaves them; equations: quadexp.physics.battery.

Within an integration step the current is held, the RC pair and the charge are advanced exactly, and the voltage is its
mean, so that energy is in balance. The flight is over when the battery is empty, or its voltage below the cut-off.

Inner states: state of charge, V_1, voltage (V), current (A), then what is logged of the rotors (n,), see
rotor_columns.py. Parameters: see `PARAMETERS`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from quadexp.config.motors import BatteryKeys
from quadexp.errors import UsageError
from quadexp.physics.battery import (
    OperatingPoint,
    charge_after,
    compensated_thrust,
    mean_share,
    open_circuit_voltage,
    operating_point,
    rc_voltage_after,
    rotor_power,
    sagging_thrust,
)
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle
from quadexp.world.effect import Clock, Effect, Moment, Sizes, Start
from quadexp.world.rotor_columns import first_rotor_column, rotor_column, rotor_column_factor, rotor_column_names

CHARGE, RC_VOLTAGE, VOLTAGE, CURRENT = range(4)
STATES = 4
PARAMETERS = (
    "cells", "capacity", "resistance", "rc_resistance", "rc_time_constant", "exponent", "reference", "hover_thrust",
    "hover_power", "electronics", "thrust_max", "cutoff", "rotor_column_factor",
)  # fmt: skip


@dataclass(frozen=True)
class Battery(BatteryKeys, Effect):
    """See BatteryKeys."""

    stage = "battery"

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        """See Effect.sizes."""
        return Sizes(inner=STATES + vehicle.n_rotors, parameters=len(PARAMETERS))

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        """See Effect.start. Raises UsageError where the battery cannot hold the vehicle in hover."""
        vehicle = start.vehicle
        power = self.hover_power * vehicle.mass
        source = float(open_circuit_voltage(self.state_of_charge, self.cells))
        needed = power + self.electronics
        if source**2 <= 4 * self.resistance * needed:
            raise UsageError(
                f"battery: {source:.1f} V over {self.resistance:g} Ohm give {source**2 / 4 / self.resistance:.0f} W at"
                f" most, hovering takes {needed:.0f} W"
            )
        hovering = (source + math.sqrt(source**2 - 4 * self.resistance * needed)) / 2
        values = {
            "cells": self.cells, "capacity": self.capacity, "resistance": self.resistance,
            "rc_resistance": self.rc_resistance, "rc_time_constant": self.rc_time_constant,
            "exponent": self.thrust_exponent, "reference": self.reference_voltage or hovering,
            "hover_thrust": vehicle.hover_thrust, "hover_power": power / vehicle.n_rotors,
            "electronics": self.electronics, "thrust_max": vehicle.thrust_max,
            "cutoff": self.cutoff_voltage * self.cells, "rotor_column_factor": rotor_column_factor(vehicle),
        }  # fmt: skip
        inner = [self.state_of_charge, 0.0, hovering, needed / hovering, *first_rotor_column(vehicle)]
        return inner, [values[name] for name in PARAMETERS]

    def columns(self, clock: Clock, vehicle: Vehicle) -> Mapping[str, int]:
        """See Effect.columns."""
        own = {"battery_voltage": VOLTAGE, "battery_current": CURRENT, "state_of_charge": CHARGE}
        return {**own, **rotor_column_names(vehicle, STATES)}

    def thrusts(self, at: Moment) -> Expression:
        """See Effect.thrusts."""
        return self._point(at).thrust

    def advance(self, at: Moment) -> Expression:
        """See Effect.advance."""
        p, point = self._named(at), self._point(at)
        charge = charge_after(at.inner[CHARGE], point.current, p["capacity"], at.step)
        pair = rc_voltage_after(at.inner[RC_VOLTAGE], point.current, p["rc_resistance"], p["rc_time_constant"], at.step)
        logged = rotor_column(point.thrust, p["rotor_column_factor"])
        return ca.vertcat(charge, pair, point.voltage, point.current, logged)

    def ended(self, inner: Any, parameters: Any) -> Any:
        """See Effect.ended."""
        cutoff = parameters[PARAMETERS.index("cutoff")]
        return ca.fmax(inner[CHARGE] <= 0, inner[VOLTAGE] < cutoff)

    def reason(self, inner: np.ndarray, parameters: np.ndarray) -> str:
        """See Effect.reason."""
        charge, voltage, current = (float(inner[i]) for i in (CHARGE, VOLTAGE, CURRENT))
        if charge <= 0:
            return f"the battery is empty (battery.capacity={self.capacity:g} Ah, {voltage:.1f} V left)"
        if voltage < parameters[PARAMETERS.index("cutoff")]:
            return (
                f"the battery's {voltage:.1f} V are below battery.cutoff_voltage={self.cutoff_voltage:g} V per cell,"
                f" at {current:.0f} A and {100 * charge:.0f} % of its charge,"
            )
        return ""

    def _named(self, at: Moment) -> dict[str, Expression]:
        return dict(zip(PARAMETERS, ca.vertsplit(at.parameters), strict=True))

    def _point(self, at: Moment) -> OperatingPoint:
        """Voltage, current and thrusts during the step."""
        p = self._named(at)
        charge = ca.fmax(at.inner[CHARGE], 0)

        def thrust_at(voltage: Expression) -> Expression:
            ratio = voltage / p["reference"]
            if self.compensation:
                return compensated_thrust(at.command, ratio, p["exponent"], p["thrust_max"])
            return sagging_thrust(at.command, ratio, p["exponent"])

        def power_of(thrust: Expression) -> Expression:
            return ca.sum1(rotor_power(thrust, p["hover_thrust"], p["hover_power"])) + p["electronics"]

        share = mean_share(p["rc_time_constant"], at.step)
        source = open_circuit_voltage(charge, p["cells"]) - share * at.inner[RC_VOLTAGE]
        resistance = p["resistance"] + (1 - share) * p["rc_resistance"]
        return operating_point(source, resistance, at.inner[VOLTAGE], thrust_at, power_of)
