"""Rotors that lose part of their thrust at a time: T_i = f u_i from t on, f of the last loss that has begun.

Inner states: what is logged of the rotors (n,), see actuator.py. Parameters: thrust coefficient, then t (s) and
factor of every loss.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle
from quadexp.world.actuator import first_rotor_column, rotor_column, rotor_column_factor, rotor_column_names
from quadexp.world.effect import Clock, Effect, Moment, Sizes, Start

FAILURE = ("rotor", "t", "factor")

ROUNDING = 1e-9  # s; a loss at the beginning of a step acts in it


@keyed
class RotorLoss(Effect):
    """Rotors that lose part of their thrust."""

    prefix = "health."

    losses: tuple[Any, ...] = key(
        (), "{rotor: number from 0, t: s, factor: share of its thrust that it has from then on} each"
    )

    def check_together(self) -> None:
        for loss in self.losses:
            if not isinstance(loss, Mapping) or {*loss} != {*FAILURE}:
                losses = sorted(loss) if isinstance(loss, Mapping) else loss
                raise UsageError(f"health.losses: {losses}; each loss is {{rotor: number, t: s, factor: 0 .. 1}}")
            numbers = [loss[name] for name in FAILURE]
            if not all(isinstance(number, int | float) and not isinstance(number, bool) for number in numbers):
                raise UsageError(f"health.losses: rotor, t and factor are {numbers}, all must be numbers")
            if int(loss["rotor"]) != loss["rotor"] or loss["rotor"] < 0:
                raise UsageError(f"health.losses: rotor {loss['rotor']}: must be a rotor's number, from 0")
            if not 0 <= loss["factor"] <= 2 or not 0 <= loss["t"] < float("inf"):
                raise UsageError(
                    f"health.losses: t {loss['t']} and factor {loss['factor']}: t must not be negative, the factor in"
                    " [0, 2]"
                )

    stage = "health"

    @property
    def _ordered(self) -> list[Mapping[str, Any]]:
        return sorted(self.losses, key=lambda loss: loss["t"])

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        """Raises UsageError for a rotor that the vehicle does not have."""
        for loss in self.losses:
            if loss["rotor"] >= vehicle.n_rotors:
                raise UsageError(
                    f"health.losses: rotor {loss['rotor']}: vehicle={vehicle.name} has rotors 0 to"
                    f" {vehicle.n_rotors - 1}"
                )
        return Sizes(inner=vehicle.n_rotors, parameters=1 + 2 * len(self.losses))

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        numbers = [float(loss[name]) for loss in self._ordered for name in ("t", "factor")]
        return first_rotor_column(start.vehicle, start.thrust), [rotor_column_factor(start.vehicle), *numbers]

    def columns(self, clock: Clock, vehicle: Vehicle) -> Mapping[str, int]:
        return rotor_column_names(vehicle, 0)

    def thrusts(self, at: Moment) -> Expression:
        factors = [type(at.command)(1) for _ in range(at.command.numel())]
        for i, loss in enumerate(self._ordered):
            begins = at.parameters[1 + 2 * i]
            factor = at.parameters[2 + 2 * i]
            rotor = int(loss["rotor"])
            factors[rotor] = ca.if_else(at.t >= begins - ROUNDING, factor, factors[rotor])
        return at.command * ca.vertcat(*factors)

    def advance(self, at: Moment) -> Expression:
        return rotor_column(self.thrusts(at), at.parameters[0])

    @property
    def idle(self) -> bool:
        return not self.losses
