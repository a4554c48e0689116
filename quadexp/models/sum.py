"""Residuals made of others: the sum y = y_1 + y_2 + .., and y = s y_1 with a scale that may change in flight.

Derivatives likewise; the parameters stand one after the other, the scale s last. Another density of the air, or more
area in it, scales drag as a whole; an observer that finds s tells the controller what the air will do where the vehicle
is going to be, which a force that is found where it is now does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.models.base import Residual


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

    sources = dict.fromkeys(part.source for part in parts if part.source)
    ranges: dict[str, list[float]] = {}
    for part in parts:
        for name, (low, high) in (part.ranges or {}).items():
            least, largest = ranges.get(name, (low, high))
            ranges[name] = [max(least, low), min(largest, high)]
    theta = np.concatenate([part.theta for part in parts])
    function = _sum([part.function for part in parts], parts)
    to_compile = None
    if any(part.to_compile is not None for part in parts):
        to_compile = _sum([part.to_compile or part.function for part in parts], parts)
    return Residual(
        "+".join(part.name for part in parts), function, theta, "+".join(sources), to_compile, ranges or None
    )


def _sum(functions: Sequence[ca.Function], parts: Sequence[Residual]) -> ca.Function:
    ends = np.cumsum([0, *(len(part.theta) for part in parts)]).tolist()
    z, theta = ca.MX.sym("z", functions[0].size1_in(0)), ca.MX.sym("theta", ends[-1])
    values = [function(z, own) for function, own in zip(functions, ca.vertsplit(theta, ends), strict=True)]
    results = [sum(terms[1:], terms[0]) for terms in zip(*values, strict=True)]
    return ca.Function("residual_sum", [z, theta], results, ["z", "theta"], ["y", "dy_dz"])


def scaled_residual(residual: Residual) -> Residual:
    """The residual with a scale behind its parameters, 1 at first; `unscaled` is the residual itself."""

    def scaled(function: ca.Function) -> ca.Function:
        z, theta = ca.MX.sym("z", function.size1_in(0)), ca.MX.sym("theta", function.size1_in(1) + 1)
        results = [theta[-1] * value for value in function(z, theta[:-1])]
        return ca.Function("residual_scaled", [z, theta], results, ["z", "theta"], ["y", "dy_dz"])

    to_compile = None if residual.to_compile is None else scaled(residual.to_compile)
    theta = np.append(residual.theta, 1.0)
    return replace(residual, theta=theta, function=scaled(residual.function), to_compile=to_compile, unscaled=residual)
