"""What the hooks of effects give, checked: a user's effect says in one line what is wrong with it."""

from __future__ import annotations

from difflib import get_close_matches
from typing import Any

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.parts.own_class import ALIKE
from quadexp.physics.expression import NAN, Expression, holds_nan
from quadexp.world.effect import Effect, Measured, Readings

READINGS = {"state": 13, "specific_force": 3}  # what every controller is given


def asked(effect: Effect, hook: str, *given: Any, sizes: tuple[int, ...]) -> Any:
    """What a hook gives, as columns of these sizes: one, or as many as there are sizes.

    Raises UsageError where it gives something else."""
    said = f"{effect.stage}={effect.name}: {hook}"
    values = getattr(effect, hook)(*given)
    if len(sizes) == 1:
        return _column(effect, said, values, sizes[0])
    if not isinstance(values, (tuple, list)) or len(values) != len(sizes):
        raise UsageError(f"{said} must return {len(sizes)} vectors, not a {type(values).__name__}")
    return [_column(effect, said, value, size) for value, size in zip(values, sizes, strict=True)]


def _column(effect: Effect, said: str, value: Any, size: int) -> Expression:
    try:
        column = value if isinstance(value, (ca.SX, ca.MX)) else ca.DM(value)
    except NotImplementedError:
        raise UsageError(f"{said} must return numbers or expressions, not a {type(value).__name__}") from None
    if column.numel() != size or min(column.shape) > 1:
        raise UsageError(f"{said} returns {column.numel()} numbers; {size} are needed")
    if not effect.shipped and not isinstance(column, ca.MX) and holds_nan(ca.SX(column)):
        raise UsageError(f"equations of {said}: {NAN}")
    return column if column.size2() == 1 else column.T


def measured_by(
    effect: Effect, seen: Readings, own: tuple[Any, Any, Any], measured: Measured
) -> tuple[Expression, Measured]:
    """What `measure` gives: inner states and readings. own: the effect's inner states, parameters and draws.

    Raises UsageError where it gives something else."""
    inner_now, parameters, draws = own
    seen = seen._replace(inner=inner_now, parameters=parameters, draws=draws)
    said = f"{effect.stage}={effect.name}: measure"
    values = effect.measure(seen, measured)
    if not isinstance(values, tuple) or len(values) != 2 or not isinstance(values[1], dict):
        raise UsageError(f"{said} must return at.inner, as it is now, and the dict of what is measured")
    inner, after = values
    for name, size in READINGS.items():
        if name not in after:
            raise UsageError(f"{said} leaves out {name!r}")
        if after[name].numel() != size:
            raise UsageError(f"{said} gives {after[name].numel()} numbers for {name!r}; {size} are needed")
    for name in after.keys() - measured.keys():
        near = get_close_matches(name, READINGS, 1, ALIKE)
        if near:
            raise UsageError(f"{said} gives {name!r}, which nothing reads; did you mean {near[0]!r}?")
    return _column(effect, said, inner, seen.inner.numel()), after
