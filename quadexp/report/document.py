"""One page of sections that opens without a network, on a phone and in print: the report of a sweep, a sweep while it
runs, a leaderboard, a table that sorts and filters. What a section holds is a record; one template shows them all.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from quadexp.messages import clean
from quadexp.report.table import Table
from quadexp.report.text import typeset

_NUMBER = re.compile(r"(\*\*)?(-?[\d.e+-]+)(?:\*\*)?(?: (\[[^\]]*\]))?(\*)?(?: \((.*)\))?")
WIDE = 8  # columns; with more, a table is printed across the sheet


@dataclass(frozen=True)
class Cell:
    """mark: label of the contestant whose marker stands before the text. small: lines below it. lost: what went wrong.
    best: in bold. replay: number of a flight in the replay."""

    text: str = ""
    small: Sequence[str] = ()
    lost: str = ""
    best: bool = False
    mark: str = ""
    replay: int | None = None


def cell_of(text: str) -> Cell:
    """A cell of a table of texts."""
    if (parts := _NUMBER.fullmatch(text)) is None:
        return Cell(text)
    bold, value, limits, star, beside = parts.groups("")
    return Cell(value + star, (limits, beside), best=bool(bold))


@dataclass(frozen=True)
class PageTable:
    """name: unique on the page. lines: the first cell of each is its heading. sorts: by a click on a heading, and lines
    are filtered by words."""

    name: str
    title: str
    heads: Sequence[Cell]
    lines: Sequence[Sequence[Cell]]
    notes: Sequence[str] = ()
    sorts: bool = False

    @classmethod
    def of(cls, table: Table, name: str = "", *, sorts: bool = False) -> PageTable:
        """A table of texts; of a cell such as `**1.2** [1.1, 1.3]* (1 lost)` the rest stands below the number."""
        lines = [[cell_of(text) for text in row] for row in table.rows]
        return cls(name, table.title, [*map(Cell, table.columns)], lines, table.notes, sorts)

    @property
    def wide(self) -> bool:
        return len(self.heads) > WIDE


@dataclass(frozen=True)
class Block:
    """What stands together in a section, or on one of its tabs. figures: HTML of `style.figure_html`. facts: (term,
    text). folded: only its title is seen at first. progress: (flights that are there, of all, the same in words)."""

    title: str = ""
    tab: str = ""
    lead: str = ""
    figures: Sequence[str] = ()
    tables: Sequence[PageTable] = ()
    facts: Sequence[tuple[str, str]] = ()
    code: Sequence[str] = ()
    notes: Sequence[str] = ()
    progress: tuple[int, int, str] | None = None
    replay: bool = False
    folded: bool = False


@dataclass(frozen=True)
class Section:
    """anchor: unique on the page. name: in the navigation; "" for none."""

    anchor: str
    name: str
    title: str
    lead: str
    blocks: Sequence[Block]


def document(title: str, sections: Sequence[Section], **more: Any) -> str:
    """The page. more: of the report, see templates/page.html.j2. All texts are escaped."""
    from jinja2 import Environment
    from markupsafe import Markup

    environment = Environment(autoescape=True, finalize=_shown, trim_blocks=True, lstrip_blocks=True)
    environment.filters["typeset"] = typeset
    acts = any(block.tab or any(table.sorts for table in block.tables) for part in sections for block in part.blocks)
    return environment.from_string(template_text("page.html.j2")).render(
        title=title,
        sections=sections,
        style=Markup(template_text("style.css")),
        script=template_text("page.js") if acts else "",
        **more,
    )


def sortable_page(title: str, table: Table, *, figures: Sequence[str] = (), notes: Sequence[str] = ()) -> str:
    """A table whose lines are sorted by a click on a heading, and filtered by a text. figures: above it."""
    block = Block(figures=figures, notes=notes, tables=[PageTable.of(table, "rows", sorts=True)])
    return document(title, [Section("rows", "", title, "", [block])])


def template_text(name: str) -> str:
    """A file of the templates."""
    return (files("quadexp.report") / "templates" / name).read_text(encoding="utf-8")


def _shown(value: Any) -> Any:
    return clean(value).encode(errors="backslashreplace").decode() if type(value) is str else value
