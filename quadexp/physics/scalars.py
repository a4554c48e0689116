"""Evaluation of part of a CasADi matrix graph as one function of scalar operations, without structural zeros."""

from __future__ import annotations

from collections.abc import Callable

from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression


def as_scalars(f: Callable[..., Expression]) -> Callable[..., Expression]:
    """f, which maps CasADi expressions to one or several others, wrapped to enter a graph as one SX function."""

    def call(*arguments: Expression) -> Expression:
        symbols = [ca.SX.sym(f"a{i}", argument.sparsity()) for i, argument in enumerate(arguments)]
        results = f(*symbols)
        if not isinstance(results, (list, tuple)):
            results = [results]
        function = ca.Function(f.__name__.strip("_"), symbols, ca.cse([*results]))
        return function(*arguments)

    return call
