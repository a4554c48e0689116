"""Mistakes in a user's class that Python takes without a word; they are said when its option is read.

keys without @dataclass           its fields are no keys, and no numbers
a method that nothing calls       `aftr` for `after`, `loged` for `logged`: the part would do less than it says
none of the methods that count    `Part.hooks`: the part would do nothing
"""

from __future__ import annotations

from dataclasses import Field
from difflib import get_close_matches
from functools import lru_cache
from types import CodeType
from typing import Any

from quadexp.errors import UsageError
from quadexp.messages import note
from quadexp.names import named

ALIKE = 0.8  # of 1: likeness of two names from which one is a mistake for the other


@lru_cache(256)
def check_own_class(kind: Any, own: str) -> None:
    """Say what is wrong with a user's class. own: the package whose classes are none of the user's.

    Raises UsageError where it cannot be meant; a name that may be mistaken is a note."""
    path = f"{kind.__module__}.{kind.__qualname__}"
    shipped = [base for base in kind.__mro__ if base.__module__.partition(".")[0] == own]
    classes = [base for base in kind.__mro__[: kind.__mro__.index(shipped[0])] if base.__module__ != "builtins"]
    for base in classes:
        keys = [name for name, value in vars(base).items() if isinstance(value, Field)]
        if keys:
            decorator = "@dataclass(frozen=True, kw_only=True)"
            raise UsageError(f"{path}: {', '.join(keys)}: a class with keys needs {decorator} above it")
        if "name" in vars(base).get("__annotations__", {}):
            raise UsageError(f"{path}.name: every part has it, the name in tables: call the key otherwise")
    mistaken = _mistaken(classes, shipped)
    seam = next(base for base in shipped if "hooks" in vars(base))
    if seam.hooks and all(getattr(kind, name) is getattr(seam, name) for name in seam.hooks):
        has = f"; it has {', '.join(mistaken)}" if mistaken else ""
        raise UsageError(f"{path}: does nothing: it needs one of {', '.join(seam.hooks)}{has}")
    for name, meant in mistaken.items():
        note(f"{path}: nothing calls {name}; did you mean {meant}?")


def _mistaken(classes: list[Any], shipped: list[Any]) -> dict[str, str]:
    """Names of a user's classes that are almost one of the bases, which these classes have not -> that one. One that
    the classes use themselves is none."""
    own = {name: value for base in reversed(classes) for name, value in vars(base).items()}
    fields = [name for base in classes for name in vars(base).get("__annotations__", ())]
    known = {name for base in shipped for name in vars(base) if not name.startswith("_")}
    used = {name for value in own.values() for name in _names(value)}
    candidates = [name for name in own if not name.startswith("_") and name not in (*known, *fields, *used)]
    near = [get_close_matches(name, sorted(known - own.keys()), 1, ALIKE) for name in candidates]
    return {name: match[0] for name, match in named(candidates, near).items() if match}


def _names(value: Any) -> tuple[str, ...]:
    """Names of attributes that a method, or what is inside it, uses."""
    function = getattr(value, "fget", None) or getattr(value, "func", None) or getattr(value, "__func__", value)
    code = getattr(function, "__code__", value)
    if not isinstance(code, CodeType):
        return ()
    inside = [name for constant in code.co_consts for name in _names(constant)]
    return (*code.co_names, *inside)
