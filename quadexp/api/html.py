"""How notebooks show what the API returns, without colours of its own: dark and light themes both apply."""

from __future__ import annotations

import functools
import io
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from quadexp.messages import clean
from quadexp.report.tables import ErrorTable, flown_cells


def safe(text: object) -> str:
    """Text for HTML, without control characters."""
    return escape(clean(str(text)))


def preformatted(lines: Iterable[str]) -> str:
    return f"<pre>{safe(chr(10).join(lines))}</pre>"


def error_table(table: ErrorTable) -> str:
    """The error table, the least error of a line bold, its notes below."""
    rows = [_row(["trajectory", "m/s", *table.columns], "th"), _row(flown_cells(table))]
    for line in table.rows:
        entries = (table.entries.get((line, column)) for column in table.columns)
        cells = [(entry.text(), entry.best) if entry else ("-", False) for entry in entries]
        rows.append(_row([*line, *cells]))
    caption = f'<caption style="text-align: left">{safe(table.title)}</caption>'
    body = f"<thead>{rows[0]}</thead><tbody>{''.join(rows[1:])}</tbody>"
    notes = "".join(f"<li>{safe(note)}</li>" for note in table.notes)
    return f'<table class="dataframe">{caption}{body}</table><ul style="font-size: smaller">{notes}</ul>'


def _row(cells: Sequence[Any], tag: str = "td") -> str:
    """cells: texts, or (text, whether it is bold)."""
    made = []
    for i, cell in enumerate(cells):
        text, bold = cell if isinstance(cell, tuple) else (cell, False)
        style = f"text-align: {'right' if i else 'left'}; padding: 0 0.7em"
        made.append(f'<{tag} style="{style}">{f"<b>{safe(text)}</b>" if bold else safe(text)}</{tag}>')
    return f"<tr>{''.join(made)}</tr>"


def displayed(figure: Any) -> Any:
    """The figure, shown by notebooks also where matplotlib.pyplot is not in use."""
    figure._repr_png_ = functools.partial(_png, figure)
    return figure


def _png(figure: Any) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=72, bbox_inches="tight")
    return stream.getvalue()
