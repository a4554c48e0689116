"""Figures of a comparison beside its errors: tracked paths coloured by error, time of the control step.

Each function returns a matplotlib Figure and changes no global state. Colours and markers are in style.py.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import LinearSegmentedColormap, LogNorm, Normalize

from quadexp.files.writer import written
from quadexp.log.schema import Flight
from quadexp.progress import doing
from quadexp.report import FORMATS
from quadexp.report.metrics import mean_error, position_error
from quadexp.report.pairing import is_flown
from quadexp.report.style import Figure, entries, looks, plain_log, styled
from quadexp.report.tables import column_labels

# Light for small errors, dark for large ones; without the end that is invisible on white paper.
ERROR_COLOURS = LinearSegmentedColormap.from_list(
    "error", matplotlib.colormaps["magma_r"](np.linspace(0.18, 0.97, 256))
)
MAX_PANELS = 36  # of tracked paths in one figure


@styled
def tracked_paths(
    flights: Mapping[tuple[str, str], Flight], title: str = "", missing: Mapping[tuple[str, str], str] | None = None,
    left_out: Sequence[str] = (),
) -> Figure:  # fmt: skip
    """Flown paths seen from above, coloured by the position error, over the reference; one scale for all panels.

    flights: (controller, condition) -> flight; a row a controller, a column a condition. missing: the reason of a place
    without a flight, written there. left_out: what has no panel, named below the title.
    """
    places = dict.fromkeys([*flights, *(missing or {})])
    controllers, conditions = (list(dict.fromkeys(place[k] for place in places)) for k in (0, 1))
    most = max(1, MAX_PANELS // len(conditions))
    left_out = [*left_out, *(f"{controller} (no room)" for controller in controllers[most:])]
    panels = [(controller, condition) for controller in controllers[:most] for condition in conditions]
    errors = {place: 1e3 * position_error(flights[place]) for place in panels if place in flights}
    largest = max(float(error.max()) for error in errors.values())
    smallest = max(min(float(np.percentile(error, 5)) for error in errors.values()), 1e-4 * largest)
    norm = LogNorm(smallest, largest) if smallest < largest else Normalize(0.0, largest or 1.0)
    single = len(conditions) == 1
    columns = (min(len(panels), 3) if len(panels) != 4 else 2) if single else len(conditions)
    lines = math.ceil(len(panels) / columns)
    across, up = (max(float(np.ptp(f[name])) for f in flights.values()) for name in ("p_x", "p_y"))
    height = 3.0 * min(1.2, max(0.35, up / max(across, 1e-9)))
    figure = Figure(figsize=(1.4 + 3.0 * columns, 0.8 + (0.45 + height) * lines), layout="compressed")
    grid = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    for k, (panel, place) in enumerate(zip(grid.flat, panels, strict=False)):
        heading = [textwrap.fill(place[0] if single else place[1], 28)] if single or k < columns else []
        if place in flights:
            _draw_path(panel, flights[place], np.maximum(errors[place], smallest), norm)
            heading.append(f"mean {1e3 * mean_error(flights[place]):.3g} mm")
        else:
            panel.text(0.5, 0.5, (missing or {}).get(place, "not flown"), transform=panel.transAxes, ha="center")
        panel.set_title("\n".join(heading), fontsize=9)
        panel.set_aspect("equal")
    for panel in grid.flat[len(panels) :]:
        panel.set_visible(False)
    for panel in grid[-1]:
        panel.set_xlabel("x (m)")
    for panel, controller in zip(grid[:, 0], controllers, strict=False):
        panel.set_ylabel("y (m)" if single else f"{textwrap.fill(controller, 28)}\ny (m)")
    shown = ScalarMappable(norm, ERROR_COLOURS)
    bar = figure.colorbar(shown, ax=grid, label="position error (mm)", shrink=0.85, aspect=20 * lines)
    if isinstance(norm, LogNorm):
        plain_log(bar.ax.yaxis)
    figure.legend(*entries(grid.flat), loc="outside lower center", ncols=2)
    title = ", ".join(filter(None, (title, conditions[0] if single else "")))
    if left_out:
        title += "\n" + textwrap.fill(f"not drawn: {'; '.join(left_out)}", int(14 * figure.get_size_inches()[0]))
    if title:
        figure.suptitle(title.strip(), fontsize=10)
    return figure


def _draw_path(panel: Any, flight: Flight, error: np.ndarray, norm: Normalize) -> None:
    """error: of the samples (mm)."""
    x, y = flight["p_x"], flight["p_y"]
    panel.plot(flight["ref_p_x"], flight["ref_p_y"], color="#888888", linewidth=0.8, label="reference")
    segments = np.stack([np.column_stack([x[:-1], y[:-1]]), np.column_stack([x[1:], y[1:]])], axis=1)
    flown = LineCollection(list(segments), cmap=ERROR_COLOURS, norm=norm, linewidth=1.6)
    flown.set_array((error[:-1] + error[1:]) / 2)
    panel.add_collection(flown)
    panel.plot(x[0], y[0], marker="o", markersize=4, color="#000000", linestyle="none", label="start")


@styled
def solve_times(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Time of the control step per controller: medians over its flights of their median and 99th percentile."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    labels = column_labels(rows)
    for row, label in zip(rows, labels, strict=True):
        if is_flown(row):
            groups.setdefault(label, []).append(row)
    figure = Figure(figsize=(7.2, 1.1 + 0.4 * len(groups)), layout="constrained")
    panel = figure.subplots()
    look = looks(labels)
    for i, (label, group) in enumerate(groups.items()):
        median, p99 = (1e6 * float(np.median([row[f"solve_time_{k}"] for row in group])) for k in ("median", "p99"))
        colour = look[label].colour
        panel.plot([median, p99], [i, i], color=colour, linewidth=2, alpha=0.6, zorder=2)
        panel.plot(median, i, **look[label].points() | {"markersize": 7})
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
        figure.suptitle(textwrap.fill(f"no flight was completed: {', '.join(gone)}", 90), fontsize=8)
    return figure


@styled
def save(figure: Figure, path: Path, inside: Path | None = None, mark: str = "") -> Path:
    """Write a figure as SVG and PNG; returns the path of the SVG, the last that is written. inside: see `written`.
    mark: an identifier that the SVG is to hold."""
    doing(f"drawing {path.name}")
    for form in FORMATS[::-1]:
        metadata = {"Date": None, **({"Identifier": mark} if mark else {})} if form == "svg" else None
        with written(path.with_suffix(f".{form}"), inside=inside) as file:
            figure.savefig(file, format=form, dpi=150, metadata=metadata)
    return path.with_suffix(".svg")
