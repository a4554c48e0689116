"""Overrides, KEY=VALUE: read and checked. Is it a key of this program, is there such an option.

They have Hydra's grammar. Its parser takes as long to import as all the rest of a plain command (0.16 s of processor
time), so a number, a word, a path, a list of them, several with commas between and range(a, b) are read here, with the
same result.
"""

from __future__ import annotations

import math
import os
import re
import shlex
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, get_args, get_origin

from quadexp.errors import UsageError
from quadexp.parts.former import setting
from quadexp.parts.options import OptionFiles
from quadexp.parts.schema import CHOSEN, CLASSES, Config
from quadexp.parts.settings import find

GROUPS = {*CHOSEN, "experiment"}  # keys that choose an option
RESERVED = {"hydra", "schema", "sweep"}  # names that mean something to Hydra, or in a file only
KEPT = 50_000  # overrides that are remembered at most
MOST_CELLS = 1_000_000  # of a sweep: more take hours and gigabytes before the first is flown

_KEY = re.compile(r"[a-z_]\w*(?:\.\w+)*", re.ASCII)
_INTEGER = re.compile(r"0|-?[1-9]\d{0,17}", re.ASCII)
_DECIMAL = re.compile(r"-?(?:0|[1-9]\d{0,14})\.\d{1,15}", re.ASCII)
_WORD = re.compile(r"(?:\.{0,2}/)*[A-Za-z](?:[\w./-]*\w)?", re.ASCII)
_RANGE = re.compile(r"range\((?:(\d{1,9}), ?)?(\d{1,9})\)", re.ASCII)
_QUOTED = re.compile(r"""\s*(["'])(?:\\.|(?!\1).)*\1\s*""")
ITEM = re.compile(r"\[[^\[\]]*\]|[^,\[\]]+")  # between commas: a list, or a value
ITEMS = re.compile(r"(?:\[[^\[\]]*\]|[^,\[\]])+")  # the same, of settings with lists among them
_BROUGHT = re.compile(r"\S +[a-z_][\w.]*=")  # a setting behind an option
_SAFE = re.compile(r"[\w./:+-]+", re.ASCII)  # text that needs no quotes
_NO_WORDS = {"null", "true", "false", "nan", "inf"}  # in any case of their letters


class Override(NamedTuple):
    """text: KEY=VALUE in its usual form. sweep: the values, as texts, where it stands for several."""

    key: str
    value: Any
    text: str
    sweep: Sequence[str] | range | None = None

    @property
    def node(self) -> str:
        return self.key.partition(".")[0]


def alternatives(overrides: Sequence[str]) -> list[list[str]]:
    """Overrides for each of several options, some of which bring settings of their own.

    `trajectory=hover,circle wind=gust` stands for trajectory=hover, and for trajectory=circle with wind=gust. What
    they bring cannot be given beside them too."""
    for i, text in enumerate(map(setting, overrides)):
        key, _, value = text.partition("=")
        if key not in GROUPS or not _BROUGHT.search(value):
            continue
        rest = [*overrides[:i], *overrides[i + 1 :]]
        stated = {other.partition("=")[0] for other in rest}
        combinations = list[list[str]]()
        for item in ITEMS.findall(value):
            try:
                option, *brought = shlex.split(item)
            except ValueError as error:
                raise UsageError(f"{text!r}: {item!r} cannot be read: {str(error).lower()}") from None
            twice = [word for word in brought if word.partition("=")[0] in stated]
            if twice:
                raise UsageError(f"{text!r}: {twice[0].partition('=')[0]} is given beside it too: give it in one place")
            combinations += alternatives([*rest, f"{key}={option}", *brought])
        return combinations
    return [list(overrides)]


class OverrideReader:
    """Reads each text once. files: whose groups and options there are."""

    def __init__(self, files: OptionFiles) -> None:
        self._files = files
        self._known: dict[str, Override] = {}

    def read(self, overrides: Sequence[str], *, sweep: bool = False) -> list[Override]:
        """The overrides; UsageError where one cannot be read, or has several values outside a sweep."""
        return [self._known.get(text) or self._read(setting(text), sweep) for text in overrides]

    def _read(self, text: str, sweep: bool) -> Override:
        key, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"{text!r}: expected KEY=VALUE, such as trajectory.speed=8")
        override = plain_override(text) or self._by_grammar(text)
        if re.split(r"[/.]", override.key)[0] in RESERVED:
            raise UsageError(f"{text!r}: not a key of this program; where to write is said by --out, how by engine=")
        if override.sweep is None:
            if override.key in GROUPS and not (override.value is None and override.key == "experiment"):
                option = self._option(override.key, override.value)
                override = Override(override.key, option, f"{override.key}={option}")
            if len(self._known) > KEPT:
                self._known.clear()
            self._known[text] = override
            return override
        if not override.sweep:
            raise UsageError(f"{text}: an empty range leaves nothing to fly")
        if not sweep:
            raise UsageError(f"{text!r}: several values for one key; use `quadexp evaluate --sweep` for that")
        if override.key in GROUPS:
            self.read([f"{override.key}={option}" for option in override.sweep])
        return override

    def _option(self, key: str, value: Any) -> str:
        option = self._files.named(key, value)
        if option is None:
            raise UsageError(f"{key}={value}: {self._files.why_not(key, value)}")
        return option

    def _by_grammar(self, text: str) -> Override:
        """An override by Hydra's grammar."""
        key, _, value = text.partition("=")
        parsed = self._parsed(text)
        calculated = "(" in _QUOTED.sub("", value)
        named = key in GROUPS and " " not in value  # options: 2024_01 is not the number 202401
        if (parsed is None or not calculated) and (named or self._is_text(key)):
            parsed = self._parsed(f"{key}={_literal(value)}") or parsed
        if parsed is None and (several := [word for word in text.split() if re.match(r"[\w.]+=", word)])[1:]:
            raise UsageError(f"{text!r}: {len(several)} settings within one pair of quotes; give each by itself")
        if parsed is None:
            open_or_sign = "a bracket or quote is left open, or the value has signs that need quotes (KEY=\"'VALUE'\")"
            raise UsageError(f"{text!r}: cannot be read as KEY=VALUE: {open_or_sign}")
        if parsed.is_range_sweep():
            content = parsed.value()
            refuse_range(text, content.start, content.stop, content.step)
        if parsed.is_add() or parsed.is_force_add() or parsed.is_delete():
            raise UsageError(f"{text!r}: keys can be set (KEY=VALUE), not added or deleted")
        if parsed.package:
            raise UsageError(f"{text!r}: not a key of this program")
        name = parsed.key_or_group
        if not parsed.is_sweep_override():
            return Override(name, parsed.value(), f"{name}={parsed.get_value_element_as_str()}")
        if not parsed.is_discrete_sweep():
            raise UsageError(f"{text!r}: not a list of values; use commas, range, choice or glob for a sweep")
        return Override(name, None, text, tuple(parsed.sweep_string_iterator()))

    def _is_text(self, key: str) -> bool:
        """Whether a key holds a text, or texts, in every part that has it."""
        group, _, name = key.partition(".")
        of_part = group in CLASSES and bool(name)  # and not model=PATH
        parts = self._files.parts(group).values() if of_part else [Config]
        keys = [about for part in parts if (about := find(part, name if of_part else key))]
        return bool(keys) and all(about.type is str or _holds_texts(about.type) for about in keys)

    def get_group_options(self, group_name: str, *_: Any, **__: Any) -> list[str]:
        """What Hydra's parser asks of a loader of configurations, for glob(...)."""
        return self._files.options(group_name)

    def _parsed(self, text: str) -> Any:
        """Hydra's record of an override; None where it cannot be read."""
        from hydra.core.override_parser.overrides_parser import OverridesParser
        from hydra.errors import HydraException

        loader: Any = self
        try:
            return OverridesParser.create(config_loader=loader).parse_overrides([text])[0]
        except (HydraException, ValueError):
            return None


def _holds_texts(kind: Any) -> bool:
    """Whether a type is a list or tuple of texts, or a text or None."""
    return get_origin(kind) is not dict and get_args(kind)[:1] == (str,)


def refuse_range(text: str, start: float, stop: float, step: float) -> None:
    """UsageError for a range that has no end, or no place in memory."""
    if not step or not math.isfinite(start + stop + step):
        raise UsageError(f"{text!r}: a range has a finite start and stop, and a step other than 0")
    if (count := math.ceil((stop - start) / step)) > MOST_CELLS:
        raise UsageError(f"{text!r}: {count} values; a sweep has at most {MOST_CELLS} cells")


def plain_override(text: str) -> Override | None:
    """The override that a plain text gives; None for a text that is not plain."""
    key, _, value = text.partition("=")
    if not _KEY.fullmatch(key):
        return None
    if several := _RANGE.fullmatch(value):
        start = int(several[1] or 0)
        stop = int(several[2])
        refuse_range(text, start, stop, 1)
        return Override(key, None, text, range(start, stop))
    items = ITEM.findall(value)
    values = [_plain_value(item) for item in items]
    if None in values or not items or ",".join(items) != value:
        return None
    texts = [_text(item) for item in values]
    return Override(key, values[0], f"{key}={texts[0]}") if len(values) == 1 else Override(key, None, text, texts)


def _plain_value(text: str) -> int | float | str | list[Any] | None:
    """A number, a word, or a list of them; None for anything else."""
    if text.startswith("["):
        values = [_plain_value(item) for item in text[1:-1].split(",")]
        return None if None in values else values
    if _INTEGER.fullmatch(text):
        return int(text)
    if _DECIMAL.fullmatch(text) and str(float(text)) == text:  # 1.10 may be a name
        return float(text)
    return text if _WORD.fullmatch(text) and text.lower() not in _NO_WORDS else None


def _literal(value: str) -> str:
    """A value whose words stand for themselves, whatever the grammar makes of them; null stays what it is."""
    words = rf"{_QUOTED.pattern}|{'[^][,]+' if value.startswith('[') else '[^,]+'}"
    return re.sub(
        words, lambda word: word[0] if word[1] or word[0].strip() == "null" else quoted(word[0].strip()), value
    )


def _text(value: Any) -> str:
    return f"[{','.join(map(_text, value))}]" if isinstance(value, list) else str(value)


def in_grammar(key: str, value: Any) -> str:
    """One value of a key in the grammar of overrides; UsageError for what is no value."""
    value = value.tolist() if hasattr(value, "tolist") else value
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, Mapping):
        return f"{{{','.join(f'{name}:{in_grammar(key, item)}' for name, item in value.items())}}}"
    if isinstance(value, (list, tuple, range)):
        return f"[{','.join(in_grammar(key, item) for item in value)}]"
    if isinstance(value, (str, os.PathLike)):
        text = os.fspath(value)
        return text if _SAFE.fullmatch(text) else quoted(text)
    raise UsageError(f"{key}: a {type(value).__name__} is no value: numbers, text, paths, lists and dictionaries are")


def quoted(value: str) -> str:
    """A value that stands for itself in Hydra's grammar: backslashes count double before a quote only."""
    escaped = re.sub(r"(\\*)'", lambda match: f"{match[1] * 2}\\'", value)
    return "'" + re.sub(r"\\+$", lambda match: match[0] * 2, escaped) + "'"
