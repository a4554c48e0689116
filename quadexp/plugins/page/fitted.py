"""LaTeX of a table that fits a column or a page of a paper.

A table that is too wide or too long becomes several tabulars below each other, with the same first columns; a long
heading or label is broken into lines. Widths are estimated at 8 pt (\\footnotesize of the IEEE) from the widths of
Computer Modern, which are larger than those of Times, so that nothing has to be installed to fit a table.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import zip_longest

from quadexp.messages import printable
from quadexp.report.table import Table, latex_row, marked

WIDTHS = {"column": 252.0, "page": 516.0}  # pt, of the IEEE
GAP = 6.0  # pt between two columns
LEAST_HEADING = 36.0  # pt that a heading may take above narrower numbers
MOST_LINES = 48  # of one tabular; a page of the IEEE has 60 such lines
BOLD = 1.16  # width of bold digits over that of usual ones
GLYPHS = {  # width (pt) in Computer Modern at 8 pt -> letters that have at most this one
    2.8: "!',.:;[]`ilfj-",
    3.4: "()rtsI",
    4.3: ' cez0123456789ago/"$*?^~',
    4.8: "kqvxySbdhnpuJ_",
    6.0: "ZLFEPB",
}
WIDEST = 8.7  # pt, of any other sign
CAPITAL = 6.7  # pt, of any other letter
_MINUS = re.compile(r"(?<=[\s\[{])-(?=\d)")
_BREAKS = re.compile(r"[^\s_+/=,@]*[\s_+/=,@]*")


def text_width(text: str) -> float:
    """Width of a cell at 8 pt (pt), rather too large than too small."""
    width = 0.0
    for letter in marked(text, str):
        other = CAPITAL if letter.isalpha() and letter not in "mMW" else WIDEST
        width += next((size for size, letters in GLYPHS.items() if letter in letters), other)
    if "**" in text:
        return width * BOLD
    return width


def _broken(text: str, room: float) -> list[str]:
    """The text in lines of at most `room` (pt), broken behind blanks and signs that join words, where it has some."""
    lines = [""]
    for part in _BREAKS.findall(text):
        if lines[-1] and text_width((lines[-1] + part).strip()) > room:
            lines.append("")
        lines[-1] += part
    return [line.strip() for line in lines]


def _rooms(table: Table, width: float) -> list[float]:
    """Width of every column (pt): of numbers as they need it, of labels what is left beside the widest of these."""
    cells = [[str(row[i]) for row in table.rows] for i in range(len(table.columns))]
    whole = [max(map(text_width, [heading, *column])) for heading, column in zip(table.columns, cells, strict=True)]
    if sum(whole) + GAP * (len(whole) - 1) <= width:
        return whole
    rooms = []
    for heading, column in zip(table.columns, cells, strict=True):
        widest = max(map(text_width, column), default=0.0)
        rooms.append(max(widest, *map(text_width, _broken(heading, max(widest, LEAST_HEADING)))))
    n = table.beside
    remaining = min(0.6 * width, width - max(rooms[n:], default=0.0)) - n * GAP
    while sum(rooms[:n]) > remaining and max(rooms[:n]) > LEAST_HEADING:
        widest_label = rooms.index(max(rooms[:n]))
        rooms[widest_label] *= 0.95
    for i in range(n):
        broken = []
        for text in (table.columns[i], *cells[i]):
            broken += _broken(text, rooms[i])
        rooms[i] = max(map(text_width, broken))
    return rooms


def tabulars(table: Table, width: float) -> list[list[int]]:
    """The columns of each tabular: as many as fit beside the labels."""
    rooms = _rooms(table, width)
    n = table.beside
    places: list[list[int]] = []
    for i in range(n, len(rooms)):
        together = [*range(n), *(places[-1][n:] if places else ()), i]
        if places and sum(rooms[k] for k in together) + GAP * (len(together) - 1) <= width:
            places[-1] = together
        else:
            places.append([*range(n), i])
    return places or [[*range(n)]]


def fitted_latex(table: Table, width: float) -> str:
    """LaTeX that is at most `width` (pt) wide: one tabular, or several that may stand on different pages."""
    rooms = _rooms(table, width)
    notes = [f"% {printable(note)}" for note in ("needs \\usepackage{booktabs}", *table.notes)]
    parts = []
    for columns in tabulars(table, width):
        widths = [rooms[i] for i in columns]
        part: list[list[list[str]]] = []
        for row in table.rows:
            lines = _lines([row[i] for i in columns], widths, table.beside)
            if part and sum(map(len, part)) + len(lines) > MOST_LINES:
                parts.append(_tabular(table, columns, rooms, part))
                part = []
            part.append(lines)
        if part:
            parts.append(_tabular(table, columns, rooms, part))
    body = "\n\\par\\medskip\\noindent\n".join(parts)
    begin = rf"\begingroup\footnotesize\setlength{{\tabcolsep}}{{{GAP / 2:g}pt}}\noindent"
    return "\n".join([*notes, begin, body, r"\par\endgroup"]) + "\n"


def _lines(row: Sequence[str], rooms: Sequence[float], labels: int) -> list[list[str]]:
    """A row as lines of a tabular: labels that are too long go on in the next line, numbers stand in the first."""
    broken = [_broken(text, rooms[i]) if i < labels else [text] for i, text in enumerate(row)]
    return [list(line) for line in zip_longest(*broken, fillvalue="")]


def _tabular(
    table: Table, columns: Sequence[int], rooms: Sequence[float], rows: Sequence[Sequence[Sequence[str]]]
) -> str:
    n = table.beside
    across = len(columns)
    sides = "".join("l" if i in table.left else "r" for i in columns)
    lines = [rf"\begin{{tabular}}{{@{{}}{sides}@{{}}}}", r"\toprule"]
    if table.over and across > n:
        room = sum(rooms[i] for i in columns[n:]) + GAP * (across - n - 1)
        for text in _broken(table.over, room):
            lines.append(rf"{'& ' * n}\multicolumn{{{across - n}}}{{c}}{{{latex_row([text])[:-3]}}} \\")
        lines.append(rf"\cmidrule(l){{{n + 1}-{across}}}")
    heads = [_broken(table.columns[i], max(rooms[i], LEAST_HEADING * (i >= n))) for i in columns]
    deep = max(map(len, heads))
    heads = [[""] * (deep - len(head)) + head for head in heads]  # the last lines stand on one line
    lines += map(latex_row, zip(*heads, strict=True))
    lines.append(r"\midrule")
    before = None
    for row in rows:
        if n > 1 and before is not None and row[0][0] != before:
            lines.append(r"\addlinespace")
        before = row[0][0]
        lines += map(latex_row, row)
    text = "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]).replace("±", r"$\pm$")
    return _MINUS.sub("$-$", text)
