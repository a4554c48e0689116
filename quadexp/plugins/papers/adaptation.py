"""Changes of the vehicle in flight: the error over time around each, as a figure and as RMSE in windows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from quadexp.log.schema import Flight
from quadexp.physics.state import root_mean_square
from quadexp.plugins.drawing.style import Figure, looks, plain_log, styled
from quadexp.plugins.papers.lei_li.report import flown, titled, without_corridor
from quadexp.report.metrics import position_error
from quadexp.report.pairing import Rows
from quadexp.report.paper import Drawn
from quadexp.report.table import Table

WINDOWS = ((-5.0, 0.0), (0.0, 1.0), (1.0, 3.0), (3.0, 7.0), (7.0, 15.0), (15.0, 25.0))  # s from the change
TITLES = {
    "blade_element_payload": "payload of 0.3 kg taken up",
    "blade_element_propeller": "front propeller loses 20 % lift",
    "blade_element_drag": "rotor profile drag doubled",
}


def draw(rows: Rows, out: Path) -> Drawn:
    """Table and figure, of the flights whose vehicle changes."""
    flights: dict[str, dict[str, Flight]] = {}
    for row, flight in flown(without_corridor(rows), out):
        if _schedule(flight):
            flights.setdefault(row["plant"], {}).setdefault(row["controller"], flight)
    if not flights:
        return {}, {}
    return {"adaptation": adaptation_table(flights)}, {"adaptation": adaptation_figure(flights)}


def adaptation_table(flights: Mapping[str, Mapping[str, Flight]]) -> str:
    """Markdown: RMSE (mm) in windows of time around the change, by change and controller."""
    lines = []
    for plant, by_controller in flights.items():
        for name, flight in by_controller.items():
            windows = [_rmse(flight, low, high) for low, high in WINDOWS]
            lines.append([TITLES.get(plant, plant), name, *windows, flight.outcome])
    windows = [f"{low:g}..{high:g} s" for low, high in WINDOWS]
    heads = ["change", "controller", *windows, "outcome"]
    left_columns = frozenset({0, 1, len(heads) - 1})
    return Table(heads, lines, "RMSE (mm) in windows of time from the change", left=left_columns).markdown()


def _rmse(flight: Flight, low: float, high: float) -> str:
    """RMSE (mm) in a window of time from the change (s)."""
    t = flight.t - change_time(flight)
    inside = (t >= low) & (t < high)
    error = position_error(flight)[inside]
    if len(error):
        return f"{1e3 * root_mean_square(error):.2f}"
    return "-"


def _schedule(flight: Flight) -> Sequence[Mapping[str, Any]]:
    """The changes of the vehicle."""
    return flight.metadata["config"]["plant"].get("schedule", ())


def change_time(flight: Flight) -> float:
    """When the vehicle of a flight changes first (s)."""
    return min(float(change["t"]) for change in _schedule(flight))


@styled
def adaptation_figure(flights: Mapping[str, Mapping[str, Flight]]) -> Figure:
    """Position error over time around a change of the vehicle, a panel per change and a line per controller.

    flights: plant -> controller -> flight.
    """
    figure = Figure(figsize=(4.0 * len(flights) + 0.6, 4.0))
    panels = figure.subplots(1, len(flights), sharey=True, squeeze=False)[0]
    look = looks(list(chain(*flights.values())))
    for panel, (plant, by_controller) in zip(panels, flights.items(), strict=True):
        for name, flight in by_controller.items():
            panel.plot(flight.t, 1e3 * position_error(flight), label=name, linewidth=1.3, **look[name].line())
        change = change_time(flight)
        panel.axvline(change, color="#000000", linewidth=0.9, linestyle=":")
        panel.text(change, 0.98, " change", transform=panel.get_xaxis_transform(), va="top", fontsize=8)
        panel.set(yscale="log", title=TITLES.get(plant, plant), xlabel="time (s)", ylim=(0.05, 1000))
    plain_log(panels[0].yaxis, minor=True)
    panels[0].set_ylabel("position error (mm)")
    return titled(figure)
