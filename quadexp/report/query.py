"""Conditions on flights, such as `controller == gp_mpc and speed > 6`, evaluated by pandas as `DataFrame.query` does.

A word that is a column of the results or a key of the configuration stands for its values, any other one for a text; a
number may have a unit (5 mm); beside the signs of Python there are `like 'gp_*'` and `is null`. What pandas reads is
put together from known columns, signs and literals: no name, call or attribute of the condition gets there. As in
pandas, a missing value fulfils no comparison but `!=` and `not in`.
"""

from __future__ import annotations

import math
import re
from fnmatch import fnmatchcase
from typing import Any

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.report.frame import SweepFrame, is_number, read_value

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
    parts: list[str] = []

    def column(values: list[Any]) -> str:
        name = f"c{len(columns)}"
        columns[name] = values
        return name

    at = 0
    while condition[at:].strip():
        token = _TOKEN.match(condition, at)
        if token is None:
            raise UsageError(f"--where {condition!r}: cannot be read from {condition[at:].strip()[:20]!r} on")
        at = token.end()
        if token["number"]:
            parts.append(repr(float(token["number"]) * UNITS.get(token["unit"] or "", 1.0)))
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
