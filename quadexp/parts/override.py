"""One override, KEY=VALUE, and the reading of the plain ones.

Overrides have Hydra's grammar, whose parser takes a tenth of a second to import. Nearly all overrides are plain: a
number, a word, several of them with commas between, or range(a, b) of whole numbers. These are read here, with the same
result; `plain_override` returns None for any other, which is then left to Hydra (hydra_files.py).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

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


def plain_override(text: str) -> Given | None:
    """The override that a plain text gives; None for a text that is not plain."""
    key, _, value = text.partition("=")
    if not _KEY.fullmatch(key):
        return None
    several = _RANGE.fullmatch(value)
    if several:
        return Given(key, None, text, range(int(several[1] or 0), int(several[2])))
    values = [_value(one) for one in value.split(",")]
    if None in values:
        return None
    if len(values) > 1:
        return Given(key, None, text, tuple(map(str, values)))
    return Given(key, values[0], f"{key}={values[0]}")


def _value(text: str) -> int | float | str | None:
    """A number or a word; None for anything else."""
    if _INTEGER.fullmatch(text):
        return int(text)
    if _DECIMAL.fullmatch(text):
        return float(text)
    return text if _WORD.fullmatch(text) and text.lower() not in _NO_WORDS else None


def quoted(value: str) -> str:
    """A value that stands for itself in Hydra's grammar: backslashes count double before a quote only."""
    escaped = re.sub(r"(\\*)'", lambda found: f"{found[1] * 2}\\'", value)
    return "'" + re.sub(r"\\+$", lambda found: found[0] * 2, escaped) + "'"
