"""A table as one HTML page that opens without a network: sorted by a click on a heading, filtered by a text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from quadexp.messages import html

STYLE = """
:root { color-scheme: light dark; --ink: #1b1f24; --ground: #fff; --line: #d0d7de; --head: #f3f5f8; --soft: #5f6773; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6edf3; --ground: #14181d; --line: #343b44; --head: #1f252c; --soft: #9aa4af; }
}
body { font: 15px/1.45 system-ui, sans-serif; color: var(--ink); background: var(--ground); margin: 1.5rem; }
h1 { font-size: 1.25rem; } p { color: var(--soft); margin: .3rem 0; max-width: 75ch; }
figure { margin: 1rem 0; background: #fff; display: inline-block; max-width: 100%; }
figure svg { max-width: 100%; height: auto; }
input { font: inherit; padding: .3rem .5rem; width: min(24rem, 100%); box-sizing: border-box; }
.scroll { overflow-x: auto; border: 1px solid var(--line); margin-top: .6rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; width: 100%; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid var(--line); text-align: left; white-space: nowrap; }
td.n, th.n { text-align: right; }
th { background: var(--head); position: sticky; top: 0; padding: 0; }
th button { all: unset; cursor: pointer; padding: .35rem .6rem; font-weight: 600; display: block; }
th button:focus-visible { outline: 2px solid #51a3fa; }
th[aria-sort=ascending] button::after { content: " \\2191"; }
th[aria-sort=descending] button::after { content: " \\2193"; }
tr[hidden] { display: none; }
@media print { input, .found { display: none; } .scroll { overflow: visible; } tr { break-inside: avoid; } }
"""
SCRIPT = """
const table = document.querySelector("table"), body = table.tBodies[0], heads = [...table.tHead.rows[0].cells];
const key = (row, i) => { const c = row.cells[i]; return c.dataset.v === undefined ? c.textContent : +c.dataset.v; };
const missing = (row, i) => row.cells[i].textContent === "";
heads.forEach((head, i) => head.firstElementChild.addEventListener("click", () => {
  const down = head.getAttribute("aria-sort") === "ascending" ? -1 : 1;
  heads.forEach(other => other.removeAttribute("aria-sort"));
  head.setAttribute("aria-sort", down === 1 ? "ascending" : "descending");
  const rows = [...body.rows].map((row, k) => [row, k]);
  rows.sort(([a, j], [b, k]) => {
    if (missing(a, i) || missing(b, i)) return missing(a, i) - missing(b, i) || j - k;
    const x = key(a, i), y = key(b, i), same = typeof x === typeof y;
    const order = same ? (x < y ? -1 : x > y ? 1 : 0) : typeof x === "number" ? -1 : 1;
    return order * down || j - k;
  });
  body.append(...rows.map(([row]) => row));
}));
const box = document.querySelector("input"), found = document.querySelector(".found");
box.addEventListener("input", () => {
  const words = box.value.toLowerCase().split(/\\s+/).filter(Boolean);
  let count = 0;
  for (const row of body.rows) {
    const text = row.textContent.toLowerCase();
    row.hidden = !words.every(word => text.includes(word));
    count += !row.hidden;
  }
  found.textContent = `${count} of ${body.rows.length} rows`;
});
"""


@dataclass(frozen=True)
class Column:
    """name: of the value in a row. heading: what is printed above, with the unit. factor: that numbers are printed
    with."""

    name: str
    heading: str
    factor: float = 1.0


def sortable_page(
    title: str, columns: Sequence[Column], rows: Sequence[Mapping[str, Any]], *, above: str = "",
    notes: Sequence[str] = (),
) -> str:  # fmt: skip
    """The page. above: markup of a figure, made by this program; everything else is escaped."""
    numeric = {
        c.name for c in columns if all(_is_number(row.get(c.name)) or _is_empty(row.get(c.name)) for row in rows)
    }
    heads = "".join(
        f'<th scope="col"{_right(c, numeric)}><button type="button">{html(c.heading)}</button></th>' for c in columns
    )
    lines = "".join(f"<tr>{''.join(_cell(c, row.get(c.name), numeric) for c in columns)}</tr>" for row in rows)
    figure = f"<figure>{above}</figure>" if above else ""
    said = "".join(f"<p>{html(note)}</p>" for note in notes)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html(title)}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{STYLE}</style></head><body><h1>{html(title)}</h1>{said}{figure}"
        f'<p><input type="search" placeholder="filter rows" aria-label="filter rows"> '
        f'<span class="found">{len(rows)} rows</span></p>'
        f'<div class="scroll" tabindex="0"><table><thead><tr>{heads}</tr></thead><tbody>{lines}</tbody></table></div>'
        f"<script>{SCRIPT}</script></body></html>\n"
    )


def _cell(column: Column, value: Any, numeric: set[str]) -> str:
    if _is_empty(value):
        return "<td></td>"
    if not _is_number(value):
        return f"<td>{html(str(value).lower() if isinstance(value, bool) else str(value))}</td>"
    return f'<td{_right(column, numeric)} data-v="{value!r}">{column.factor * value:.6g}</td>'


def _right(column: Column, numeric: set[str]) -> str:
    return ' class="n"' if column.name in numeric else ""


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_empty(value: Any) -> bool:
    return value is None or value == "" or (isinstance(value, float) and math.isnan(value))
