"""Text for people: suggestions for a misspelt name, one line from an error of a library, no control characters.

Names may come from files of other people. A control character in one could move the cursor, hide or forge lines, or
set the title of the terminal. Therefore standard output and the error stream are wrapped once
(quadexp/cli/terminal.py), and control characters are printed as escape sequences instead of being sent.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from typing import Any

# Those of ASCII and Latin-1 except tab and newline, and those that change the direction of writing or break lines.
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


def clean(text: str) -> str:
    """The text with control characters written out, such as \\x1b for ESC."""
    return _CONTROL.sub(lambda found: ascii(found[0])[1:-1], text)


class CleanStream:
    """A text stream that passes on no control character. raw: the wrapped stream, for text that this program styles."""

    def __init__(self, raw: Any) -> None:
        self.raw = raw

    def write(self, text: str) -> int:
        self.raw.write(clean(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)


def raw(stream: Any) -> Any:
    """The stream that a CleanStream wraps; any other stream itself."""
    return stream.raw if isinstance(stream, CleanStream) else stream


# Message of OmegaConf for a value of the wrong type.
_CONVERSION = re.compile(r"Value '(.*)' of type '[^']*' could not be converted to (\w+)$")
RENAMED = {"static_thrust": "thrust_coefficient"}  # former name of a key -> its name now
MOST_NAMED = 8  # names that a question lists at most
LIKE = 0.6  # of 1: likeness from which a name may have been meant
_KINDS = {"Float": "a number", "Integer": "a whole number", "Boolean": "true or false"}


def suggestion(found: str, known: Sequence[str], listed: Sequence[str] | None = None) -> str:
    """A name that may have been meant, or the names that exist, as the end of an error message."""
    last = found.rpartition(".")[2]
    renamed = found.removesuffix(last) + RENAMED.get(last, last)
    if renamed != found and renamed in known:
        return f"; it is called {renamed} now"
    near = ending_in(found, known) or _nearest(found, known)
    if near:
        more = ", ..." if len(near) > MOST_NAMED else ""
        return f"; did you mean {' or '.join(near[:MOST_NAMED])}{more}?"
    names = sorted((set(known) if listed is None else set(listed)) - {"sweep"})
    return f"; there are: {', '.join(names[:12])}{', ...' if len(names) > 12 else ''}" if names else ""


def ending_in(found: str, known: Sequence[str]) -> list[str]:
    """The dotted names that end in the given one: trajectory.speed for speed, gp.features.a_x for features.a_x."""
    return [name for name in known if name.endswith(f".{found}")]


def _nearest(found: str, known: Sequence[str]) -> list[str]:
    """The names most like the given one; of a name without dots, the last parts of dotted ones count as names too."""

    def likeness(name: str) -> float:
        group, _, leaf = name.rpartition(".")
        shared = found.removeprefix(f"{group}.") if group else found
        pair = (found, name) if "." in shared else (shared, leaf)
        return difflib.SequenceMatcher(None, *pair).ratio()

    scores = {name: likeness(name) for name in known}
    best = max(scores.values(), default=0.0)
    return [name for name in scores if scores[name] == best] if best >= LIKE else []


def one_line(error: BaseException) -> str:
    """One line from an error of Hydra or OmegaConf and its cause; the cause comes first."""
    parts = []
    for part in (error.__cause__, error):
        if part is None:
            continue
        lines = str(getattr(part, "msg", None) or part).strip().splitlines()
        wrong = _CONVERSION.match(lines[0]) if lines else None
        if wrong:
            kind = _KINDS.get(wrong[2], wrong[2])
            return f"{getattr(part, 'full_key', None) or 'value'}={wrong[1]}: must be {kind}"
        if lines and lines[0] != "None":
            key = getattr(part, "full_key", None)
            rest = f" {lines[1].strip()}" if lines[0].endswith(":") and len(lines) > 1 else ""
            parts.append((f"{key}: " if key else "") + lines[0].strip() + rest)
    return " - ".join(dict.fromkeys(parts)) or type(error).__name__
