"""Named symbols, and functions of them.

x, u = symbols(ca.SX, x=N_STATE, u=n)
given = named_symbols(ca.MX, {"x": (N_STATE, 1), "path": (3, 5)})
return named_function("law", given, {"command": command})
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from quadexp.compile.symbolic import ca
from quadexp.names import named


def symbols(kind: Any, **shapes: Any) -> list[Any]:
    """Symbols under these names. kind: ca.SX or ca.MX. shapes: a length, (rows, columns), or a sparsity."""
    return list(named_symbols(kind, shapes).values())


def named_symbols(kind: Any, shapes: Mapping[str, Any]) -> dict[str, Any]:
    """The same by name."""
    return {
        name: kind.sym(name, *shape) if isinstance(shape, tuple) else kind.sym(name, shape)
        for name, shape in shapes.items()
    }


def named_function(name: str, inputs: Mapping[str, Any], outputs: Mapping[str, Any]) -> ca.Function:
    """The CasADi function of symbols by name, whose inputs and outputs have these names."""
    return ca.Function(name, [*inputs.values()], [*outputs.values()], [*inputs], [*outputs])


def dense_function(name: str, inputs: Mapping[str, Any], outputs: Mapping[str, Any]) -> ca.Function:
    """The same with dense outputs; what several of them need is computed once."""
    values = ca.cse([ca.densify(value) for value in outputs.values()])
    return named_function(name, inputs, named(outputs, values))
