"""Figures of a comparison: error against speed, tracked paths coloured by error, time of the control step.

Each function returns a matplotlib Figure and changes no global state. Colours and markers are in style.py.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize

from quadexp.files.writer import written
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.progress import doing
from quadexp.report.drawing import FORMATS
from quadexp.report.metrics import SHOWN, mean_error, position_error
from quadexp.report.pairing import Flights, is_flown
from quadexp.report.statistics import CONFIDENCE, Statistic, compute_statistics
from quadexp.report.style import PLAIN, Figure, entries, looks, plain_log, styled
from quadexp.report.tables import TITLES, column_labels, course_labels, statistic_labels

# Light for small errors, dark for large ones; without the end that is invisible on white paper.
ERROR_COLOURS = LinearSegmentedColormap.from_list(
    "error", matplotlib.colormaps["magma_r"](np.linspace(0.18, 0.97, 256))
)
MAX_PANELS = 36  # of tracked paths in one figure
MAX_ACROSS = 4  # panels of one line


@styled
def error_against_speed(
    rows: Sequence[Mapping[str, Any]], metric: str = "mean_error", confidence: float = CONFIDENCE
) -> Figure | None:
    """Error over nominal speed, a panel per trajectory (and setting) and a line per controller.

    Means and intervals are over the common flights of a point (pairing.py); a legend entry has the number of flights
    that ended well, if these are not all. None if there is no point at any speed.
    """
    factor, unit = SHOWN[metric]
    statistics = compute_statistics(rows, metrics=(metric,), baseline="", confidence=confidence)
    courses = course_labels((s.trajectory, s.setting) for s in statistics)
    labels = statistic_labels(statistics)
    points: dict[str, dict[str, list[Statistic]]] = {}
    flown: dict[str, Flights] = {}
    for s, label in zip(statistics, labels, strict=True):
        flown[label] = flown.get(label, Flights(0, 0)).plus(s.flown)
        if s.common and not math.isnan(s.speed):
            points.setdefault(courses[s.trajectory, s.setting], {}).setdefault(label, []).append(s)
    if not points:
        return None
    found = looks(labels)
    texts = {x: x if n.ended == n.trials else f"{x} ({n.text()} flown)" for x, n in flown.items()}
    chosen = [s for lines in points.values() for line in lines.values() for s in line]
    methods = {s.common_interval for s in chosen}
    # A logarithmic axis has no zero: a band with a lower limit of zero ends below the panel.
    ends = [v for s in chosen for v in (s.common_mean, s.common_low) if v > 0.1 * s.common_mean]
    across = min(len(points), MAX_ACROSS)
    lines = math.ceil(len(points) / across)
    width = max(5.6, 1.4 + 3.1 * across)
    columns = min(len(found), max(1, int(13 * width / (max(map(len, texts.values())) + 6))))  # of the legend
    height = 3.0 * lines + 0.2 * math.ceil(len(found) / columns)
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = figure.subplots(lines, across, sharey=True, squeeze=False)
    for panel, (name, by_label) in zip(panels.flat, points.items(), strict=False):
        for label, look in found.items():
            line = sorted(by_label.get(label, []), key=lambda s: s.speed)
            if not line:
                continue
            speed = np.array([s.speed for s in line])
            mean, low, high = (
                factor * np.array([getattr(s, f"common_{end}") for s in line]) for end in ("mean", "low", "high")
            )
            panel.fill_between(speed, np.maximum(low, 1e-9), high, color=look.colour, alpha=0.25, linewidth=0)
            panel.plot(speed, mean, label=texts[label], **look.points())
        panel.set_yscale("log")
        panel.set_title(textwrap.fill(name, 34))
        panel.set_xlabel("nominal speed (m/s)")
        speeds = sorted({s.speed for line in by_label.values() for s in line})
        panel.set_xticks(_apart(speeds, 0.22 * across / width * (speeds[-1] - speeds[0])))
        panel.set_xticks(speeds, minor=True)
        panel.margins(x=0.08)
        panel.grid(True, which="minor", axis="y", linewidth=0.3)
        panel.xaxis.set_major_formatter(PLAIN)
    for panel in panels.flat[len(points) :]:
        panel.set_axis_off()
    panels[0, 0].set_ylim(bottom=0.7 * factor * min(ends))
    plain_log(panels[0, 0].yaxis, minor=True)
    for line_of_panels in panels:
        line_of_panels[0].set_ylabel(f"{TITLES[metric]} ({unit})")
    all_well = all(n.ended == n.trials for n in flown.values())
    title = interval_text(methods, confidence, "seeds" if all_well else "the flights that all ended well")
    place: Any = {"loc": "outside lower center", "ncols": columns}
    figure.legend(*entries(panels.flat), **place, title=title, title_fontsize=8)
    return figure


def _apart(values: Sequence[float], least: float) -> list[float]:
    """Those of sorted values that are `least` or more apart, so that their labels do not overlap."""
    kept = [values[0]]
    for value in values[1:]:
        if value - kept[-1] >= least:
            kept.append(value)
    return kept


def interval_text(methods: Collection[str], confidence: float, over: str = "seeds") -> str:
    """Caption of lines and bands, such as "mean over seeds; shaded: its 95 % interval (Student's t)"."""
    shaded = f"; shaded: its {100 * confidence:g} % interval (Student's t)" if "t" in methods else ""
    return f"mean over {over}{shaded}"


@styled
def tracked_paths(flights: Sequence[tuple[str, Flight]], title: str = "", missing: Sequence[str] = ()) -> Figure:
    """Flown paths seen from above, coloured by the position error, over the reference; one scale for all panels.

    flights: (heading, flight). missing: headings without a panel, with the reason; printed below the title, as are
    flights beyond MAX_PANELS.
    """
    missing = [*missing, *(f"{heading} (no room)" for heading, _ in flights[MAX_PANELS:])]
    flights = flights[:MAX_PANELS]
    errors = [1e3 * position_error(flight) for _, flight in flights]
    largest = max(float(error.max()) for error in errors)
    smallest = max(min(float(np.percentile(error, 5)) for error in errors), 1e-4 * largest)
    columns = min(len(flights), 3) if len(flights) != 4 else 2
    lines = math.ceil(len(flights) / columns)
    across, up = (max(float(np.ptp(f[name])) for _, f in flights) for name in ("p_x", "p_y"))
    height = 3.0 * min(1.2, max(0.35, up / max(across, 1e-9)))
    figure = Figure(figsize=(1.4 + 3.0 * columns, 0.8 + (0.45 + height) * lines), layout="compressed")
    grid = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    norm = LogNorm(smallest, largest) if smallest < largest else Normalize(0.0, largest or 1.0)
    for panel, (heading, flight), error in zip(grid.flat, flights, errors, strict=False):
        x, y = flight["p_x"], flight["p_y"]
        panel.plot(flight["ref_p_x"], flight["ref_p_y"], color="#888888", linewidth=0.8, label="reference")
        segments = np.stack([np.column_stack([x[:-1], y[:-1]]), np.column_stack([x[1:], y[1:]])], axis=1)
        flown = LineCollection(list(segments), cmap=ERROR_COLOURS, norm=norm, linewidth=1.6)
        flown.set_array(np.maximum((error[:-1] + error[1:]) / 2, smallest))
        panel.add_collection(flown)
        panel.plot(x[0], y[0], marker="o", markersize=4, color="#000000", linestyle="none", label="start")
        panel.set_title(f"{textwrap.fill(heading, 28)}\nmean {1e3 * mean_error(flight):.3g} mm", fontsize=9)
        panel.set_aspect("equal")
    for panel in grid.flat[len(flights) :]:
        panel.set_visible(False)
    for panel in grid[-1]:
        panel.set_xlabel("x (m)")
    for panel in grid[:, 0]:
        panel.set_ylabel("y (m)")
    shown = ScalarMappable(norm, ERROR_COLOURS)
    bar = figure.colorbar(shown, ax=grid, label="position error (mm)", shrink=0.85, aspect=20 * lines)
    if isinstance(norm, LogNorm):
        plain_log(bar.ax.yaxis)
    figure.legend(*entries([grid.flat[0]]), loc="outside lower center", ncols=2)
    if missing:
        title = f"{title}\n" + textwrap.fill(f"not drawn: {', '.join(missing)}", int(14 * figure.get_size_inches()[0]))
    if title:
        figure.suptitle(title.strip(), fontsize=10)
    return figure


@styled
def solve_times(rows: Sequence[Mapping[str, Any]]) -> Figure | None:
    """Time of the control step per controller: medians over its flights of their median and 99th percentile."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    labels = column_labels(rows)
    for row, label in zip(rows, labels, strict=True):
        if is_flown(row):
            groups.setdefault(label, []).append(row)
    if not groups:
        return None
    figure = Figure(figsize=(7.2, 1.1 + 0.4 * len(groups)), layout="constrained")
    panel = figure.subplots()
    found = looks(labels)
    for i, (label, group) in enumerate(groups.items()):
        median, p99 = (1e6 * float(np.median([row[f"solve_time_{k}"] for row in group])) for k in ("median", "p99"))
        colour = found[label].colour
        panel.plot([median, p99], [i, i], color=colour, linewidth=2, alpha=0.6, zorder=2)
        panel.plot(median, i, **found[label].points() | {"markersize": 7})
        panel.plot(p99, i, marker="|", markersize=11, markeredgewidth=2, color=colour)
        panel.annotate(
            f"{median:.0f} / {p99:.0f}", (p99, i), (7, 0), textcoords="offset points", va="center", fontsize=8
        )
    backends = sorted({row["backend"] for group in groups.values() for row in group if row.get("backend")})
    panel.set_xscale("log")
    panel.set_yticks(range(len(groups)), list(groups))
    panel.invert_yaxis()
    panel.grid(True, which="minor", axis="x", linewidth=0.3)
    panel.grid(False, axis="y")
    panel.margins(x=0.18, y=0.5 / len(groups))
    plain_log(panel.xaxis)
    panel.set_xlabel("time (µs): median (marker) / 99th percentile (bar)")
    panel.set_title(f"control step, {', '.join(backends)}")
    gone = [label for label in dict.fromkeys(labels) if label not in groups]
    if gone:
        figure.suptitle(textwrap.fill(f"no flight ended well: {', '.join(gone)}", 90), fontsize=8)
    return figure


def path_figure(cells: Mapping[str, str], title: str, missing: Sequence[str]) -> Figure:
    """`tracked_paths` of flights on disk. cells: heading -> file of the flight."""
    return tracked_paths([(heading, read_flight(path)) for heading, path in cells.items()], title, missing)


@styled
def save(figure: Figure, path: Path, inside: Path | None = None) -> Path:
    """Write a figure as SVG and PNG; returns the path of the SVG. inside: see `written`."""
    doing(f"drawing {path.name}")
    for form in FORMATS:
        metadata = {"Date": None} if form == "svg" else None
        with written(path.with_suffix(f".{form}"), inside=inside) as file:
            figure.savefig(file, format=form, dpi=150, metadata=metadata)
    return path.with_suffix(".svg")
