"""Overrides, KEY=VALUE: read and checked. Is it a key of this program, is there such an option.

They have Hydra's grammar. Its parser takes as long to import as all the rest of a plain command (.16 s of processor
time), so a number, a word, several of them with commas between and range(a, b) are read here, with the same result.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.parts.former import refuse_former
from quadexp.parts.option_files import OptionFiles
from quadexp.parts.schema import CHOSEN

if TYPE_CHECKING:
    from hydra.core.override_parser.types import Override

GROUPS = {*CHOSEN, "experiment"}  # keys that choose an option
# Keys that hold a path.
PATHS = {
    "model", "plant.model", "trajectory.path", "wind.path", "collect.identified", "engine.tls_ca",
    "engine.tls_cert", "engine.tls_key",
}  # fmt: skip
HYDRA = {  # how a key of Hydra itself begins -> what does that here
    "hydra.sweep.": "--out names the folder of a sweep",
    "hydra.run.": "--out names where a flight is written",
    "hydra.job.": "--out names what is written",
    "hydra/launcher": "engine=local, dask or jobs says where a sweep is flown",
    "hydra.launcher": "engine=local, dask or jobs says where a sweep is flown, evaluate.workers on how many processes",
    "hydra/sweeper": "evaluate --sweep flies every combination",
    "hydra.sweeper": "evaluate --sweep flies every combination",
    "hydra.searchpath": "--conf names a folder of configuration",
    "hydra": "Hydra reads what is given as KEY=VALUE, and nothing else",
}
KEPT = 50_000  # overrides that are remembered at most

_KEY = re.compile(r"[a-z_]\w*(?:\.\w+)*", re.ASCII)
_INTEGER = re.compile(r"0|-?[1-9]\d{0,17}", re.ASCII)
_DECIMAL = re.compile(r"-?(?:0|[1-9]\d{0,14})\.\d{1,15}", re.ASCII)
_WORD = re.compile(r"[A-Za-z](?:[\w./-]*\w)?", re.ASCII)
_RANGE = re.compile(r"range\((?:(\d{1,9}), ?)?(\d{1,9})\)", re.ASCII)
_NO_WORDS = {"null", "true", "false", "nan", "inf"}  # in any case of their letters


class Given(NamedTuple):
    """One override. text: KEY=VALUE in its usual form. sweep: the values, as texts, where it stands for several."""

    key: str
    value: Any
    text: str
    sweep: Sequence[str] | range | None = None

    @property
    def node(self) -> str:
        return self.key.partition(".")[0]


class OverrideReader:
    """Reads each text once. files: whose groups and options there are."""

    def __init__(self, files: OptionFiles) -> None:
        self._files = files
        self._known: dict[str, Given] = {}

    def read(self, overrides: Sequence[str], *, sweep: bool = False) -> list[Given]:
        """The overrides; UsageError where one cannot be read, or has several values outside a sweep."""
        return [self._known.get(text) or self._read(text, sweep) for text in overrides]

    def _read(self, text: str, sweep: bool) -> Given:
        key, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"{text!r}: expected KEY=VALUE, such as trajectory.speed=8")
        given = None if key in PATHS and not re.match("[A-Za-z]", value) else plain_override(text)
        given = given or self._by_grammar(text)
        if given.key.split("/")[0].split(".")[0] in ("hydra", "schema", "sweep"):
            hint = next((f"; {said}" for begin, said in HYDRA.items() if given.key.startswith(begin)), "")
            raise UsageError(f"{text!r}: not a key of this program{hint}")
        if given.sweep is None:
            if given.key in GROUPS and not (given.value is None and given.key == "experiment"):
                option = self._option(given)
                given = Given(given.key, option, f"{given.key}={option}")
            if len(self._known) > KEPT:
                self._known.clear()
            self._known[text] = given
            return given
        if not given.sweep:
            raise UsageError(f"{text}: an empty range leaves nothing to fly")
        if not sweep:
            raise UsageError(f"{text!r}: several values for one key; use `quadexp evaluate --sweep` for that")
        if given.key in GROUPS:
            self.read([f"{given.key}={option}" for option in given.sweep])
        return given

    def _option(self, given: Given) -> str:
        option = self._files.named(given.key, given.value)
        if option is None:
            refuse_former(f"{given.key}={given.value}")
            hint = suggestion(str(given.value), self._files.options(given.key))
            raise UsageError(f"{given.key}={given.value}: no such {given.key}{hint}")
        return option

    def _by_grammar(self, text: str) -> Given:
        """An override by Hydra's grammar."""
        key, _, value = text.partition("=")
        literal = f"{key}={','.join(map(quoted, value.split(',')))}"
        override = self._parsed(text)
        if override is None and key in PATHS:  # most letters that a path may have mean nothing to the grammar
            override = self._parsed(literal)
        if override is None and (several := [word for word in text.split() if re.match(r"[\w.]+=", word)])[1:]:
            raise UsageError(f"{text!r}: {len(several)} settings within one pair of quotes; give each by itself")
        if override is None:
            raise UsageError(
                f"{text!r}: cannot be read as KEY=VALUE: a bracket or quote is left open,"
                " or the value has signs that need quotes (KEY=\"'VALUE'\")"
            )
        content = override.value()
        values = getattr(content, "list", [content]) if "(" not in value else []
        if key in PATHS and any(isinstance(item, (int, float)) for item in values):  # 2024_01 is not the number 202401
            override = self._parsed(literal) or override
        if override.is_add() or override.is_force_add() or override.is_delete():
            raise UsageError(f"{text!r}: keys can be set (KEY=VALUE), not added or deleted")
        if override.package:
            raise UsageError(f"{text!r}: not a key of this program")
        name = override.key_or_group
        if not override.is_sweep_override():
            return Given(name, override.value(), f"{name}={override.get_value_element_as_str()}")
        if not override.is_discrete_sweep():
            raise UsageError(f"{text!r}: not a list of values; use commas, range, choice or glob for a sweep")
        return Given(name, None, text, tuple(override.sweep_string_iterator()))

    def get_group_options(self, group_name: str, *_: Any, **__: Any) -> list[str]:
        """What Hydra's parser asks of a loader of configurations, for glob(...)."""
        return self._files.options(group_name)

    def _parsed(self, text: str) -> Override | None:
        """An override by Hydra's grammar; None where it cannot be read."""
        from hydra.core.override_parser.overrides_parser import OverridesParser
        from hydra.errors import HydraException

        loader: Any = self
        try:
            return OverridesParser.create(config_loader=loader).parse_overrides([text])[0]
        except HydraException:
            return None


def plain_override(text: str) -> Given | None:
    """The override that a plain text gives; None for a text that is not plain."""
    key, _, value = text.partition("=")
    if not _KEY.fullmatch(key):
        return None
    if several := _RANGE.fullmatch(value):
        return Given(key, None, text, range(int(several[1] or 0), int(several[2])))
    values = [_plain_value(item) for item in value.split(",")]
    if None in values:
        return None
    if len(values) > 1:
        return Given(key, None, text, tuple(map(str, values)))
    return Given(key, values[0], f"{key}={values[0]}")


def _plain_value(text: str) -> int | float | str | None:
    """A number or a word; None for anything else."""
    if _INTEGER.fullmatch(text):
        return int(text)
    if _DECIMAL.fullmatch(text):
        return float(text)
    return text if _WORD.fullmatch(text) and text.lower() not in _NO_WORDS else None


def quoted(value: str) -> str:
    """A value that stands for itself in Hydra's grammar: backslashes count double before a quote only."""
    escaped = re.sub(r"(\\*)'", lambda match: f"{match[1] * 2}\\'", value)
    return "'" + re.sub(r"\\+$", lambda match: match[0] * 2, escaped) + "'"
