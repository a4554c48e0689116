"""Figures of the examples of Lei & Li 2017 (theirs are 2-4), and tables against an independent implementation.

`expected` is from an independent implementation of the paper's equations (Euler 1e-4 s, control at 100 Hz, means over
five seeds if there is noise); the paper prints no table.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.log.cell_store import CellStore
from quadexp.log.outcome import COMPLETED
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.names import named
from quadexp.physics.rotor import THETA
from quadexp.report.metrics import position_error
from quadexp.report.pairing import Row, Rows
from quadexp.report.paper import Drawn
from quadexp.report.style import COLOURS, DASHES, GREY, Figure, entries, looks, plain_log, styled
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
    printed = [row for row in rows if "cone=true" not in row["variant"].lower()]
    chosen = [row for row in printed if row["trajectory"] == "lei_li_circle" or row["speed"] == PAPER_SPEED]
    all_flown = flown(rows, out)
    heights = {row["key"]: float(flight["p_z"].max()) for row, flight in all_flown}
    tables = {"expected": expected_table(rows, heights)}
    keys = {row["key"] for row in chosen}
    shown = [(row, flight) for row, flight in all_flown if row["key"] in keys and row["controller"] in SHOWN]
    by_controller: dict[str, Flight] = {}
    for row, flight in sorted(shown, key=lambda item: SHOWN.index(item[0]["controller"])):
        by_controller.setdefault(row["controller"], flight)
    if not by_controller:
        return tables, {}
    first = shown[0][0]
    title = "Example 1, rectangle at 5 m/s" if first["trajectory"] == "rectangle" else "Example 2, circle"
    figures = {"example_path": path_figure(by_controller, title)}
    figures["example_errors"] = running_mean_figure(by_controller, title)
    identified = [flight for row, flight in shown if row["controller"] == "rls_feedback"]
    if identified:
        tables["identified"] = identified_table(identified)
        figures["example_induced_velocity"] = induced_velocity_figure(identified[0], f"{title}: rls_feedback")
        figures["example_parameters"] = parameter_figure(identified, f"{title}: identified coefficients")
    return tables, figures


def expected_table(rows: Rows, heights: Mapping[str, float] | None = None) -> str:
    """Markdown: time average of ||e_xi|| measured and expected, the highest point, and outcomes, by case.

    heights: key of a row -> highest altitude of its flight (m). Expected values are for the law as printed, without the
    cone.
    """
    heights = heights or {}
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        speed = None if row["trajectory"] == "lei_li_circle" else row["speed"]
        groups.setdefault((row["trajectory"], speed, row["controller"], row["variant"]), []).append(row)
    lines = []
    for (trajectory, speed, controller, variant), group in groups.items():
        good = np.array([row["mean_error"] for row in group if row["outcome"] == "ok"])
        printed = "cone=true" not in variant.lower()
        expected = dict(zip(SHOWN, EXPECTED.get((trajectory, speed), ()), strict=False)).get(controller)
        expected = expected if printed else None
        shown = f"{good.mean():.3f}" if len(good) else "-"
        shown += f" +- {np.ptp(good) / 2:.3f}" if len(good) > 1 else ""
        against = f"{100 * (good.mean() / expected - 1):+.1f} %" if len(good) and expected else ""
        lost = [row["cause"] for row in group if row["outcome"] != "ok"]
        ended = "ok" if not lost else f"{len(lost)} lost: {lost[0]}"
        options = " ".join(part.rpartition(".")[2] for part in variant.split(" "))
        reached = [heights[row["key"]] for row in group if row["outcome"] == "ok" and row.get("key") in heights]
        highest = f"{np.mean(reached):.2f}" if reached else ""
        case = [trajectory, speed_text(speed, ""), controller, options, str(len(group))]
        lines.append([*case, shown, "" if expected is None else str(expected), against, highest, ended])
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


def identified_table(flights: Sequence[Flight]) -> str:
    """Markdown: every coefficient's estimate at 10 s and at the end, mean and deviation over seeds, and the clips.

    flights: of one case, with identification; a clip is a sample on which a value in use was held at its bound.
    """
    truth = _truth(flights[0])
    times = [t for t in IDENTIFIED_AT if t <= min(flight.t[-1] for flight in flights) + 1e-9]
    lines = []
    for name in THETA:
        cells = []
        for t in times:
            values = np.array([flight[name][np.searchsorted(flight.t, t - 1e-9)] for flight in flights])
            cells.append(f"{values.mean():.4f} +- {values.std(ddof=1) if len(values) > 1 else 0.0:.4f}")
        lines.append([name, f"{truth[name]:g}", *cells])
    clips = np.array([flight["clips"][-1] for flight in flights])
    samples = max(len(flight) for flight in flights)
    note = f"Clips in a flight of {samples} samples: {clips.mean():.0f} ({clips.min():.0f} to {clips.max():.0f})"
    title = f"Coefficients in use, mean +- standard deviation over {len(flights)} seeds"
    return Table(["", "truth", *(f"at {t:g} s" for t in times)], lines, title, notes=[note]).markdown()


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
        for panel, error in ((position, position_error(flight)), (attitude, flight["error_eta"])):
            panel.plot(flight.t, np.cumsum(error) / np.arange(1, len(flight) + 1), label=name, **look.line())
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
