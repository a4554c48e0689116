"""The type of what an equation is written in."""

from __future__ import annotations

from typing import Any, TypeAlias

Expression: TypeAlias = Any
"""A CasADi SX, MX or DM, a numpy array, or a float: an equation works on any of them and gives back the same kind.

CasADi's three kinds share no base class, and which one comes is the caller's choice, so that the type checker takes it
for any type; shapes, units and frames stand in the docstrings.
"""
