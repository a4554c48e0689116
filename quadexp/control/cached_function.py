"""CasADi functions on a back end, built once per process and structure."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Hashable
from typing import Any

from quadexp.compile.backend import realise, realise_together, resolve
from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError

MOST = 256  # functions that are kept

_functions: dict[tuple[Hashable, ...], Any] = {}


def cached_function(backend: str, make: Callable[..., Any], *arguments: Any, **form: Any) -> Any:
    """What make(*arguments, **form) gives, on a back end where it is a function or a list of functions.

    Vehicles count by their numbers, residuals and functions by their structure: parameters may be others. A user's part
    among the arguments is asked twice; UsageError where it gives something else then.
    """
    key = (make, backend, *map(_structure, arguments), *form.items())
    functions = _functions.get(key)
    if functions is None:
        functions = make(*arguments, **form)
        parts = [part for part in arguments if not hasattr(part, "fingerprint")]
        own = [type(part).__name__ for part in parts if not getattr(part, "shipped", True)]
        if own and pickle.dumps(functions) != pickle.dumps(make(*arguments, **form)):
            said = f"equations of {own[0]}: differ from call to call"
            raise UsageError(f"{said}; let them follow from keys, inputs and memory alone")
        if isinstance(functions, (list, tuple)):
            functions = realise_together(functions, resolve(backend))
        elif isinstance(functions, ca.Function):
            functions = realise(functions, resolve(backend))
        for oldest in list(_functions)[: len(_functions) + 1 - MOST]:  # another thread may have gone before
            _functions.pop(oldest, None)
        _functions[key] = functions
    return functions


def _structure(argument: Any) -> Hashable:
    if hasattr(argument, "fingerprint"):
        return str(argument.fingerprint)
    function = getattr(argument, "function", argument)
    if hasattr(function, "serialize"):
        return str(function.serialize())
    try:
        hash(argument)
    except TypeError:  # a part with a key that is a dict
        return type(argument), pickle.dumps(argument)
    hashable: Hashable = argument
    return hashable
