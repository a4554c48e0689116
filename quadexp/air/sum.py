"""The sum of several residual models: y = y_1 + y_2 + .., dy/dz likewise, theta one after the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadexp.air.base import Residual
from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError


def sum_residual(parts: Sequence[Residual]) -> Residual:
    """The sum of residuals of one vehicle; a single one is returned as it is.

    name: the names with "+" between; source likewise. ranges: inside only what all parts were fitted to.
    Raises UsageError where there is none, or where they are of vehicles with different numbers of rotors.
    """
    if not parts:
        raise UsageError("a sum of residuals needs at least one")
    if len(parts) == 1:
        return parts[0]
    if len({part.function.size1_in(0) for part in parts}) > 1:
        raise UsageError("a sum of residuals: the parts are of vehicles with different numbers of rotors")
    sizes = [len(part.theta) for part in parts]
    function = _sum_function([part.function for part in parts], sizes)
    own_form = any(part.to_compile is not None for part in parts)
    to_compile = _sum_function([part.to_compile or part.function for part in parts], sizes) if own_form else None
    theta = np.concatenate([part.theta for part in parts])
    sources = list(dict.fromkeys(part.source for part in parts if part.source))
    return Residual(
        "+".join(part.name for part in parts), function, theta, "+".join(sources), to_compile, _common_ranges(parts)
    )


def _sum_function(functions: Sequence[ca.Function], sizes: Sequence[int]) -> ca.Function:
    z, theta = ca.MX.sym("z", functions[0].size1_in(0)), ca.MX.sym("theta", sum(sizes))
    values = [f(z, own) for f, own in zip(functions, ca.vertsplit(theta, np.cumsum([0, *sizes]).tolist()), strict=True)]
    results = [sum(found[1:], found[0]) for found in zip(*values, strict=True)]
    return ca.Function("residual_sum", [z, theta], results, ["z", "theta"], ["y", "dy_dz"])


def _common_ranges(parts: Sequence[Residual]) -> dict[str, list[float]] | None:
    """Feature -> the range that all parts with this feature share; None where none has ranges."""
    known = [part.ranges for part in parts if part.ranges]
    common: dict[str, list[float]] = {}
    for ranges in known:
        for name, (low, high) in ranges.items():
            least, largest = common.get(name, (low, high))
            common[name] = [max(least, low), min(largest, high)]
    return common or None
