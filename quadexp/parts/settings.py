"""A setting is declared once: its type, range, unit and meaning beside its name, its default behind it.

    horizon: float = key(1.0, "length of the prediction", "(0, 10]", "s")

The keys of the configuration, their checks, the completion and `quadexp options` are made from these declarations,
and the object that is configured inherits them: `class MPCSettings(MPCKeys)`. So a value is checked by the same rule
whether it is given on the command line, in a file, or in Python:

    trajectory.speed=-3: must be in (0, 60] m/s

Nothing heavy is imported here: worker processes and the completion of the command line load this module.
"""

from __future__ import annotations

import contextlib
import functools
import json
import re
from collections.abc import Hashable, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields
from math import isfinite
from types import NoneType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

from quadexp.errors import ForbiddenValueError, UsageError
from quadexp.messages import suggestion
from quadexp.names import is_name

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

REQUIRED = "???"  # stands in a configuration file for a value that its user has to give
_INTERVAL = re.compile(r"([\[(])\s*(\S+?),\s*(\S+?)\s*([\])])")
_WORDS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}

Triple = tuple[float, float, float]
SEEDS = "[0, 4294967295]"  # interval of every seed


T = TypeVar("T")


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(field,))
def keyed(kind: type[T]) -> type[T]:
    """A class as a frozen dataclass whose values are given by name, as all settings are."""
    return dataclass(frozen=True, kw_only=True)(kind)


@dataclass(frozen=True)
class Setting:
    """What a value means, the interval it must lie in (of a list: each number), its unit, whether it names a thing, as
    one printable line. noise: whether another value gives a flight other noise; a key of a vehicle, plant or trajectory
    that came after the first flights were stored says no. words: of a text, the only ones allowed.
    options: of a text or a list, the group whose options it names, or one of the words `also` (parts/models.py).

    when: of its part, the key (KEY, which must not be 0, or KEY=VALUE) without which it has no effect.
    tuned: what a search of settings varies of it unless set otherwise: LOW..HIGH, LOW..HIGH:log, or .PART=LOW..HIGH of
    entries of a list or of a key below; several are separated by blanks."""

    meaning: str
    interval: str = ""
    unit: str = ""
    names: bool = False
    noise: bool = True
    words: tuple[str, ...] = ()
    options: str = ""
    also: tuple[str, ...] = ()
    tuned: str = ""
    when: str = ""


def key(default: Any, meaning: str | Setting, *about: Any, **more: Any) -> Any:
    """A field of a class of settings: its default, REQUIRED for none, and what Setting says of it, or a Setting."""
    setting = meaning if isinstance(meaning, Setting) else Setting(meaning, *about, **more)
    kept = isinstance(default, (Hashable, dict))
    if not kept:
        raise UsageError(
            f"a key ({setting.meaning}): its default is a {type(default).__name__}; write a tuple, such as (1.0, 2.0),"
            " and the type tuple[float, ...]"
        )
    default_value = {} if default is REQUIRED else {"default": default}
    if isinstance(default, dict):
        default_value = {"default_factory": default.copy}
    return field(metadata={"setting": setting}, **default_value)


# Settings that several parts have.
Name = Annotated[str, Setting("name in tables and figures", names=True, noise=False)]
Backend = Annotated[
    Literal["auto", "compiled", "interpreted"],
    Setting("C code compiled once and kept, CasADi's interpreter, or compiled where there is a compiler", noise=False),
]


@dataclass(frozen=True)
class Declared:
    """A setting with the type of its value. optional: may be None. words: the only values allowed, if not empty.
    length: of a list, 0 for any."""

    name: str
    type: Any
    setting: Setting
    optional: bool
    words: tuple[str, ...]
    length: int
    field: Field[Any]

    @property
    def required(self) -> bool:
        return self.field.default is MISSING and self.field.default_factory is MISSING

    @property
    def default(self) -> Any:
        """The default; REQUIRED where there is none."""
        if self.field.default is not MISSING:
            return self.field.default
        return REQUIRED if self.field.default_factory is MISSING else self.field.default_factory()

    @property
    def node(self) -> type[Settings] | None:
        """The class of the settings that stand below this key, None for a plain value."""
        return self.type if isinstance(self.type, type) and issubclass(self.type, Settings) else None


@dataclass(frozen=True)
class Settings:
    """Base of all that declares settings. prefix: how the keys of this node begin.

    Lists become tuples and numbers get the declared type. Raises UsageError where a value is none that is allowed.
    """

    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        for name, about in declared(type(self)).items():
            object.__setattr__(self, name, _checked(f"{self.prefix}{name}", getattr(self, name), about))
        self.check_together()

    def check_together(self) -> None:
        """Raise UsageError where values, each of which is allowed, contradict each other."""


S = TypeVar("S", bound="DataclassInstance")


def changed(settings: S, **values: Any) -> S:
    """The same with other values, which the program itself has computed: they are not checked, which takes longer than
    what is done with them in flight."""
    other: S = object.__new__(type(settings))
    other.__dict__.update(settings.__dict__, **values)
    return other


def declared(node: type) -> dict[str, Declared]:
    """The settings of a class by name, in the order of its fields; a field without a Setting is none."""
    return _declared(node)


@functools.cache
def _declared(node: type) -> dict[str, Declared]:
    hints = get_type_hints(node, include_extras=True)
    settings = {}
    for f in fields(node):
        kinds, *extras = get_args(hints[f.name]) if get_origin(hints[f.name]) is Annotated else (hints[f.name],)
        setting = f.metadata.get("setting") or next((extra for extra in extras if isinstance(extra, Setting)), None)
        if setting is None:
            continue
        optional = NoneType in get_args(kinds)
        kind = next(k for k in get_args(kinds) if k is not NoneType) if optional else kinds
        arguments = get_args(kind)
        origin = get_origin(kind)
        words = arguments if origin is Literal else setting.words
        length = len(arguments) if origin is tuple and arguments[-1] is not Ellipsis else 0
        path = f"{node.__qualname__}.{f.name}"
        if setting.interval and not _INTERVAL.fullmatch(setting.interval):
            raise UsageError(f"{path}: its range is {setting.interval!r}; write [0, 100], or (0, 100] without 0")
        if (origin or kind) in (list, set, tuple) and not (origin is tuple and arguments):
            raise UsageError(f"{path}: its type is a {(origin or kind).__name__}; write tuple[float, ...]")
        settings[f.name] = Declared(f.name, kind, setting, optional, words, length, f)
    return settings


def find(node: type, path: str) -> Declared | None:
    """The setting of a dotted key below a class; None where there is none."""
    name, _, rest = path.partition(".")
    about = declared(node).get(name)
    if about is None or not rest:
        return about
    return find(about.node, rest) if about.node else None


def keys_of(node: type) -> list[str]:
    """Names of the keys of a class; of the root also the groups. An object's fields besides its settings are none."""
    return list(declared(node)) if getattr(node, "prefix", "") else [f.name for f in fields(node)]


def made(node: type[S], values: Mapping[str, Any], prefix: str | None = None) -> S:
    """Settings from plain values, as they are in a configuration file.

    Raises UsageError where there is no such key, a value is missing, or a value is none that is allowed.
    """
    prefix = getattr(node, "prefix", "") if prefix is None else prefix
    names = keys_of(node)
    for name in values:
        if name not in names:
            raise UsageError(f"{prefix}{name}: no such key{suggestion(str(name), names)}")
    lacking = _lacking(node, values, prefix)
    if len(lacking) == 1:
        raise UsageError(f"{lacking[0]}: has no value; give {lacking[0]}=VALUE")
    if lacking:
        raise UsageError(f"{', '.join(lacking)}: have no value; give each as KEY=VALUE, or in the option's file")
    stated = dict(values)
    for name, key in declared(node).items():
        if key.node and isinstance(stated.get(name), Mapping):
            stated[name] = made(key.node, stated[name])
    return node(**stated)


def _lacking(node: type, values: Mapping[str, Any], prefix: str) -> list[str]:
    """Keys that have to be given and are not, those of inner nodes too, sorted."""
    lacking = []
    for name, key in declared(node).items():
        value = values.get(name, REQUIRED if key.required else None)
        if key.node and isinstance(value, Mapping):
            lacking += _lacking(key.node, value, f"{prefix}{name}.")
        elif isinstance(value, str) and value == REQUIRED:
            lacking.append(f"{prefix}{name}")
    return sorted(lacking)


def plain(node: type) -> dict[str, Any]:
    """The defaults of a class as a configuration file would state them; REQUIRED where there is none."""
    defaults: dict[str, Any] = {}
    keys = declared(node)
    others = {f.name: f.default for f in fields(node)}
    for name in keys_of(node):
        key = keys.get(name)
        if key and key.node and not key.optional:
            defaults[name] = plain(key.node)
        else:
            default = key.default if key else others[name]
            defaults[name] = REQUIRED if default is MISSING else lists(default)
    return defaults


def part(node: type[S], settings: Any, **others: Any) -> S:
    """The object that some settings configure, from all those of its fields that the settings have, and others."""
    shared = {f.name: getattr(settings, f.name) for f in fields(node) if hasattr(settings, f.name)}
    return node(**shared | others)


def record(settings: Settings) -> dict[str, Any]:
    """Settings as plain dictionaries and lists, for files and hashes."""
    values = {name: getattr(settings, name) for name in keys_of(type(settings))}
    return {name: record(value) if isinstance(value, Settings) else lists(value) for name, value in values.items()}


def lists(value: Any) -> Any:
    """A value with lists for tuples, at any depth."""
    if isinstance(value, (float, str, int)):  # most; whether it is a Mapping takes long to find out
        return value
    if isinstance(value, Mapping):
        return {key: lists(item) for key, item in value.items()}
    return [lists(item) for item in value] if isinstance(value, (list, tuple)) else value


def flat(value: Any, prefix: str = "") -> dict[str, Any]:
    """Nested mappings as dotted keys."""
    if not isinstance(value, Mapping):
        return {prefix[:-1]: value}
    return {key: item for name, inner in value.items() for key, item in flat(inner, f"{prefix}{name}.").items()}


def canonical_text(value: Any) -> str:
    """A value as a text, the same for all its spellings: 1 of 1.0, [1,0] of (1.0, 0), true of True; a text as it is."""
    if isinstance(value, str):
        return value

    def shortest(text: str) -> float:
        number = float(text)
        return int(number) if number.is_integer() else number

    return json.dumps(json.loads(json.dumps(value, default=str), parse_float=shortest), separators=(",", ":"))


def read_value(text: str) -> Any:
    """The value of an override's text: a number, true, false, null (None), or a text; of a list its canonical text."""
    text = text.strip()
    if text.startswith("["):
        with contextlib.suppress(ValueError):
            return canonical_text(json.loads(text))
    words = {"true": True, "false": False, "null": None}
    if text.lower() in words:
        return words[text.lower()]
    try:
        number = float(text)
    except ValueError:
        quoted = len(text) > 1 and text[0] == text[-1] and text[0] in "'\""
        unquoted = text[1:-1] if quoted else text.replace(", ", ",")
        return re.sub(r"\\([\W])", r"\1", unquoted)  # a sign that means something in the grammar of overrides
    return int(number) if number.is_integer() and "." not in text and "e" not in text.lower() else number


# ------------------------------------------------------------------------------------------------------------ checks
def _checked(key: str, value: Any, about: Declared) -> Any:
    """The value in its declared type; ForbiddenValueError where it is none that is allowed."""
    if value is None and about.optional:
        return None
    value = _typed(key, value, about.type)
    interval = about.setting.interval
    unit = about.setting.unit
    if about.words and value not in about.words:
        raise ForbiddenValueError(f"{key}={value}: must be one of {', '.join(about.words)}")
    if about.length and len(value) != about.length and not _is_rows(about.type):
        raise ForbiddenValueError(f"{key}={shown(value)}: must be a list of {about.length} numbers")
    if about.setting.names and not is_name(value):
        raise ForbiddenValueError(f"{key}={value!r}: must be one printable line")
    numbers = value if isinstance(value, tuple) else (value,)
    for number in numbers if interval else ():
        if not inside(number, interval):
            raise ForbiddenValueError(f"{key}={shown(value)}: must be in {interval} {unit}".rstrip())
    return value


def _typed(key: str, value: Any, kind: Any) -> Any:
    if kind in (int, float):
        needed = "a whole number" if kind is int else "a number"
        try:
            if not isinstance(value, bool) and (kind is float or not isinstance(value, float)):
                return kind(value)
        except (TypeError, ValueError, OverflowError):
            value = shown(value)
    elif kind is bool:
        needed = "true or false"
        if str(value).lower() in _WORDS:
            return _WORDS[str(value).lower()]
    elif kind is str or get_origin(kind) is Literal:
        needed = "a text"
        if value is not None and not isinstance(value, (list, tuple, Mapping)):
            return str(value)
    elif _is_rows(kind):
        arguments = get_args(kind)
        count = None if arguments[-1] is Ellipsis else len(arguments)
        needed = f"{count or 'some'} rows of 3 numbers each"
        with contextlib.suppress(TypeError, ValueError):
            rows = tuple(tuple(float(item) for item in row) for row in value)
            if rows and count in (None, len(rows)) and all(len(row) == 3 and all(map(isfinite, row)) for row in rows):
                return rows
    elif get_origin(kind) is tuple:
        arguments = get_args(kind)
        if not isinstance(value, (str, Mapping)) and hasattr(value, "__iter__"):
            return tuple(_typed(f"{key}[{i}]", item, arguments[0]) for i, item in enumerate(value))
        length = "" if arguments[-1] is Ellipsis else f"{len(arguments)} "
        needed = f"a list of {length}numbers" if arguments[0] is float else "a list"
    elif not isinstance(kind, type) or not issubclass(kind, Settings) or isinstance(value, kind):
        return value
    else:
        raise ForbiddenValueError(f"{key}={shown(value)}: must hold keys and values")
    raise ForbiddenValueError(f"{key}={shown(value)}: must be {needed}")


def _is_rows(kind: Any) -> bool:
    """Whether a type is that of rows of numbers, such as a matrix."""
    return get_origin(kind) is tuple and get_origin(get_args(kind)[0]) is tuple


def inside(value: float, interval: str) -> bool:
    """Whether a number lies in an interval such as "(0, 60]"."""
    from_low, low, high, to_high = _ends(interval)
    return (low < value or (from_low and value == low)) and (value < high or (to_high and value == high))


@functools.cache
def _ends(interval: str) -> tuple[bool, float, float, bool]:
    """Whether the lower end belongs to it, both ends, and whether the upper one does."""
    match = _INTERVAL.fullmatch(interval)
    assert match is not None, interval
    return match[1] == "[", float(match[2]), float(match[3]), match[4] == "]"


def shown(value: Any) -> str:
    """A value as an override has it."""
    if value is None:
        return "null"
    return value if isinstance(value, str) else str(lists(value)).replace(" ", "")
