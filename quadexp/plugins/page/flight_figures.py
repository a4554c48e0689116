"""Figures of flights and logs: paths seen from above, errors and columns over time, the quality check, the delays.

Each function returns a matplotlib Figure and changes no global state. Colours and markers are in style.py.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize

from quadexp.errors import UsageError
from quadexp.log.schema import Flight
from quadexp.names import distinct
from quadexp.physics.state import norms
from quadexp.report.metrics import mean_error, position_error
from quadexp.report.pairing import grouped
from quadexp.report.style import COLOURS, ERROR_COLOURS, Figure, entries, error_bar, looks, plain_log, styled

MS = 1e3  # of a second
MAX_PANELS = 36  # of tracked paths in one figure


@styled
def tracked_paths(
    flights: Mapping[tuple[str, str], Flight],
    title: str = "",
    missing: Mapping[tuple[str, str], str] | None = None,
    left_out: Sequence[str] = (),
) -> Figure:
    """Flown paths seen from above, coloured by the position error, over the reference; one scale for all panels.

    flights: (controller, condition) -> flight; a row a controller, a column a condition. missing: the reason of a place
    without a flight, written there. left_out: what has no panel, named below the title.
    """
    places = dict.fromkeys([*flights, *(missing or {})])
    controllers, conditions = (distinct(place[k] for place in places) for k in (0, 1))
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
    error_bar(figure, norm, grid, "position error (mm)", shrink=0.85, aspect=20 * lines)
    figure.legend(*entries(grid.flat), loc="outside lower center", ncols=2)
    title = ", ".join(filter(None, (title, conditions[0] if single else "")))
    if left_out:
        title += "\n" + textwrap.fill(f"not drawn: {'; '.join(left_out)}", int(14 * figure.get_size_inches()[0]))
    if title:
        figure.suptitle(title.strip(), fontsize=10)
    return figure


def _draw_path(panel: Any, flight: Flight, error: np.ndarray, norm: Normalize) -> None:
    """error: of the samples (mm)."""
    x = flight["p_x"]
    y = flight["p_y"]
    panel.plot(flight["ref_p_x"], flight["ref_p_y"], color="#888888", linewidth=0.8, label="reference")
    segments = np.stack([np.column_stack([x[:-1], y[:-1]]), np.column_stack([x[1:], y[1:]])], axis=1)
    flown = LineCollection(list(segments), cmap=ERROR_COLOURS, norm=norm, linewidth=1.6)
    flown.set_array((error[:-1] + error[1:]) / 2)
    panel.add_collection(flown)
    panel.plot(x[0], y[0], marker="o", markersize=4, color="#000000", linestyle="none", label="start")


@styled
def flights_figure(flights: Mapping[str, Flight]) -> Figure:
    """Left the paths from above with the first one's reference, right the distance to it over time, of a log without
    one the speed; below that of one flight the rotor thrusts. flights: by name."""
    if empty := next((name for name, flight in flights.items() if not len(flight)), None):
        raise UsageError(f"{empty}: holds no samples ({flights[empty].outcome}), there is nothing to draw")
    first = next(iter(flights.values()))
    thrusts = [name for name in first.columns if name.startswith("u_")] if len(flights) == 1 else []
    figure = Figure(figsize=(10.0, 4.4))
    places: Any = figure.subplot_mosaic([["above", "course"], ["above", "thrusts" if thrusts else "course"]])
    above = places["above"]
    course = places["course"]
    referred = "ref_p_x" in first.columns
    if referred:
        above.plot(first["ref_p_x"], first["ref_p_y"], color="#888888", linewidth=3.5, alpha=0.45, label="reference")
    look = looks([f"{flight.metadata.get('controller', '')} {name}".strip() for name, flight in flights.items()])
    for (name, flight), worn in zip(flights.items(), look.values(), strict=True):
        above.plot(flight["p_x"], flight["p_y"], label=name, **worn.line())
        if referred:
            values = np.maximum(MS * position_error(flight), 1e-6)
            name = f"{name}: mean {MS * mean_error(flight):.3g} mm"
        else:
            values = norms(flight.stack(["v_x", "v_y", "v_z"]))
        course.plot(flight.t, values, label=name, **worn.line())
    above.set(xlabel="x (m)", ylabel="y (m)")
    above.set_aspect("equal", adjustable="datalim")
    course.set(xlabel="" if thrusts else "time (s)", ylabel="position error (mm)" if referred else "speed (m/s)")
    if referred and len(flights) > 1:
        drawn = [line.get_ydata() for line in course.get_lines()]
        least = min(float(np.percentile(values, 2)) for values in drawn)
        largest = max(map(np.max, drawn))
        course.set(yscale="log")
        course.set_ylim(bottom=max(1e-4 * largest, 0.5 * least))
        plain_log(course.yaxis, minor=True)
    for i, name in enumerate(thrusts):
        places["thrusts"].plot(first.t, first[name], color=COLOURS[i % len(COLOURS)], label=name, linewidth=0.8)
    if thrusts:
        places["thrusts"].set(xlabel="time (s)", ylabel="rotor thrusts (N)")
    for panel in (above, course):
        panel.legend(fontsize=8)
    return figure


@styled
def over_time(flight: Flight, columns: Sequence[str], units: Mapping[str, str]) -> Figure:
    """Columns over time; those that share a unit share a panel. units: by column."""
    groups = grouped((units.get(name, ""), name) for name in columns)
    figure = Figure(figsize=(7.2, 0.6 + 1.8 * len(groups)))
    panels = figure.subplots(len(groups), 1, sharex=True, squeeze=False)[:, 0]
    for panel, (unit, names) in zip(panels, groups.items(), strict=True):
        for i, name in enumerate(names):
            panel.plot(flight.t, flight[name], color=COLOURS[i % len(COLOURS)], label=name)
        panel.set_ylabel(f"({unit})" if unit else "")
        panel.legend(loc="upper right", ncols=4)
    panels[-1].set_xlabel("t (s)")
    return figure
