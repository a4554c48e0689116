"""The type of the variables in an equation, their limits, and parts of them."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import accumulate
from typing import Any, TypeAlias

from quadexp.compile.symbolic import ca

Expression: TypeAlias = Any
"""A CasADi SX, MX or DM, a numpy array, or a float: an equation accepts any of them and returns the same type.

CasADi's three types share no base class, so the type checker sees Any; shapes, units and frames are in the docstrings.
"""


def limited(value: Expression, low: Expression, high: Expression) -> Expression:
    """The value, or the end of [low, high] that it lies beyond; element by element."""
    return ca.fmin(ca.fmax(value, low), high)


def split(vector: Expression, sizes: Iterable[int]) -> list[Expression]:
    """The parts of a vector, of these sizes."""
    return list(ca.vertsplit(vector, [0, *accumulate(sizes)]))


def unit(vector: Expression) -> Expression:
    """The vector at unit length."""
    return vector / ca.norm_2(vector)
