"""One model of a table, with renderers for text, Markdown, LaTeX, CSV, the terminal (rich) and HTML.

Cells are texts. In a cell, `**x**` marks the best value and a final `*` a significant difference; every renderer
translates these two marks.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from typing import Any

from quadexp.messages import clean

_LATEX = str.maketrans({c: f"\\{c}" for c in "&%$#_{}"} | {"\\": r"\textbackslash{}", "<": "$<$"})
_BEST = re.compile(r"\*\*(.+?)\*\*")


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
        widths = [max(map(len, column)) for column in zip(self.columns, *self.rows, strict=True)]
        lines = [self.title] if self.title else []
        above = ""
        for (i, text), end in zip(self.groups.items(), [*list(self.groups)[1:], len(widths)], strict=False):
            widths[i] += max(0, len(text) - sum(widths[i:end]) - 2 * (end - i - 1))
            above = above.ljust(sum(widths[:i]) + 2 * i) + text
        lines += [above] if above else []
        for row in (self.columns, *self.rows):
            cells = (
                c.ljust(w) if i in self.left else c.rjust(w) for i, (c, w) in enumerate(zip(row, widths, strict=True))
            )
            lines.append("  ".join(cells).rstrip())
        return lines + list(self.notes)

    def markdown(self, *, bullets: bool = False) -> str:
        """Markdown. bullets: notes as a list."""
        rule = ["---" if i in self.left else "---:" for i in range(len(self.columns))]
        lines = [self.title, ""] if self.title else []
        lines += ["| " + " | ".join(row) + " |" for row in (self.columns, rule, *self.rows)]
        notes = [f"- {note}".replace("* ", "&ast; ") if bullets else note for note in self.notes]  # "* " begins a list
        return "\n".join([*lines, *(["", *notes] if notes or bullets else [])]) + "\n"

    def latex(self) -> str:
        """A LaTeX tabular with booktabs rules; with `over`, rows of different first cells are set apart."""
        columns = "".join("l" if i in self.left else "r" for i in range(len(self.columns)))
        lines = [rf"% {'' if self.over else f'{self.title}; '}needs \usepackage{{booktabs}}"]
        lines += [*(f"% {note}" for note in self.notes), rf"\begin{{tabular}}{{{columns}}}", r"\toprule"]
        if self.over:
            span = rf"\multicolumn{{{len(columns) - self.beside}}}{{c}}{{{escape(self.over)}}}"
            lines.append(rf"{' &' * self.beside} {span} \\ \cmidrule(l){{{self.beside + 1}-{len(columns)}}}")
        lines += [_latex_row(self.columns), r"\midrule", *map(_latex_row, self.rows[: self.head])]
        lines += [r"\midrule"] if self.head else []
        for before, row in zip([None, *self.rows[self.head :]], self.rows[self.head :], strict=False):
            lines += [r"\addlinespace"] if self.over and before and before[0] != row[0] else []
            lines.append(_latex_row(row))
        return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"]) + "\n"

    def csv(self) -> str:
        """CSV of the texts, without the marks of the best and of significance."""
        rows = ([re.sub(r"\*$", "", _BEST.sub(r"\1", cell)) for cell in row] for row in self.rows)
        return csv_text(self.columns, rows)

    def rendered(self, form: str) -> str:
        """As csv, markdown or latex."""
        return {"csv": self.csv, "markdown": self.markdown, "latex": self.latex}[form]()

    def rich(self, *, stacked: bool = False) -> Any:
        """A rich Table for the terminal. stacked: intervals below their values, for a narrow terminal."""
        from rich import markup, table

        shown = table.Table(title=self.title, title_justify="left")
        for i, heading in enumerate(self.columns):
            shown.add_column(markup.escape(heading), justify="left" if i in self.left else "right", overflow="fold")
        for k, row in enumerate(self.rows):
            cells = [_BEST.sub(r"[bold]\1[/bold]", markup.escape(cell)) for cell in row]
            shown.add_row(
                *(re.sub(r" \[(?=[-\d])", "\n[", c) if stacked else c for c in cells), end_section=k + 1 == self.head
            )
        return shown

    def html(self) -> str:
        """An HTML table without style; also what a notebook shows."""
        from html import escape

        def plain(text: str) -> str:
            return escape(clean(text))

        def line(cells: Sequence[str], tag: str) -> str:
            texts = (_BEST.sub(r"<b>\1</b>", plain(cell)) for cell in cells)
            sides = ("left" if i in self.left else "right" for i in range(len(cells)))
            cells = [f'<{tag} style="text-align:{s}">{t}</{tag}>' for s, t in zip(sides, texts, strict=True)]
            return f"<tr>{''.join(cells)}</tr>"

        rows = "".join(line(row, "td") for row in self.rows)
        notes = "".join(f"<p>{plain(note)}</p>" for note in self.notes)
        caption = f"<caption>{plain(self.title)}</caption>"
        return f"<table>{caption}<thead>{line(self.columns, 'th')}</thead><tbody>{rows}</tbody></table>{notes}"

    _repr_html_ = html


def _latex_row(cells: Sequence[str]) -> str:
    texts = (_BEST.sub(r"\\textbf{\1}", escape(cell)).replace("*", "$^*$") for cell in cells)
    return " & ".join(texts) + r" \\"


def escape(text: str) -> str:
    """Text for LaTeX."""
    return text.translate(_LATEX)


def records_table(records: Sequence[Mapping[str, Any]], title: str = "") -> Table:
    """A table of records, a row each: numbers in full precision, nothing for what is missing."""
    names = list(dict.fromkeys(name for record in records for name in record))
    rows = [[_exact(record.get(name)) for name in names] for record in records]
    left = {i for i, name in enumerate(names) if any(isinstance(record.get(name), str) for record in records)}
    return Table(names, rows, title, left=frozenset(left))


def _exact(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return repr(float(value)) if isinstance(value, float) else str(value)


def csv_text(names: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """CSV with the shortest digits that give every number back; empty for None and NaN."""

    def text(value: Any) -> str:
        if value is None or (isinstance(value, float) and math.isnan(value)):
            return ""
        return repr(value) if isinstance(value, float) else str(value)

    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(names)
    writer.writerows(map(text, row) for row in rows)
    return stream.getvalue()
