"""Variables of equations: their type, symbols by name and functions of them, limits and parts.

x, u = symbols(ca.SX, x=N_STATE, u=n)
given = named_symbols(ca.MX, {"x": (N_STATE, 1), "path": (3, 5)})
return named_function("law", given, {"command": command})
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from itertools import accumulate
from typing import Any, TypeAlias

from quadexp.compile.symbolic import ca
from quadexp.names import named

Expression: TypeAlias = Any
"""A CasADi SX, MX or DM, a numpy array, or a float: an equation accepts any of them and returns the same type.

CasADi's three types share no base class, so the type checker sees Any; shapes, units and frames are in the docstrings.
"""


def limited(value: Expression, low: Expression, high: Expression) -> Expression:
    """The value, or the end of [low, high] that it lies beyond; element by element."""
    return ca.fmin(ca.fmax(value, low), high)


def holds_nan(value: Expression) -> bool:
    """Whether a number in an SX is NaN: this is what float and math.sqrt make of a symbol, without a word."""
    function = ca.Function("value", ca.symvar(value), [value])
    constants = (i for i in range(function.n_instructions()) if function.instruction_id(i) == ca.OP_CONST)
    return any(math.isnan(function.instruction_constant(i)) for i in constants)


NAN = "a number in them is NaN, as float and math.sqrt make one of an expression: write ca.sqrt"


def split(vector: Expression, sizes: Iterable[int]) -> list[Expression]:
    """The parts of a vector, of these sizes."""
    return list(ca.vertsplit(vector, [0, *accumulate(sizes)]))


def unit(vector: Expression) -> Expression:
    """The vector at unit length."""
    return vector / ca.norm_2(vector)


def symbols(kind: Any, **shapes: Any) -> list[Any]:
    """Symbols under these names. kind: ca.SX or ca.MX. shapes: a length, (rows, columns), or a sparsity."""
    return list(named_symbols(kind, shapes).values())


def named_symbols(kind: Any, shapes: Mapping[str, Any]) -> dict[str, Any]:
    """The same by name."""
    by_name = {}
    for name, shape in shapes.items():
        if not isinstance(shape, tuple):
            shape = (shape,)
        by_name[name] = kind.sym(name, *shape)
    return by_name


def named_function(name: str, inputs: Mapping[str, Any], outputs: Mapping[str, Any]) -> ca.Function:
    """The CasADi function of symbols by name, whose inputs and outputs have these names."""
    return ca.Function(name, [*inputs.values()], [*outputs.values()], [*inputs], [*outputs])


def dense_function(name: str, inputs: Mapping[str, Any], outputs: Mapping[str, Any]) -> ca.Function:
    """The same with dense outputs; what several of them need is computed once."""
    values = ca.cse([ca.densify(value) for value in outputs.values()])
    return named_function(name, inputs, named(outputs, values))


class Answers:
    """What a function gives that is no expression of scalars, such as a compiled model, as symbols in one of scalars.

    function: of features and theta. Called with features, SX, it gives symbols for its results there.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self.asked = list[Any]()
        self.symbols = dict[str, Any]()

    def __call__(self, features: Any) -> list[Any]:
        self.asked.append(features)
        function = self.function
        names = [f"{name}_{len(self.asked)}" for name in function.name_out()]
        answers = [ca.SX.sym(name, function.sparsity_out(i)) for i, name in enumerate(names)]
        self.symbols |= named(names, answers)
        return answers

    def function_of(self, name: str, inputs: Mapping[str, Any], outputs: Mapping[str, Any]) -> ca.Function:
        """See dense_function: of inputs, which no answers are among, and `theta`."""
        features = ca.Function("features", [*inputs.values()], self.asked)
        rest = dense_function("rest", {**inputs, **self.symbols}, outputs)
        arguments = named_symbols(ca.MX, {of: symbol.shape for of, symbol in inputs.items()})
        theta = ca.MX.sym("theta", self.function.size1_in(1))
        given = [*arguments.values()]
        answers = [y for z in features.call(given) for y in self.function.call([z, theta])]
        return named_function(name, arguments | {"theta": theta}, named(outputs, rest.call(given + answers)))
