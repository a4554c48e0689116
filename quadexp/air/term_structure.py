"""Which terms a sum of quadexp.air.term_equations has, and the constants that they need."""

from __future__ import annotations

from typing import NamedTuple


class TermStructure(NamedTuple):
    """terms: names per axis. mass: kg, that rotor thrusts are divided by. momentum: kappa, 1/m, 0 where unknown."""

    terms: tuple[tuple[str, ...], ...]
    mass: float
    momentum: float | tuple[float, ...] = 0.0

    @property
    def n_parameters(self) -> int:
        return sum(map(len, self.terms))
