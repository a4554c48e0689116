"""The type of what an equation is written in."""

from __future__ import annotations

from typing import Any, TypeAlias

# A CasADi SX, MX or DM, a numpy array, or a float: an equation works on any of them and gives back the same kind. CasADi
# is seen as untyped by the type checker, and its three kinds share no base class; docstrings give shapes and units.
Expression: TypeAlias = Any
