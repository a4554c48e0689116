"""Text for people: one escaper a format, suggestions for a misspelt name, one line from an error of a library.

Names, labels, causes and paths may come from files of other people. So every writer passes them through the escaper of
its format, and each gives one line, one cell or one word, whatever the text was:

    clean           a stream of text: no control character but newline and tab
    printable       one line of a terminal, a log or a comment
    markdown        text within a line, or a cell of a table
    latex           text or a cell of LaTeX
    csv_line        a row of CSV, with no formula
    html            text and values of attributes in HTML and SVG
    yaml            a value of YAML
    shlex.quote     a word of a command

Figures take text as it is: mathematics is asked for by name (drawing/style.py). Standard output and the error stream
are wrapped once in a CleanStream (quadexp/cli/terminal.py).
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import html as markup
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

# Signs beyond ASCII that are not printed, such as marks of direction, are written out; blanks that this program sets,
# and the bytes of a path that is not UTF-8, are kept.
_UNUSUAL = re.compile("[^\n\t -~\u00a0\u202f\udc80-\udcff]")
_LATEX = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"}
    | {"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}"}
    | {c: f"${c}$" for c in "<>|"}
)
# What begins code, emphasis, a cell, mathematics, a tag, a link, an entity; an underscore within a word begins nothing.
_MARKDOWN = re.compile(r"[\\`*|~$]|<(?=\S)|\](?=[(\[:])|(?<![^\W_])_|_(?![^\W_])|&(?=[#\w])")
_BLOCK = re.compile(r"^(\d{1,9}(?=[.)](?!\S))|(?=[#>+=-]))")  # what begins a list, a heading, a quotation
_BYTES = re.compile("[\udc80-\udcff]+")  # of a path that is not UTF-8
_NUMBER = r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?inf|-"
# What a spreadsheet evaluates at the beginning of a cell, of any country's separator, where it is no number.
_FORMULA = re.compile(rf"(?i)(?:^|(?<=;))(?=\s*[=+\-@\uff1d\uff0b\uff0d\uff20])(?!(?:{_NUMBER})(?:;|$))")


def clean(text: str) -> str:
    """The text with what is not printed written out, such as \\x1b for ESC; newline and tab are kept."""
    text = _BYTES.sub(lambda run: os.fsdecode(os.fsencode(run[0])), text)  # as letters where they are UTF-8
    return _UNUSUAL.sub(lambda sign: sign[0] if sign[0].isprintable() else ascii(sign[0])[1:-1], text)


def printable(text: object) -> str:
    """One line: newline and tab are written out too."""
    return clean(str(text)).replace("\n", "\\n").replace("\t", "\\t")


@functools.cache  # which every command clears
def note(text: str) -> None:
    """Say once in a command, on the error stream, what its user should know."""
    print(f"note: {printable(text)}", file=sys.stderr)


def _stored(text: object) -> str:
    """One line for a file, which is UTF-8."""
    return printable(text).encode(errors="backslashreplace").decode()


def markdown(text: object, *, begins: bool = False) -> str:
    """Text within a line of Markdown, or a cell. begins: a line begins with it."""
    escaped = _MARKDOWN.sub(r"\\\g<0>", _stored(text))
    return _BLOCK.sub(r"\1\\", escaped.lstrip()) if begins else escaped


def latex(text: object) -> str:
    """Text or a cell of LaTeX. What begins with a bracket or star would be an argument of the command before it."""
    escaped = _stored(text).translate(_LATEX)
    return f"{{}}{escaped}" if escaped[:1] in ("[", "*") else escaped


def csv_line(values: Iterable[Any]) -> str:
    """A row of CSV: numbers with the digits that give them back, empty for None and NaN. A text that a spreadsheet
    would evaluate begins with an apostrophe, and one with a separator, of any country, stands in quotes."""
    return ",".join(map(_csv_cell, values)) or '""'


def _csv_cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, float):
        return repr(value)
    text = _FORMULA.sub("'", _stored(value))
    return '"' + text.replace('"', '""') + '"' if re.search('[",;]', text) else text


def html(text: object) -> str:
    """Text, or the value of an attribute in quotes, of HTML and SVG."""
    return markup.escape(clean(str(text)).encode(errors="backslashreplace").decode())


def yaml(value: Any) -> str:
    """A value as YAML on one line, which is read back as it was: JSON, with what is not printed written out."""
    return _stored(json.dumps(value, ensure_ascii=False))


class CleanStream:
    """A text stream that passes on no control character. raw: the wrapped stream, for text that this program styles.
    ignored: errors of writing that end nothing: of messages, which nobody may be there to read.

    before: is called before anything is printed.
    """

    before: Callable[[], None] | None = None

    def __init__(self, raw: Any, *ignored: type[Exception]) -> None:
        self.raw = raw
        self.ignored = ignored

    def write(self, text: str) -> int:
        if CleanStream.before is not None:
            CleanStream.before()
        with contextlib.suppress(*self.ignored):
            self.raw.write(clean(text))
        return len(text)

    def flush(self) -> None:
        with contextlib.suppress(*self.ignored):
            self.raw.flush()

    def writelines(self, lines: Iterable[str]) -> None:
        for text in lines:
            self.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)


def raw(stream: Any) -> Any:
    """The stream that a CleanStream wraps; any other stream itself."""
    if CleanStream.before is not None:
        CleanStream.before()
    return stream.raw if isinstance(stream, CleanStream) else stream


MOST_NAMED = 8  # names that a question lists at most
LIKE = 0.6  # of 1: likeness from which a name may have been meant


def suggestion(unknown: str, known: Sequence[str], listed: Sequence[str] | None = None) -> str:
    """A name that may have been meant, or the names that exist, as the end of an error message."""
    near = ending_in(unknown, known) or _nearest(unknown, known)
    if near:
        more = ", ..." if len(near) > MOST_NAMED else ""
        return f"; did you mean {' or '.join(near[:MOST_NAMED])}{more}?"
    names = sorted((set(known) if listed is None else set(listed)) - {"sweep"})
    return f"; there are: {', '.join(names[:12])}{', ...' if len(names) > 12 else ''}" if names else ""


def ending_in(unknown: str, known: Sequence[str]) -> list[str]:
    """The dotted names that end in the given one: trajectory.speed for speed, model.features.a_x for features.a_x."""
    return [name for name in known if name.endswith(f".{unknown}")]


def _nearest(unknown: str, known: Sequence[str]) -> list[str]:
    """The names most like the given one; of a name without dots, the last parts of dotted ones count as names too."""

    def likeness(name: str) -> float:
        group, _, leaf = name.rpartition(".")
        shared = unknown.removeprefix(f"{group}.") if group else unknown
        pair = (unknown, name) if "." in shared else (shared, leaf)
        return difflib.SequenceMatcher(None, *pair).ratio()

    scores = {name: likeness(name) for name in known}
    best = max(scores.values(), default=0.0)
    return [name for name in scores if scores[name] == best] if best >= LIKE else []
