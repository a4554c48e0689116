"""The type of the variables in an equation, and limits of them."""

from __future__ import annotations

from typing import Any, TypeAlias

from quadexp.compile.symbolic import ca

Expression: TypeAlias = Any
"""A CasADi SX, MX or DM, a numpy array, or a float: an equation accepts any of them and returns the same type.

CasADi's three types share no base class, so the type checker sees Any; shapes, units and frames are in the docstrings.
"""


def limited(value: Expression, low: Expression, high: Expression) -> Expression:
    """The value, or the end of [low, high] that it lies beyond; element by element."""
    return ca.fmin(ca.fmax(value, low), high)
