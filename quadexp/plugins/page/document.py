"""One page of sections that opens without a network, on a phone and in print: the report of a sweep, a sweep while it
runs, a leaderboard, a table that sorts and filters. What a section holds is a record; one template shows them all.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from quadexp.messages import clean
from quadexp.plugins.page.typeset import typeset
from quadexp.report.frame import SweepFrame
from quadexp.report.table import Table
from quadexp.report.tables import flights_table

_NUMBER = re.compile(r"(\*\*)?(-?[\d.e+-]+)(?:\*\*)?(?: (\[[^\]]*\]))?(\*)?(?: \((.*)\))?")


@dataclass(frozen=True)
class Cell:
    """mark: label of the contestant whose marker stands before the text. small: lines below it. lost: what went wrong.
    best: in bold."""

    text: str = ""
    small: Sequence[str] = ()
    lost: str = ""
    best: bool = False
    mark: str = ""


def cell_of(text: str | Cell) -> Cell:
    """A cell of a table; of a text such as `**1.2** [1.1, 1.3]* (1 lost)` the rest stands below the number."""
    if isinstance(text, Cell):
        return text
    parts = _NUMBER.fullmatch(text)
    if parts is None:
        return Cell(text)
    bold, value, limits, star, beside = parts.groups("")
    return Cell(value + star, (limits, beside), best=bool(bold))


@dataclass(frozen=True)
class Block:
    """What stands together in a section, or on one of its tabs. figures: HTML of `style.figure_html`. tables: by a name
    that is unique on the page, with texts or `Cell`s, the first of a row its heading. sorts: they do, by a click on a
    heading, and are filtered by words. facts: (term, text). folded: only its title is seen at first. progress: (flights
    that are there, of all, the same in words)."""

    title: str = ""
    tab: str = ""
    lead: str = ""
    figures: Sequence[str] = ()
    tables: Mapping[str, Table] = field(default_factory=dict)
    sorts: bool = False
    facts: Sequence[tuple[str, str]] = ()
    code: Sequence[str] = ()
    notes: Sequence[str] = ()
    progress: tuple[int, int, str] | None = None
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
    environment.filters["cells"] = lambda texts: [*map(cell_of, texts)]
    acts = any(block.tab or block.sorts for part in sections for block in part.blocks)
    return environment.from_string(template_text("page.html.j2")).render(
        title=title,
        sections=sections,
        style=Markup(template_text("style.css")),
        script=template_text("page.js") if acts else "",
        **more,
    )


def sortable_page(title: str, table: Table, *, figures: Sequence[str] = (), notes: Sequence[str] = ()) -> str:
    """A table whose lines are sorted by a click on a heading, and filtered by a text. figures: above it."""
    block = Block(figures=figures, notes=notes, tables={"rows": table}, sorts=True)
    return document(title, [Section("rows", "", title, "", [block])])


def template_text(name: str) -> str:
    """A file of the templates."""
    return (files("quadexp.plugins.page") / "templates" / name).read_text(encoding="utf-8")


def _shown(value: Any) -> Any:
    if type(value) is str:
        return clean(value).encode(errors="backslashreplace").decode()
    return value


def page_of(frame: SweepFrame, names: Sequence[str], title: str) -> str:
    """Flights as a page that sorts and filters, and opens without a network."""
    return sortable_page(title, flights_table(frame, names), notes=[f"{len(frame.rows)} flights of {title}"])
