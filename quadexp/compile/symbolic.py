"""CasADi, imported when an expression is first written: naming a part, or driving a sweep, costs nothing of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__all__ = ["ca"]

if TYPE_CHECKING:
    import casadi as ca
else:

    class _CasADi:
        def __getattr__(self, name: str) -> Any:
            import casadi

            attribute = getattr(casadi, name)
            setattr(self, name, attribute)  # the next time it is at hand
            return attribute

    ca = _CasADi()
