"""One model of a table, with renderers for text, Markdown, LaTeX, CSV, the terminal (rich) and HTML.

Cells are texts. In a cell, `**1.2**` marks the best value and a `*` behind a number a significant difference; every
renderer translates these two marks, and passes the rest through the escaper of its format (quadexp/messages.py).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from quadexp.messages import csv_line, html, latex, markdown, printable
from quadexp.names import distinct

# The two marks stand at numbers only: a name is no mark, whatever its letters.
_MARKS = re.compile(r"\*\*(-?[\d.e+-]+)\*\*|(?<=[\d\]*])\*(?=$| \()")


@dataclass(frozen=True)
class Table:
    """columns: headings, with units in parentheses. rows: texts. left: indices of left-aligned columns. head: number
    of rows that belong to the heading. over: a heading above all columns but the first `beside`. notes: lines below.
    groups: index of a column -> text above the columns that begin there, in plain text."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    left: AbstractSet[int] = frozenset({0})
    head: int = 0
    over: str = ""
    beside: int = 2
    notes: Sequence[str] = ()
    groups: Mapping[int, str] = field(default_factory=dict)

    def lines(self) -> list[str]:
        """Plain text, columns aligned."""
        table = [[printable(cell) for cell in row] for row in (self.columns, *self.rows)]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        above = ""
        for i, end in pairwise([*self.groups, len(widths)]):
            text = self.groups[i]
            widths[i] += max(0, len(text) - sum(widths[i:end]) - 2 * (end - i - 1))
            above = above.ljust(sum(widths[:i]) + 2 * i) + text
        lines = list(filter(None, (printable(self.title), above)))
        for row in table:
            cells = []
            for i, cell in enumerate(row):
                cells.append(cell.ljust(widths[i]) if i in self.left else cell.rjust(widths[i]))
            lines.append("  ".join(cells).rstrip())
        return lines + list(map(printable, self.notes))

    def markdown(self) -> str:
        """Markdown, the notes as a list."""
        rule = ["---" if i in self.left else "---:" for i in range(len(self.columns))]
        table = [[marked(cell, markdown, "**{}**", "*") for cell in row] for row in (self.columns, *self.rows)]
        lines = []
        if self.title:
            lines = [markdown(self.title, begins=True), ""]
        for row in (table[0], rule, *table[1:]):
            lines.append(f"| {' | '.join(row)} |")
        if self.notes:
            lines.append("")
        for note in self.notes:
            lines.append(f"- {markdown(note, begins=True)}")
        return "\n".join(lines) + "\n"

    __str__ = markdown

    def latex(self) -> str:
        """A LaTeX tabular with booktabs rules; with `over`, rows of different first cells are set apart."""
        columns = "".join("l" if i in self.left else "r" for i in range(len(self.columns)))
        title = f"{printable(self.title)}; " if self.title and not self.over else ""
        lines = [rf"% {title}needs \usepackage{{booktabs}}"]
        lines += [f"% {printable(note)}" for note in self.notes]
        lines += [rf"\begin{{tabular}}{{{columns}}}", r"\toprule"]
        if self.over:
            span = rf"\multicolumn{{{len(columns) - self.beside}}}{{c}}{{{latex(self.over)}}}"
            lines.append(rf"{' &' * self.beside} {span} \\ \cmidrule(l){{{self.beside + 1}-{len(columns)}}}")
        lines += [latex_row(self.columns), r"\midrule"]
        for k, row in enumerate(self.rows):
            if k > self.head and self.over and row[0] != self.rows[k - 1][0]:
                lines.append(r"\addlinespace")
            lines.append(latex_row(row))
            if k + 1 == self.head:
                lines.append(r"\midrule")
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"

    def csv(self) -> str:
        """CSV of the texts, without the marks of the best and of significance."""
        return csv_text(self.columns, ([marked(cell, str) for cell in row] for row in self.rows))

    def rendered(self, form: str) -> str:
        """As csv, markdown or latex."""
        return {"csv": self.csv, "markdown": self.markdown, "latex": self.latex}[form]()

    def rich(self, *, stacked: bool = False) -> Any:
        """A rich Table for the terminal. stacked: intervals below their values, for a narrow terminal."""
        from rich import markup, table

        def plain(text: str) -> str:
            return markup.escape(printable(text))

        shown = table.Table(title=plain(self.title), title_justify="left")
        for i, heading in enumerate(self.columns):
            shown.add_column(plain(heading), justify="left" if i in self.left else "right", overflow="fold")
        for k, row in enumerate(self.rows):
            cells = [marked(cell, plain, "[bold]{}[/bold]", "*") for cell in row]
            if stacked:
                cells = [re.sub(r" \[(?=[-\d])", "\n[", cell) for cell in cells]
            shown.add_row(*cells, end_section=k + 1 == self.head)
        return shown

    def html(self) -> str:
        """An HTML table without style; also what a notebook shows."""

        def row(cells: Sequence[str], tag: str) -> str:
            parts = []
            for i, cell in enumerate(cells):
                side = "left" if i in self.left else "right"
                text = marked(cell, html, "<b>{}</b>", "*")
                parts.append(f'<{tag} style="text-align:{side}">{text}</{tag}>')
            return f"<tr>{''.join(parts)}</tr>"

        rows = "".join(row(cells, "td") for cells in self.rows)
        notes = "".join(f"<p>{html(note)}</p>" for note in self.notes)
        caption = f"<caption>{html(self.title)}</caption>"
        return f"<table>{caption}<thead>{row(self.columns, 'th')}</thead><tbody>{rows}</tbody></table>{notes}"

    _repr_html_ = html


def marked(cell: str, escaped: Callable[[str], str], best: str = "{}", star: str = "") -> str:
    """A cell in some format. escaped: of that format. best: around the number that is marked. star: of significance."""
    text = ""
    end = 0
    for mark in _MARKS.finditer(cell):
        text += escaped(cell[end : mark.start()])
        text += best.format(mark[1]) if mark[1] else star
        end = mark.end()
    return text + escaped(cell[end:])


def latex_row(cells: Sequence[str]) -> str:
    return " & ".join(marked(cell.strip(), latex, r"\textbf{{{}}}", "$^*$") for cell in cells) + r" \\"


def records_table(records: Sequence[Mapping[str, Any]]) -> Table:
    """A table of records, a row each: numbers in full precision, nothing for what is missing."""
    names = distinct(name for record in records for name in record)
    rows = [[_exact(record.get(name)) for name in names] for record in records]
    left = set()
    for i, name in enumerate(names):
        if any(isinstance(record.get(name), str) for record in records):
            left.add(i)
    return Table(names, rows, left=left)


def _exact(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, float):
        return repr(float(value))
    text = str(value)
    return text.lower() if isinstance(value, bool) else text


def csv_text(names: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """CSV with the shortest digits that give every number back; empty for None and NaN."""
    return "".join(f"{csv_line(row)}\n" for row in (names, *rows))
