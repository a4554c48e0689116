"""CasADi, imported when an expression is first written: naming a part, or driving a sweep, costs nothing of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__all__ = ["ca"]

if TYPE_CHECKING:
    import casadi as ca
else:
    from quadexp.compile.signals import undisturbed

    class _CasADi:
        def __getattr__(self, name: str) -> Any:
            with undisturbed():  # its bare `except` would swallow the exception, and the command would go on
                import casadi

            attribute = getattr(casadi, name)
            setattr(self, name, attribute)  # the next time it is at hand
            return attribute

    ca = _CasADi()
