"""The type of the variables in an equation."""

from __future__ import annotations

from typing import Any, TypeAlias

Expression: TypeAlias = Any
"""A CasADi SX, MX or DM, a numpy array, or a float: an equation accepts any of them and returns the same type.

CasADi's three types share no base class, so the type checker sees Any; shapes, units and frames are in the docstrings.
"""
