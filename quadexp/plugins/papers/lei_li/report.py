"""Figures of the examples of Lei & Li 2017 (theirs are 2-4), and tables against an independent implementation.

`expected` is from an independent implementation of the paper's equations (Euler 1e-4 s, control at 100 Hz, means over
five seeds if there is noise); the paper prints no table.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from quadexp.log.cell_store import CellStore
from quadexp.log.outcome import COMPLETED
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.names import named
from quadexp.plugins.aerodynamics.coefficients import THETA
from quadexp.plugins.drawing.style import COLOURS, DASHES, GREY, Figure, entries, looks, plain_log, styled
from quadexp.report.metrics import position_error
from quadexp.report.pairing import Row, Rows, grouped
from quadexp.report.paper import Drawn
from quadexp.report.table import Table
from quadexp.report.text import speed_text

SHOWN = ("rls_feedback", "static_feedback", "oracle_feedback", "literal_feedback")
EXPECTED = {  # trajectory, speed (m/s) -> time average of ||e_xi|| over 60 s (m) of each of SHOWN
    ("rectangle", 2.0): (0.77, 1.41),
    ("rectangle", 5.0): (1.65, 4.15, 1.66, 16.5),
    ("rectangle", 10.0): (3.41, 7.93),
    ("rectangle", 15.0): (5.46,),
    ("lei_li_circle", None): (2.31, 5.14, 2.32, 17.4),
}
PAPER_SPEED = 5.0  # of the rectangle, m/s
SYMBOLS = {"C_la": r"$C_{l\alpha}$ (1/rad)", "C_d0": "$C_{d0}$"} | {f"C_D{a}": f"$C_{{D{a}}}$" for a in "xyz"}
QUIET_SHARE = 0.05  # of a flight, at its start: estimates jump and are not used for the limits of the panels
IDENTIFIED_AT = (10.0, 60.0)  # s


def without_corridor(rows: Iterable[Row]) -> list[Row]:
    """The rows as the paper counts them: who flew to the end has completed, inside a corridor or not."""
    return [{**row, "outcome": "ok"} if row["outcome"] in COMPLETED else row for row in rows]


def flown(rows: Iterable[Row], out: Path) -> list[tuple[Row, Flight]]:
    """The flights of a folder of results that have samples, with their rows."""
    store = CellStore(out)
    return [(row, read_flight(store.path(row["key"]), whole=True)) for row in rows if row["outcome"] in ("ok", "lost")]


def draw(rows: Rows, out: Path) -> Drawn:
    """Figures 2-4 of the paper, at its speed and as printed (without the cone), and the table of all."""
    rows = without_corridor(rows)
    all_flown = flown(rows, out)
    heights = {row["key"]: float(flight["p_z"].max()) for row, flight in all_flown}
    tables = {"expected": expected_table(rows, heights)}
    by_controller: dict[str, list[Flight]] = {name: [] for name in SHOWN}
    trajectories = []
    for row, flight in all_flown:
        at_its_speed = row["trajectory"] == "lei_li_circle" or row["speed"] == PAPER_SPEED
        if at_its_speed and as_printed(row["variant"]) and row["controller"] in SHOWN:
            by_controller[row["controller"]].append(flight)
            trajectories.append(row["trajectory"])
    if not trajectories:
        return tables, {}
    title = "Example 1, rectangle at 5 m/s" if trajectories[0] == "rectangle" else "Example 2, circle"
    first = {name: flights[0] for name, flights in by_controller.items() if flights}
    figures = {"example_path": path_figure(first, title), "example_errors": running_mean_figure(first, title)}
    identified = by_controller["rls_feedback"]
    if identified:
        tables["identified"] = identified_table(identified)
        figures["example_induced_velocity"] = induced_velocity_figure(identified[0], f"{title}: rls_feedback")
        figures["example_parameters"] = parameter_figure(identified, f"{title}: identified coefficients")
    return tables, figures


def as_printed(variant: str) -> bool:
    """Whether a flight is of the law as printed, without the cone."""
    return "cone=true" not in variant.lower()


def expected_table(rows: Rows, heights: Mapping[str, float] | None = None) -> str:
    """Markdown: time average of ||e_xi|| measured and expected, the highest point, and outcomes, by case.

    heights: key of a row -> highest altitude of its flight (m). Expected values are for the law as printed, without the
    cone.
    """
    cases = grouped((_case(row), row) for row in rows)
    lines = [[*_case_texts(case, flights), *_results(case, flights, heights or {})] for case, flights in cases.items()]
    heads = (
        "trajectory",
        "m/s",
        "controller",
        "options",
        "seeds",
        "error",
        "expected",
        "difference",
        "highest",
        "outcome",
    )
    title = "Time average of the position error over the flight (m), mean and half range over seeds; highest point (m)"
    return Table(heads, lines, title, left=frozenset({0, 2, 3, 9})).markdown()


class Case(NamedTuple):
    """speed: m/s, None on the circle. variant: options."""

    trajectory: str
    speed: float | None
    controller: str
    variant: str

    @property
    def expected(self) -> float | None:
        """Time average of ||e_xi|| (m), where it is known."""
        errors = dict(zip(SHOWN, EXPECTED.get((self.trajectory, self.speed), ()), strict=False))
        return errors.get(self.controller) if as_printed(self.variant) else None


def _case(row: Row) -> Case:
    speed = None if row["trajectory"] == "lei_li_circle" else row["speed"]
    return Case(row["trajectory"], speed, row["controller"], row["variant"])


def _case_texts(case: Case, flights: Rows) -> list[str]:
    options = " ".join(part.rpartition(".")[2] for part in case.variant.split(" "))
    return [case.trajectory, speed_text(case.speed, ""), case.controller, options, str(len(flights))]


def _results(case: Case, flights: Rows, heights: Mapping[str, float]) -> list[str]:
    """Error, expected error, the difference, the highest point, and the outcome."""
    completed = [row for row in flights if row["outcome"] == "ok"]
    lost = [row["cause"] for row in flights if row["outcome"] != "ok"]
    ended = f"{len(lost)} lost: {lost[0]}" if lost else "ok"
    expected = "" if case.expected is None else str(case.expected)
    if not completed:
        return ["-", expected, "", "", ended]
    errors = np.array([row["mean_error"] for row in completed])
    error = f"{errors.mean():.3f}"
    if len(errors) > 1:
        error += f" +- {np.ptp(errors) / 2:.3f}"
    difference = f"{100 * (errors.mean() / case.expected - 1):+.1f} %" if case.expected else ""
    reached = [heights[row["key"]] for row in completed if row.get("key") in heights]
    highest = f"{np.mean(reached):.2f}" if reached else ""
    return [error, expected, difference, highest, ended]


def identified_table(flights: Sequence[Flight]) -> str:
    """Markdown: every coefficient's estimate at 10 s and at the end, mean and deviation over seeds, and the clips.

    flights: of one case, with identification; a clip is a sample on which a value in use was held at its bound.
    """
    truth = _truth(flights[0])
    end = min(flight.t[-1] for flight in flights)
    times = [t for t in IDENTIFIED_AT if t <= end + 1e-9]
    lines = []
    for name in THETA:
        cells = []
        for t in times:
            values = np.array([flight[name][np.searchsorted(flight.t, t - 1e-9)] for flight in flights])
            deviation = values.std(ddof=1) if len(values) > 1 else 0.0
            cells.append(f"{values.mean():.4f} +- {deviation:.4f}")
        lines.append([name, f"{truth[name]:g}", *cells])
    clips = np.array([flight["clips"][-1] for flight in flights])
    samples = max(len(flight) for flight in flights)
    note = f"Clips in a flight of {samples} samples: {clips.mean():.0f} ({clips.min():.0f} to {clips.max():.0f})"
    title = f"Coefficients in use, mean +- standard deviation over {len(flights)} seeds"
    heads = ["", "truth", *(f"at {t:g} s" for t in times)]
    return Table(heads, lines, title, notes=[note]).markdown()


def _truth(flight: Flight) -> dict[str, float]:
    """The plant's own coefficients."""
    plant = flight.metadata["config"]["plant"]
    return named(THETA, [plant["profile_drag"], plant["lift_slope"], *plant["body_drag"]])


@styled
def path_figure(flights: Mapping[str, Flight], title: str) -> Figure:
    """Path seen from above and altitude over time, the reference in grey. flights: controller -> flight."""
    figure = Figure(figsize=(10.0, 4.4))
    above, height = figure.subplots(1, 2, width_ratios=(1, 1.25))
    look = looks(list(flights))
    first = next(iter(flights.values()))
    above.plot(first["ref_p_x"], first["ref_p_y"], color=GREY, linewidth=3.5, alpha=0.45, label="reference")
    height.plot(first.t, first["ref_p_z"], color=GREY, linewidth=3.5, alpha=0.45)
    for name, flight in flights.items():
        above.plot(flight["p_x"], flight["p_y"], label=name, **look[name].line())
        height.plot(flight.t, flight["p_z"], **look[name].line())
    above.set(xlabel="east (m)", ylabel="north (m)", aspect="equal", title="path from above")
    height.axhline(0.0, color="#000000", linewidth=0.8)
    height.text(0.99, 0.0, "ground", transform=height.get_yaxis_transform(), ha="right", va="bottom")
    height.set(xlabel="time (s)", ylabel="altitude (m)", title="altitude")
    return titled(figure, title)


def titled(figure: Figure, title: str = "") -> Figure:
    """The figure with its title, and a legend of all panels below."""
    handles, labels = entries(figure.axes)
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    figure.suptitle(title)
    return figure


@styled
def running_mean_figure(flights: Mapping[str, Flight], title: str) -> Figure:
    """Averages since the start of ||e_xi|| (m) and of ||e_eta|| (rad), the distance to the desired attitude."""
    figure = Figure(figsize=(10.0, 3.9))
    position, attitude = figure.subplots(1, 2)
    for name, look in looks(list(flights)).items():
        flight = flights[name]
        count = np.arange(1, len(flight) + 1)
        for panel, error in ((position, position_error(flight)), (attitude, flight["error_eta"])):
            panel.plot(flight.t, np.cumsum(error) / count, label=name, **look.line())
    position.set_ylabel(r"running mean of $\|e_\xi\|$ (m)", parse_math=True)
    attitude.set_ylabel(r"running mean of $\|e_\eta\|$ (rad)", parse_math=True)
    position.set(title="position", xlabel="time (s)")
    attitude.set(title="attitude", yscale="log", xlabel="time (s)")
    plain_log(attitude.yaxis)
    return titled(figure, title)


@styled
def induced_velocity_figure(flight: Flight, title: str) -> Figure:
    """Induced velocity and speed of every rotor over time."""
    figure = Figure(figsize=(10.0, 3.9))
    induced, speed = figure.subplots(1, 2)
    for i, side in enumerate(("front", "right", "rear", "left")[: flight.n_rotors]):
        look = {"color": COLOURS[i + 1], "linestyle": DASHES[i], "linewidth": 1.1, "label": f"rotor {i + 1} ({side})"}
        induced.plot(flight.t, flight[f"induced_velocity_{i}"], **look)
        speed.plot(flight.t, flight[f"rotor_speed_{i}"], **look)
    induced.set(ylabel="induced velocity (m/s)", xlabel="time (s)")
    speed.set(ylabel="rotor speed (rad/s)", xlabel="time (s)")
    return titled(figure, title)


@styled
def parameter_figure(flights: Sequence[Flight], title: str) -> Figure:
    """Coefficients in use over time, every seed a thin line and their mean a thick one, the truth dashed."""
    truth = _truth(flights[0])
    samples = min(len(flight) for flight in flights)
    t = flights[0].t[:samples]
    figure = Figure(figsize=(11.0, 5.2))
    *panels, beside = figure.subplots(2, 3, sharex=True).flat
    for panel, (name, symbol) in zip(panels, SYMBOLS.items(), strict=True):
        values = np.stack([flight[name][:samples] for flight in flights])
        for line in values:
            panel.plot(t, line, color=COLOURS[6], linewidth=0.7, alpha=0.7, label="one seed")
        panel.plot(t, values.mean(axis=0), color=COLOURS[2], label=f"mean of {len(flights)} seeds")
        panel.axhline(truth[name], color="#000000", linestyle="--", linewidth=1.0, label="truth")
        panel.set_title(symbol, parse_math=True)
        late = np.append(values[:, t > QUIET_SHARE * t[-1]], truth[name])
        margin = 0.15 * np.ptp(late)
        panel.set_ylim(late.min() - margin, late.max() + margin)
    for panel in panels[2:]:
        panel.set_xlabel("time (s)")
        panel.xaxis.set_tick_params(labelbottom=True)
    beyond = f"the first {QUIET_SHARE * flights[0].t[-1]:.0f} s may leave the panels"
    beside.set_axis_off()
    beside.legend(*entries(panels[:1]), loc="center", title=beyond, title_fontsize=9)
    figure.suptitle(title)
    return figure
