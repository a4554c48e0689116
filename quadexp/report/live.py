"""A sweep while it runs: how far it is, its table so far, and the error over the speed, as text, HTML and SVG.

Means are over the flights of each controller that have ended well so far, so they are of different flights until all
are flown: the table of results, which compares common flights only, is made at the end.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from quadexp.messages import html, printable
from quadexp.report.page.palette import SHAPE_PATHS, SHAPES, css_blocks
from quadexp.report.page.source import spoken
from quadexp.report.pairing import condition_of, contestant_labels, contestant_of, is_flown, is_invalid
from quadexp.report.style import Look, looks
from quadexp.report.tables import TITLES, course_labels
from quadexp.report.text import number, shown, speed_text

MOST_PANELS = 6
MOST_LINES = 60  # of the table on the page
WIDTH, HEIGHT = 340, 220  # of a panel
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 10, 30  # its margins
SO_FAR = "Means over the flights that ended well so far; the table of results compares common flights only."


@dataclass(frozen=True)
class Cell:
    """Flights of a contestant under one condition. ended: well, of flown. errors: of those, in the metric's unit."""

    flown: int = 0
    errors: tuple[float, ...] = ()

    @property
    def mean(self) -> float:
        return sum(self.errors) / len(self.errors) if self.errors else math.nan

    def text(self) -> str:
        """The mean, with the number of lost flights."""
        lost = self.flown - len(self.errors)
        return ("" if not self.flown else number(self.mean)) + (f" ({lost} lost)" if lost else "")


@dataclass
class Live:
    """What is known of a sweep that runs. total: of its flights. elapsed: s. before: flights that were there already.
    state: "running", "finished", or why it ended."""

    title: str
    metric: str
    total: int = 0
    elapsed: float = 0.0
    before: int = 0
    state: str = "running"
    rows: list[Mapping[str, Any]] = field(default_factory=list)

    @property
    def done(self) -> int:
        return len(self.rows)

    @property
    def asked(self) -> list[Mapping[str, Any]]:
        """The rows of flights; settings that contradict each other are none."""
        return [row for row in self.rows if not is_invalid(row)]

    @property
    def left(self) -> float:
        """Seconds that the rest will take at the rate so far; NaN where it is not known."""
        flown = self.done - self.before
        return self.elapsed / flown * (self.total - self.done) if flown > 0 else math.nan

    def ended(self) -> dict[str, tuple[int, int]]:
        """Label -> flights that ended well, and all that are there."""
        labels = self._labels()
        found: dict[str, tuple[int, int]] = {}
        for row in self.asked:
            label = labels[contestant_of(row)]
            well, all_of_them = found.get(label, (0, 0))
            found[label] = well + is_flown(row), all_of_them + 1
        return dict(sorted(found.items()))

    def lines(self) -> dict[tuple[str, str, str], dict[str, Cell]]:
        """(world, course, speed) -> label -> cell, ordered by course and speed."""
        factor, _ = shown(self.metric)
        labels = self._labels()
        rows = self.asked
        conditions = [condition_of(row) for row in rows]
        courses = course_labels((c[2], c[4]) for c in conditions)
        several = len({c[:2] for c in conditions}) > 1
        found: dict[tuple[Any, ...], dict[str, Cell]] = {}
        for row, (plant, vehicle, trajectory, speed, setting) in zip(rows, conditions, strict=True):
            line = (f"{plant}, {vehicle}" if several else "", courses[trajectory, setting], speed)
            cell = found.setdefault(line, {}).get(labels[contestant_of(row)], Cell())
            error = row[self.metric]
            good = is_flown(row) and error is not None and math.isfinite(error)
            errors = (*cell.errors, factor * error) if good else cell.errors
            found[line][labels[contestant_of(row)]] = Cell(cell.flown + 1, errors)
        ordered = sorted(found, key=lambda line: (line[0], line[1], line[2] if line[2] is not None else -1.0))
        return {(world, course, speed_text(speed, "")): found[world, course, speed] for world, course, speed in ordered}

    def look_of(self) -> dict[str, Look]:
        return looks(sorted(self._labels().values()))

    def _labels(self) -> dict[Any, str]:
        return contestant_labels(list(dict.fromkeys(map(contestant_of, self.asked))))


def clock(seconds: float) -> str:
    """Such as "1:05 min" or "2:03:10 h"; "?" where it is not known."""
    if not math.isfinite(seconds):
        return "?"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d} h" if hours else f"{minutes}:{rest:02d} min" if minutes else f"{rest} s"


def progress_text(live: Live) -> str:
    """How far it is, in a sentence."""
    count = f"{live.done} of {live.total} flights"
    if live.state == "running":
        rest = f", about {clock(live.left)} left" if math.isfinite(live.left) else ""
        return f"{count}, {clock(live.elapsed)} so far{rest}"
    return f"{count}, {live.state}"


def live_table(live: Live) -> Any:
    """The table so far as a rich one."""
    from rich.table import Table
    from rich.text import Text

    _, unit = shown(live.metric)
    ended, lines = live.ended(), live.lines()
    title = f"{TITLES.get(live.metric, live.metric)} so far ({unit}): {progress_text(live)}"
    table = Table(title=Text(printable(title)), title_justify="left")
    table.add_column("trajectory", overflow="fold")
    table.add_column("m/s", justify="right", overflow="fold")
    for label, (well, flown) in ended.items():
        table.add_column(Text(f"{printable(label)}\n{well} of {flown} ended well"), justify="right", overflow="fold")
    for (world, course, speed), cells in lines.items():
        where = f"{course} ({world})" if world else course
        table.add_row(Text(printable(where)), speed, *(cells.get(label, Cell()).text() for label in ended))
    return table


# ---------------------------------------------------------------------------------------------------------- the page
def fragment(live: Live) -> str:
    """The part of the page that changes."""
    share = 100 * live.done / live.total if live.total else 0.0
    kind = html(live.state.split(" ")[0])
    values = f'aria-valuemin="0" aria-valuemax="{live.total}" aria-valuenow="{live.done}"'
    parts = [
        f'<p class="state" data-state="{kind}">{html(progress_text(live))}</p>',
        f'<div class="bar" role="progressbar" aria-label="Flights" {values}><i style="width:{share:.1f}%"></i></div>',
    ]
    if live.rows:
        parts += [_counts(live), _table(live), _panels(live)]
    return "\n".join(parts)


def page(live: Live, *, script: str = "", nonce: str = "") -> str:
    """The whole page. script: that renews it while the sweep runs, run under `nonce`."""
    light, dark = css_blocks()
    run = f'<script nonce="{nonce}">{script}</script>' if script else ""
    title = html(live.title)
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<link rel="icon" href="data:,"><title>{title} - quadexp sweep</title>
<style>:root{{{light}}}@media (prefers-color-scheme:dark){{:root{{{dark}}}}}@media print{{:root{{{light}}}}}
{STYLE}</style></head>
<body><main><h1>{title}</h1><p class="gone" id="gone" hidden></p><div id="live">
{fragment(live)}
</div></main>{run}</body></html>
"""


STYLE = """
body{margin:0;background:var(--ground);color:var(--ink);font:16px/1.5 system-ui,sans-serif}
main{max-width:72rem;margin:0 auto;padding:1.2rem}
h1{font-size:1.4rem;margin:0 0 .3rem;overflow-wrap:anywhere}h2{font-size:1.05rem;margin:1.4rem 0 .4rem}
.state{margin:.2rem 0;font-variant-numeric:tabular-nums}.note,.gone{color:var(--muted);font-size:.9rem}
.bar{height:.7rem;background:var(--rule);border-radius:.4rem;overflow:hidden}
.bar i{display:block;height:100%;background:var(--accent)}
.scroll{overflow-x:auto}table{border-collapse:collapse;font-variant-numeric:tabular-nums}
th,td{padding:.25rem .7rem;border-bottom:1px solid var(--rule);text-align:right;white-space:nowrap}
th:first-child,td:first-child{text-align:left}th{font-weight:600}
.lost{color:var(--alarm);font-weight:600}.mark{width:.8em;height:.8em;margin-right:.4em;overflow:visible}
.mark path{fill:var(--own);stroke:var(--own)}.hollow path{fill:var(--panel);stroke-width:1.6}
.panels{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,20rem),1fr));gap:1rem}
.panels svg{width:100%;height:auto;background:var(--panel)}figure{margin:0}figcaption{font-weight:600}
.panels text{fill:var(--muted);font-size:11px}
@media print{main{max-width:none}figure,tr{break-inside:avoid}h2{break-after:avoid}}
"""


def _mark(look: Look, at: tuple[float, float] | None = None) -> str:
    path, kind = SHAPE_PATHS[SHAPES[look.marker]], "" if look.filled else " hollow"
    own = f'style="--own:var(--series-{look.token})"'
    if at is None:
        return f'<svg class="mark{kind}" viewBox="-5 -5 10 10" {own} aria-hidden="true"><path d="{path}"/></svg>'
    return f'<g class="mark{kind}" {own} transform="translate({at[0]:.1f} {at[1]:.1f})"><path d="{path}"/></g>'


def _counts(live: Live) -> str:
    """Success first: flights that ended well, of those that are there."""
    look_of, rows = live.look_of(), []
    for label, (well, flown) in live.ended().items():
        lost = f' <span class="lost">{flown - well} lost</span>' if well < flown else ""
        name = f"{_mark(look_of[label])}{html(spoken(label))}"
        rows.append(f'<tr data-label="{html(label)}"><th scope="row">{name}</th><td>{well} of {flown}{lost}</td></tr>')
    return f'<h2>Ended well</h2><div class="scroll"><table data-ended>{"".join(rows)}</table></div>'


def _table(live: Live) -> str:
    _, unit = shown(live.metric)
    look_of, ended, lines = live.look_of(), live.ended(), live.lines()
    heads = "".join(f'<th scope="col">{_mark(look_of[x])}{html(spoken(x))}</th>' for x in ended)
    body = []
    for (world, course, speed), cells in [*lines.items()][:MOST_LINES]:
        where = html(f"{course} ({world})" if world else course)
        values = "".join(f"<td>{cells.get(label, Cell()).text()}</td>" for label in ended)
        body.append(f'<tr><th scope="row">{where}</th><td>{speed}</td>{values}</tr>')
    more = f" {len(lines) - MOST_LINES} more lines are not shown." if len(lines) > MOST_LINES else ""
    columns = f'<th scope="col">trajectory</th><th scope="col">m/s</th>{heads}'
    return (
        f"<h2>{TITLES.get(live.metric, live.metric).capitalize()} ({unit})</h2>"
        f'<div class="scroll"><table data-table><thead><tr>{columns}</tr></thead><tbody>'
        f'{"".join(body)}</tbody></table></div><p class="note">{SO_FAR}{more}</p>'
    )


def _panels(live: Live) -> str:
    """The error over the speed, a panel for each course and world; a logarithmic scale that all share."""
    look_of = live.look_of()
    courses: dict[str, list[tuple[str, dict[str, Cell]]]] = {}
    for (world, course, speed), cells in live.lines().items():
        courses.setdefault(f"{course} ({world})" if world else course, []).append((speed, cells))
    means = [cell.mean for group in courses.values() for _, cells in group for cell in cells.values()]
    means = [value for value in means if math.isfinite(value) and value > 0]
    if not means:
        return ""
    low, high = math.floor(math.log10(min(means))), math.ceil(math.log10(max(means)))
    scale = (low, high if high > low else low + 1)
    figures = [
        f"<figure><figcaption>{html(course)}</figcaption>{_panel(course, group, scale, look_of, live)}</figure>"
        for course, group in [*courses.items()][:MOST_PANELS]
    ]
    more = len(courses) - MOST_PANELS
    said = f'<p class="note">{more} more paths are in the table only.</p>' if more > 0 else ""
    return f'<h2>Error against speed</h2><div class="panels">{"".join(figures)}</div>{said}'


def _panel(
    course: str,
    group: Sequence[tuple[str, dict[str, Cell]]],
    scale: tuple[int, int],
    look_of: dict[str, Look],
    live: Live,
) -> str:
    _, unit = shown(live.metric)
    low, high = scale
    speeds = [float(speed) if speed else 0.0 for speed, _ in group]
    first, last = min(speeds), max(speeds)
    pad = (last - first) * 0.05 or 0.5

    def x(speed: float) -> float:
        return LEFT + (speed - first + pad) / (last - first + 2 * pad) * (WIDTH - LEFT - RIGHT)

    def y(value: float) -> float:
        return TOP + (high - math.log10(value)) / (high - low) * (HEIGHT - TOP - BOTTOM)

    parts = [
        f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y(10.0**k):.1f}" y2="{y(10.0**k):.1f}" stroke="var(--rule)"/>'
        f'<text x="{LEFT - 6}" y="{y(10.0**k) + 4:.1f}" text-anchor="end">{10.0**k:g}</text>'
        for k in range(low, high + 1)
    ]
    parts += [
        f'<text x="{x(speed):.1f}" y="{HEIGHT - 12}" text-anchor="middle">{speed:g}</text>'
        for speed in dict.fromkeys(speeds)
        if group[0][0]
    ]
    parts.append(f'<text x="{LEFT}" y="{HEIGHT - 1}">m/s; {unit}, logarithmic</text>')
    for label, look in look_of.items():
        points = [
            (x(speed), y(cells[label].mean))
            for speed, (_, cells) in zip(speeds, group, strict=True)
            if label in cells and cells[label].mean > 0
        ]
        line = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
        parts.append(f'<polyline points="{line}" fill="none" stroke="var(--series-{look.token})" stroke-width="1.6"/>')
        parts += [_mark(look, point) for point in points]
    label = f"Error against speed on {course}, {len(group)} speeds, {len(look_of)} controllers"
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html(label)}">{"".join(parts)}</svg>'
