"""The leaderboard as one page that opens offline, in the style of the report."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from markupsafe import Markup

from quadexp import __version__
from quadexp.bench.board import RULE, board_table, error_table, families_of
from quadexp.bench.protocol import SHORT, Protocol
from quadexp.bench.ranking import Row
from quadexp.files.writer import write_text
from quadexp.report.flown_by import flown_by_lines
from quadexp.report.page import palette
from quadexp.report.page.build import environment
from quadexp.report.table import Table
from quadexp.report.text import count

STYLE = files("quadexp.report.page") / "templates"
TEMPLATE = files("quadexp.bench") / "leaderboard.html.j2"


def write_page(path: Path, rows: Sequence[Row], protocol: Protocol, notes: Sequence[str] = ()) -> Path:
    """Write the page of a leaderboard."""
    light, dark = palette.css_blocks()
    options: dict[str, Any] = {"metric": protocol.metric}
    families = [
        {
            "name": name,
            "what": protocol.families[name].what if name in protocol.families else "",
            "board": _plain(board_table(own, baseline=protocol.baseline, **options)),
            "worlds": _plain(error_table(own, **options)),
            "cells": _plain(error_table(own, by=("task", "world"), **options)),
        }
        for name, own in families_of(rows).items()
    ]
    entries = list(dict.fromkeys(str(row["entry"]) for row in rows))
    template = environment().from_string(TEMPLATE.read_text(encoding="utf-8"))
    page = template.render(
        version=__version__,
        title=f"Leaderboard, protocol v{protocol.version}",
        lead=f"{count(len(entries), 'entry').replace('entrys', 'entries')}, {count(len(rows), 'flight')}, size"
        f" {rows[0]['size']}, protocol v{protocol.version} ({protocol.sha256[:SHORT]}).",
        rule=RULE,
        families=families,
        notes=list(notes),
        flown_by=flown_by_lines(rows),
        sha256=protocol.sha256,
        css_light=Markup(light),
        css_dark=Markup(dark),
        style=Markup((STYLE / "style.css").read_text(encoding="utf-8")),
    )
    return write_text(path, page)


def _plain(table: Table) -> dict[str, Any]:
    """A table as the template takes it; a cell is (text, whether it is the best)."""
    rows = [[(cell.replace("**", ""), "**" in cell) for cell in row] for row in table.rows]
    return {"title": table.title, "columns": table.columns, "rows": rows, "left": table.left, "notes": table.notes}
