"""A battery that the rotors draw from, and the thrust that its voltage leaves them; equations:
quadexp.plugins.worlds.circuit.

Within an integration step the current is held, the RC pair and the charge are advanced exactly, and the voltage is its
mean, so that energy is in balance. Over a control period E follows its tangent at the charge of the beginning: in 20 ms
a battery that lasts 20 s loses 0.1 % of its charge, and E is off by some 1e-6 V (1e-3 V in the last percents of the
charge, where it bends). The flight is over when the battery is empty, or its voltage below the cut-off.

Inner states: state of charge, V_1, voltage (V), current (A), then of the rotors (n,) their thrusts, and at the end of a
period what is logged, see actuator.py; then a and b of the tangent a + b z. Parameters: see `PARAMETERS`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.names import named
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import Expression
from quadexp.physics.motor import decayed
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.worlds.circuit import (
    OperatingPoint,
    charge_after,
    compensated_power,
    compensated_thrust,
    mean_share,
    open_circuit_tangent,
    open_circuit_voltage,
    operating_point,
    rotor_power,
    sagging_power,
    sagging_thrust,
)
from quadexp.world.actuator import first_rotor_column, rotor_column, rotor_column_factor, rotor_column_names
from quadexp.world.effect import Clock, Effect, Moment, Sizes, Start

CHARGE, RC_VOLTAGE, VOLTAGE, CURRENT = range(4)
STATES = 4  # that are logged
TANGENT = 2  # states of the line of the thrust limit
PARAMETERS = (
    "cells",
    "capacity",
    "resistance",
    "rc_resistance",
    "rc_decay",
    "rc_share",
    "per_reference",
    "power_of_a_newton",
    "electronics",
    "thrust_max",
    "power_max",
    "cutoff",
    "rotor_column_factor",
)


@keyed
class Battery(Effect):
    """An equivalent circuit of lithium-polymer cells in series; see quadexp/plugins/worlds/circuit.py."""

    prefix = "battery."

    cells: int = key(4, "cells in series", "[1, 24]", "cells")
    capacity: float = key(1.5, "charge of the full battery", "(0, 1000]", "Ah")
    state_of_charge: float = key(1.0, "when a flight begins; 1: full", "(0, 1]")
    resistance: float = key(0.02, "in series, of the whole battery", "[0, 10]", "Ohm")
    rc_resistance: float = key(0.012, "of the RC pair", "[0, 10]", "Ohm")
    rc_time_constant: float = key(20.0, "of the RC pair", "(0, 1e4]", "s")
    hover_power: float = key(
        150.0, "electrical power of all rotors in hover; goes with thrust^(3/2)", "[0, 1e4]", "W per kg"
    )
    electronics: float = key(5.0, "power of everything else", "[0, 1e4]", "W")
    thrust_exponent: float = key(2.0, "k of thrust ~ (V / reference_voltage)^k at a fixed throttle", "[0, 4]")
    reference_voltage: float | None = key(
        None, "at which thrusts are as commanded; null: the voltage in hover when the flight begins", "(0, 200]", "V"
    )
    compensation: bool = key(False, "the flight stack gives more throttle as the voltage falls, up to the full one")
    cutoff_voltage: float = key(2.5, "below this the electronics stop and the flight is over", "[0, 4]", "V per cell")

    stage = "battery"

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        return Sizes(inner=STATES + vehicle.n_rotors + TANGENT, parameters=len(PARAMETERS))

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        """Raises UsageError where the battery cannot hold the vehicle in hover."""
        vehicle = start.vehicle
        power = self.hover_power * vehicle.mass
        source = float(open_circuit_voltage(self.state_of_charge, self.cells))
        needed = power + self.electronics
        if source**2 <= 4 * self.resistance * needed:
            raise UsageError(
                f"battery: {source:.1f} V over {self.resistance:g} Ohm give {source**2 / 4 / self.resistance:.0f} W at"
                f" most, hovering takes {needed:.0f} W"
            )
        step = start.clock.step
        rotor = (vehicle.hover_thrust, power / vehicle.n_rotors)

        def voltage_at(power: float) -> float:
            return (source + math.sqrt(max(source**2 - 4 * self.resistance * power, 0.0))) / 2

        drawn = float(ca.sum1(rotor_power(ca.DM(start.thrust), *rotor))) + self.electronics
        voltage = voltage_at(drawn)
        values = {
            "cells": self.cells,
            "capacity": self.capacity,
            "resistance": self.resistance,
            "rc_resistance": self.rc_resistance,
            "rc_decay": math.exp(-step / self.rc_time_constant),
            "rc_share": float(mean_share(self.rc_time_constant, step)),
            "per_reference": 1 / (self.reference_voltage or voltage_at(needed)),
            "power_of_a_newton": float(rotor_power(1.0, *rotor)),
            "electronics": self.electronics,
            "thrust_max": vehicle.thrust_max,
            "power_max": float(rotor_power(vehicle.thrust_max, *rotor)),
            "cutoff": self.cutoff_voltage * self.cells,
            "rotor_column_factor": rotor_column_factor(vehicle),
        }
        logged = first_rotor_column(vehicle, start.thrust)
        inner = [self.state_of_charge, 0.0, voltage, drawn / voltage, *logged, 0.0, 0.0]
        return inner, [values[name] for name in PARAMETERS]

    def columns(self, clock: Clock, vehicle: Vehicle) -> Mapping[str, int]:
        readings = {"battery_voltage": VOLTAGE, "battery_current": CURRENT, "state_of_charge": CHARGE}
        return {**readings, **rotor_column_names(vehicle, STATES)}

    def begin(self, at: Moment) -> Expression:
        """The tangent."""
        tangent = open_circuit_tangent(ca.fmax(at.inner[CHARGE], 0), self._named(at)["cells"])
        return ca.vertcat(at.inner[:-TANGENT], *tangent)

    def thrusts(self, at: Moment) -> Expression:
        return self._point(at).thrust

    def advance(self, at: Moment) -> Expression:
        p = self._named(at)
        point = self._point(at)
        charge = charge_after(at.inner[CHARGE], point.current, p["capacity"], at.step)
        pair = decayed(at.inner[RC_VOLTAGE], p["rc_resistance"] * point.current, p["rc_decay"])
        return ca.vertcat(charge, pair, point.voltage, point.current, point.thrust, at.inner[-TANGENT:])

    def end(self, at: Moment) -> Expression:
        """What is logged."""
        logged = rotor_column(at.inner[STATES:-TANGENT], self._named(at)["rotor_column_factor"])
        return ca.vertcat(at.inner[:STATES], logged, at.inner[-TANGENT:])

    def ended(self, inner: Any, parameters: Any) -> Any:
        cutoff = parameters[PARAMETERS.index("cutoff")]
        return ca.fmax(inner[CHARGE] <= 0, inner[VOLTAGE] < cutoff)

    def reason(self, inner: np.ndarray, parameters: np.ndarray) -> str:
        charge = float(inner[CHARGE])
        voltage = float(inner[VOLTAGE])
        current = float(inner[CURRENT])
        if charge <= 0:
            return f"the battery is empty (battery.capacity={self.capacity:g} Ah, {voltage:.1f} V left)"
        if voltage < parameters[PARAMETERS.index("cutoff")]:
            return (
                f"the battery's {voltage:.1f} V are below battery.cutoff_voltage={self.cutoff_voltage:g} V per cell,"
                f" at {current:.0f} A and {100 * charge:.0f} % of its charge,"
            )
        return ""

    def _named(self, at: Moment) -> dict[str, Expression]:
        return named(PARAMETERS, ca.vertsplit(at.parameters))

    def _point(self, at: Moment) -> OperatingPoint:
        """Voltage, current and thrusts during the step."""
        p = self._named(at)
        commanded = rotor_power(at.command, 1, p["power_of_a_newton"])

        def thrust_at(voltage: Expression) -> Expression:
            ratio = voltage * p["per_reference"]
            if self.compensation:
                return compensated_thrust(at.command, ratio, self.thrust_exponent, p["thrust_max"])
            return sagging_thrust(at.command, ratio, self.thrust_exponent)

        def power_at(voltage: Expression) -> Expression:
            ratio = voltage * p["per_reference"]
            if self.compensation:
                power = compensated_power(commanded, ratio, self.thrust_exponent, p["power_max"])
            else:
                power = sagging_power(commanded, ratio, self.thrust_exponent)
            return power + p["electronics"]

        first = at.inner[-2]
        slope = at.inner[-1]
        source = first + slope * at.inner[CHARGE] - p["rc_share"] * at.inner[RC_VOLTAGE]
        falls = -slope * charge_after(0, 1, p["capacity"], at.step / 2)  # E to the middle of the step, a ampere
        resistance = p["resistance"] + (1 - p["rc_share"]) * p["rc_resistance"] + falls
        return operating_point(source, resistance, at.inner[VOLTAGE], thrust_at, power_at)
