"""Figures of flights and logs: paths seen from above, errors and columns over time, the quality check, the delays.

Each function returns a matplotlib Figure and changes no global state. Colours and markers are in style.py.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle, product
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm, Normalize

from quadexp.errors import UsageError
from quadexp.log.schema import Flight
from quadexp.names import distinct
from quadexp.physics.state import norms
from quadexp.plugins.drawing.style import COLOURS, ERROR_COLOURS, Figure, entries, error_bar, looks, plain_log, styled
from quadexp.report.metrics import mean_error, position_error
from quadexp.report.pairing import grouped

MM = 1e3  # of a metre
OF_A_FLIGHT = ("t", "p_x", "p_y", "p_z", "v_x", "v_y", "v_z")  # columns that its figure needs
LEAST_ERROR = 1e-6  # mm, on a logarithmic axis
LEAST_SHARE = 1e-4  # of the largest error, of the least one on a logarithmic scale
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
    missing = missing or {}
    places = [*flights, *missing]
    controllers = distinct(controller for controller, _ in places)
    conditions = distinct(condition for _, condition in places)
    most = max(1, MAX_PANELS // len(conditions))
    left_out = [*left_out, *(f"{controller} (no room)" for controller in controllers[most:])]
    panels = [*product(controllers[:most], conditions)]
    single = len(conditions) == 1
    columns = len(conditions)
    if len(panels) == 4 and single:
        columns = 2
    elif single:
        columns = min(len(panels), 3)
    lines = math.ceil(len(panels) / columns)
    norm = _error_scale([flights[place] for place in panels if place in flights])
    across = max(float(np.ptp(flight["p_x"])) for flight in flights.values())
    up = max(float(np.ptp(flight["p_y"])) for flight in flights.values())
    height = 3.0 * min(1.2, max(0.35, up / max(across, 1e-9)))
    figure = Figure(figsize=(1.4 + 3.0 * columns, 0.8 + (0.45 + height) * lines), layout="compressed")
    grid = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    for k, (panel, place) in enumerate(zip(grid.flat, panels, strict=False)):
        heading = []
        if single or k < columns:
            heading.append(textwrap.fill(place[0] if single else place[1], 28))
        if place in flights:
            _draw_path(panel, flights[place], norm)
            heading.append(f"mean {MM * mean_error(flights[place]):.3g} mm")
        else:
            panel.text(0.5, 0.5, missing.get(place, "not flown"), transform=panel.transAxes, ha="center")
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
    if single:
        title = ", ".join(filter(None, (title, conditions[0])))
    if left_out:
        room = int(14 * figure.get_size_inches()[0])  # letters
        title += "\n" + textwrap.fill(f"not drawn: {'; '.join(left_out)}", room)
    if title:
        figure.suptitle(title.strip(), fontsize=10)
    return figure


def _error_scale(flights: Sequence[Flight]) -> Normalize:
    """The scale of colours of position errors (mm), logarithmic from small ones on."""
    errors = [MM * position_error(flight) for flight in flights]
    largest = max(float(error.max()) for error in errors)
    small = min(float(np.percentile(error, 5)) for error in errors)
    smallest = max(small, LEAST_SHARE * largest)
    if smallest < largest:
        return LogNorm(smallest, largest)
    return Normalize(0.0, largest or 1.0)


def _draw_path(panel: Any, flight: Flight, norm: Normalize) -> None:
    """The reference, and the path in pieces that have the colour of their error."""
    panel.plot(flight["ref_p_x"], flight["ref_p_y"], color="#888888", linewidth=0.8, label="reference")
    points = flight.stack(["p_x", "p_y"])
    error = np.maximum(MM * position_error(flight), norm.vmin or 0.0)
    pieces = np.stack([points[:-1], points[1:]], axis=1)
    flown = LineCollection([*pieces], cmap=ERROR_COLOURS, norm=norm)
    flown.set_linewidth(1.6)
    flown.set_array((error[:-1] + error[1:]) / 2)
    panel.add_collection(flown)
    panel.plot(*points[0], marker="o", markersize=4, color="#000000", linestyle="none", label="start")


@styled
def flights_figure(flights: Mapping[str, Flight]) -> Figure:
    """Left the paths from above with the first one's reference, right the distance to it over time, of a log without
    one the speed; below that of one flight the rotor thrusts. flights: by name."""
    for name, flight in flights.items():
        if not len(flight):
            raise UsageError(f"{name}: holds no samples ({flight.outcome}), there is nothing to draw")
    first = next(iter(flights.values()))
    thrusts = []
    if len(flights) == 1:
        thrusts = [name for name in first.columns if name.startswith("u_")]
    referred = "ref_p_x" in first.columns
    figure = Figure(figsize=(10.0, 4.4))
    below = "thrusts" if thrusts else "course"
    places: Any = figure.subplot_mosaic([["above", "course"], ["above", below]])
    above = places["above"]
    course = places["course"]
    if referred:
        above.plot(first["ref_p_x"], first["ref_p_y"], color="#888888", linewidth=3.5, alpha=0.45, label="reference")
    look = looks([f"{flight.metadata.get('controller', '')} {name}".strip() for name, flight in flights.items()])
    drawn = []
    for (name, flight), style in zip(flights.items(), look.values(), strict=True):
        if referred:
            values = np.maximum(MM * position_error(flight), LEAST_ERROR)
            label = f"{name}: mean {MM * mean_error(flight):.3g} mm"
        else:
            values = norms(flight.stack(["v_x", "v_y", "v_z"]))
            label = name
        above.plot(flight["p_x"], flight["p_y"], label=name, **style.line())
        course.plot(flight.t, values, label=label, **style.line())
        drawn.append(values)
    above.set(xlabel="x (m)", ylabel="y (m)")
    above.set_aspect("equal", adjustable="datalim")
    course.set(xlabel="" if thrusts else "time (s)", ylabel="position error (mm)" if referred else "speed (m/s)")
    if referred and len(flights) > 1:
        least = min(float(np.percentile(values, 2)) for values in drawn)
        largest = max(float(values.max()) for values in drawn)
        course.set(yscale="log")
        course.set_ylim(bottom=max(LEAST_SHARE * largest, 0.5 * least))
        plain_log(course.yaxis, minor=True)
    if thrusts:
        _draw_columns(places["thrusts"], first, thrusts, linewidth=0.8)
        places["thrusts"].set(xlabel="time (s)", ylabel="rotor thrusts (N)")
    above.legend(fontsize=8)
    course.legend(fontsize=8)
    return figure


def _draw_columns(panel: Any, flight: Flight, names: Sequence[str], **look: Any) -> None:
    """Columns over time."""
    for name, colour in zip(names, cycle(COLOURS), strict=False):
        panel.plot(flight.t, flight[name], color=colour, label=name, **look)


def plot_flight(flight: Any, columns: Sequence[str]) -> Figure:
    """A Flight of the Python API: the named columns over time, or path, position error and thrusts."""
    missing = [name for name in columns or OF_A_FLIGHT if name not in flight]
    if missing:
        raise UsageError(f"the flight has no column {missing[0]!r} to draw")
    if columns:
        return over_time(flight.arrays(), columns, flight.attrs.get("units", {}))
    return flights_figure({str(flight.record.get("controller") or "flown"): flight.arrays()})


@styled
def over_time(flight: Flight, columns: Sequence[str], units: Mapping[str, str]) -> Figure:
    """Columns over time; those that share a unit share a panel. units: by column."""
    groups = grouped((units.get(name, ""), name) for name in columns)
    figure = Figure(figsize=(7.2, 0.6 + 1.8 * len(groups)))
    panels = figure.subplots(len(groups), 1, sharex=True, squeeze=False)[:, 0]
    for panel, (unit, names) in zip(panels, groups.items(), strict=True):
        _draw_columns(panel, flight, names)
        panel.set_ylabel(f"({unit})" if unit else "")
        panel.legend(loc="upper right", ncols=4)
    panels[-1].set_xlabel("t (s)")
    return figure
