"""Conditions on flights, such as `controller == gp_mpc and speed > 6`, evaluated by pandas as `DataFrame.query` does.

A word that is a column of the results or a key of the configuration stands for its values, any other one for a text. A
number may have a unit (5 mm); without one it has that of the tables beside a metric (`mean_error < 5` is in mm) and
that of the configuration beside a key. Beside the signs of Python there are `like 'gp_*'` and `is null`.

What pandas reads is put together from known columns, signs and literals: no name, call or attribute of the condition
gets there. As in pandas, a missing value fulfils no comparison but `!=` and `not in`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from fnmatch import fnmatchcase
from typing import Any

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.report.frame import SweepFrame, is_metric, is_number, read_value
from quadexp.report.text import shown

UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "us": 1e-6, "ms": 1e-3, "s": 1.0, "deg": math.pi / 180, "%": 0.01}
SIGNS = {"=": "==", "<>": "!=", "&&": "and", "||": "or"}
LITERALS = {"true": "True", "false": "False"}
_TOKEN = re.compile(
    r"""\s*(?:(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s?(?P<unit>mm|cm|us|ms|deg|m|s|%)?(?![\w.])
    |is\s+(?P<there>not\s+)?(?P<null>null\b)
    |(?P<unlike>not\s+)?like\s+(?P<like>'[^']*'|"[^"]*"|[^\s()]+)
    |(?P<joint>(?:and|or|not|in)\b)
    |(?P<word>[^\W\d][\w.+/:*?-]*)|(?P<text>'[^']*'|"[^"]*")
    |(?P<sign>==|!=|<>|<=|>=|&&|\|\||[=<>()\[\],]))""",
    re.VERBOSE | re.IGNORECASE,
)


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
        found = pd.DataFrame(columns).eval(expression, engine="python")
        if not columns or found.dtype != bool:
            raise ValueError("a comparison such as `speed > 6` is expected")
    except Exception as error:  # of pandas and of Python's parser, which have many
        raise UsageError(f"--where {condition!r}: cannot be read: {str(error).splitlines()[0]}") from None
    return [bool(value) for value in found.tolist()]


def _translated(frame: SweepFrame, condition: str, columns: dict[str, list[Any]], texts: list[str]) -> list[str]:
    """The parts of the expression. Filled: columns, the values of each name in it; texts, the words that are no key."""
    tokens: list[re.Match[str]] = []
    while condition[(at := tokens[-1].end() if tokens else 0) :].strip():
        if (token := _TOKEN.match(condition, at)) is None:
            raise UsageError(f"--where {condition!r}: cannot be read from {condition[at:].strip()[:20]!r} on")
        tokens.append(token)
    parts: list[str] = []

    def column(values: list[Any]) -> str:
        name = f"c{len(columns)}"
        columns[name] = values
        return name

    for i, token in enumerate(tokens):
        if token["number"]:
            number = float(token["number"])
            parts.append(repr(number * UNITS[token["unit"].lower()] if token["unit"] else number / _factor(tokens, i)))
        elif token["null"] or token["like"]:
            own = columns.get(parts[-1] if parts else "")
            if own is None:
                raise UsageError(f"--where {condition!r}: `{token[0].strip()}` needs a key before it")
            if token["null"]:
                holds = [(value is None) is not bool(token["there"]) for value in own]
            else:
                pattern, unlike = token["like"].strip("'\""), bool(token["unlike"])
                holds = [value is not None and fnmatchcase(str(value), pattern) is not unlike for value in own]
            parts[-1] = f"{column(holds)} == True"
        elif (word := token["word"]) and word.lower() not in LITERALS:
            if frame.has(word):
                parts.append(column(frame.column(word)))
            else:
                texts.append(word)
                parts.append(repr(word))
        elif text := token["text"]:
            parts.append(repr(read_value(text[1:-1]) if text[1:2] == "[" else text[1:-1]))
        else:
            part = (token["joint"] or token["word"] or token["sign"]).lower()
            parts.append({**SIGNS, **LITERALS}.get(part, part))
    return parts


def _factor(tokens: Sequence[re.Match[str]], place: int) -> float:
    """From SI to the unit in which tables show the metric that the number at this place is compared with; 1 if none."""
    ends = [i for i, token in enumerate(tokens) if token[0].strip().lower() in ("and", "or", "&&", "||")]
    begin = max((i for i in ends if i < place), default=-1)
    comparison = tokens[begin + 1 : min((i for i in ends if i > place), default=len(tokens))]
    return next((shown(token["word"])[0] for token in comparison if token["word"] and is_metric(token["word"])), 1.0)
