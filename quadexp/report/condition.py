"""Conditions on the flights of a sweep, such as `plant == simplified and speed > 6`.

They are evaluated by pandas as `DataFrame.query` does. A word that is a column of the results or a key of the
configuration stands for its values, any other one for a text. A number may have a unit (5 mm); without one it has that
of the tables beside a metric (`mean_error < 5` is in mm) and that of the configuration beside a key. What pandas reads
is put together from known columns, signs and literals: no name, call or attribute of the condition gets there. As in
pandas, a missing value fulfils no comparison but `!=` and `not in`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.parts.settings import read_value
from quadexp.report.frame import SweepFrame, is_metric, is_number
from quadexp.report.text import shown

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "us": 1e-6, "ms": 1e-3, "s": 1.0, "deg": math.pi / 180, "%": 0.01}
SIGNS = {"=": "==", "<>": "!=", "&&": "and", "||": "or"}
LITERALS = {"true": "True", "false": "False"}
_TOKEN = re.compile(
    r"""\s*(?:(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s?(?P<unit>mm|cm|us|ms|deg|m|s|%)?(?![\w.])
    |(?P<joint>(?:and|or|not|in)\b)
    |(?P<word>[^\W\d][\w.+/:*?-]*)|(?P<text>'[^']*'|"[^"]*")
    |(?P<sign>==|!=|<>|<=|>=|&&|\|\||[=<>()\[\],]))""",
    re.VERBOSE | re.IGNORECASE,
)

_VECTOR = re.compile(r"""(?:([^\W\d][\w.]*)\s*(==?|!=|<>)|([\[,]))\s*(\[[^\[\]'"]*\])""")  # a list that is one value


def chosen(frame: SweepFrame, condition: str) -> list[bool]:
    """Which rows fulfil the condition; UsageError, in one line, where it cannot be read or names no key."""
    import pandas as pd

    columns: dict[str, list[Any]] = {}
    texts: list[str] = []
    expression = " ".join(_translated(frame, condition, columns, texts))
    if texts and all(is_number(value) for column in columns.values() for value in column if value is not None):
        hint = suggestion(texts[0], frame.names, frame.swept)  # a misspelt key beside a number, or beside nothing
        raise UsageError(f"--where: {texts[0]}: no such key or column{hint}")
    try:
        holds = pd.DataFrame(columns).eval(expression, engine="python")
        if not columns or holds.dtype != bool:
            raise ValueError("a comparison such as `speed > 6` is expected")
    except Exception as error:  # of pandas and of Python's parser, which have many
        raise UsageError(f"--where {condition!r}: cannot be read: {str(error).splitlines()[0]}") from None
    return [bool(value) for value in holds.tolist()]


def _translated(frame: SweepFrame, condition: str, columns: dict[str, list[Any]], texts: list[str]) -> list[str]:
    """The parts of the expression. Filled: columns, the values of each name in it; texts, the words that are no key."""

    def quoted(match: re.Match[str]) -> str:
        key, *_, vector = match.groups()
        known = key is None or (frame.has(key) and any(str(value).startswith("[") for value in frame.values(key)))
        return match[0].replace(vector, f"'{vector}'") if known else match[0]

    condition = _VECTOR.sub(quoted, condition)
    tokens: list[re.Match[str]] = []
    end = 0
    while condition[end:].strip():
        token = _TOKEN.match(condition, end)
        if token is None:
            raise UsageError(f"--where {condition!r}: cannot be read from {condition[end:].strip()[:20]!r} on")
        tokens.append(token)
        end = token.end()
    parts: list[str] = []
    for i, token in enumerate(tokens):
        word = token["word"]
        text = token["text"]
        if token["number"]:
            number = float(token["number"])
            if token["unit"]:
                number *= UNITS[token["unit"].lower()]
            else:
                number /= _factor(tokens, i)
            parts.append(repr(number))
        elif word and word.lower() not in LITERALS:
            if frame.has(word):
                name = f"c{len(columns)}"
                columns[name] = frame.column(word)
                parts.append(name)
            else:
                texts.append(word)
                parts.append(repr(word))
        elif text:
            inner = text[1:-1]
            parts.append(repr(read_value(inner) if inner.startswith("[") else inner))
        else:
            part = (token["joint"] or word or token["sign"]).lower()
            parts.append({**SIGNS, **LITERALS}.get(part, part))
    return parts


def _factor(tokens: Sequence[re.Match[str]], place: int) -> float:
    """From SI to the unit in which tables show the metric that the number at this place is compared with; 1 if none."""
    factor = None
    for i, token in enumerate(tokens):
        if token[0].strip().lower() in ("and", "or", "&&", "||"):  # the end of a comparison
            if i > place:
                break
            factor = None
        elif factor is None and token["word"] and is_metric(token["word"]):
            factor, _ = shown(token["word"])
    return 1.0 if factor is None else factor
