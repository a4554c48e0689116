"""Figures of the experiments on Lei & Li's system (theirs are 2-4), and tables against an independent implementation.

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
from quadexp.physics.rotor import THETA
from quadexp.report.ladder import means_by_place, means_figure, means_table
from quadexp.report.metrics import position_error
from quadexp.report.style import COLOURS, DASHES, GREY, Figure, entries, looks, plain_log, save, styled
from quadexp.report.table import Table
from quadexp.report.text import speed_text
from quadexp.writer import write_text

EXPECTED = {  # time average of ||e_xi|| over 60 s, m, by trajectory, speed and controller
    ("rectangle", 5.0, "rls_feedback"): 1.65,
    ("rectangle", 5.0, "static_feedback"): 4.15,
    ("rectangle", 5.0, "oracle_feedback"): 1.66,
    ("rectangle", 5.0, "literal_feedback"): 16.5,
    ("rectangle", 2.0, "rls_feedback"): 0.77,
    ("rectangle", 2.0, "static_feedback"): 1.41,
    ("rectangle", 10.0, "rls_feedback"): 3.41,
    ("rectangle", 10.0, "static_feedback"): 7.93,
    ("rectangle", 15.0, "rls_feedback"): 5.46,
    ("lei_li_circle", None, "rls_feedback"): 2.31,
    ("lei_li_circle", None, "static_feedback"): 5.14,
    ("lei_li_circle", None, "oracle_feedback"): 2.32,
    ("lei_li_circle", None, "literal_feedback"): 17.4,
}
SHOWN = ("rls_feedback", "static_feedback", "oracle_feedback", "literal_feedback")
PAPER_SPEED = 5.0  # of the rectangle, m/s
WINDOWS = ((-5.0, 0.0), (0.0, 1.0), (1.0, 3.0), (3.0, 7.0), (7.0, 15.0), (15.0, 25.0))  # s from the change
SYMBOLS = {"C_la": r"$C_{l\alpha}$ (1/rad)", "C_d0": "$C_{d0}$"} | {f"C_D{a}": f"$C_{{D{a}}}$" for a in "xyz"}
QUIET_SHARE = 0.05  # of a flight, at its start: estimates jump and are not used for the limits of the panels
IDENTIFIED_AT = (10.0, 60.0)  # s
TITLES = {
    "blade_element_payload": "payload of 0.3 kg taken up",
    "blade_element_propeller": "front propeller loses 20 % lift",
    "blade_element_drag": "rotor profile drag doubled",
}


FAMILIES = (  # learned residuals and identified physics, with MPC and with feedback; perfect and oracle are bounds
    "nominal_mpc", "linear_drag_mpc", "gp_mpc", "rls_mpc", "perfect_mpc", "static_feedback", "rls_feedback",
    "oracle_feedback",
)  # fmt: skip
FAMILIES_TITLE = (
    "Mean position error over the flight (mm), over seeds; bold: least error of a line over the flights that all ended"
    " well, significantly less than every other (corrected for the choice among them and for the lines), by a"
    " controller with no fewer flights; bounds are not ranked"
)


def draw(kind: str, rows: Sequence[Mapping[str, Any]], out: str | Path) -> dict[str, str]:
    """Figures and tables of a sweep into <out>; returns name -> path. kind: "lei_li", "families" or "adaptation"."""
    rows = [{**row, "outcome": "ok"} if row["outcome"] in COMPLETED else row for row in rows]  # no corridor there
    return {"lei_li": _examples, "families": _families, "adaptation": _adaptation}[kind](rows, Path(out))


def _flown(rows: Iterable[Mapping[str, Any]], store: CellStore) -> list[tuple[Mapping[str, Any], Flight]]:
    return [(row, read_flight(store.path(row["key"]), whole=True)) for row in rows if row["outcome"] in ("ok", "lost")]


def _examples(rows: Sequence[Mapping[str, Any]], out: Path) -> dict[str, str]:
    """Figures 2-4 of the paper, at its speed and as printed (without the cone), and the table of all."""
    printed = [row for row in rows if "cone=true" not in row["variant"].lower()]
    chosen = [row for row in printed if row["trajectory"] == "lei_li_circle" or row["speed"] == PAPER_SPEED]
    all_flown = _flown(rows, CellStore(out))
    heights = {row["key"]: float(flight["p_z"].max()) for row, flight in all_flown}
    files = {"table_expected": str(write_text(out / "expected.md", expected_table(rows, heights)))}
    keys = {row["key"] for row in chosen}
    flown = [(row, flight) for row, flight in all_flown if row["key"] in keys and row["controller"] in SHOWN]
    by_controller: dict[str, Flight] = {}
    for row, flight in sorted(flown, key=lambda item: SHOWN.index(item[0]["controller"])):
        by_controller.setdefault(row["controller"], flight)
    if not by_controller:
        return files
    first = flown[0][0]
    title = "Example 1, rectangle at 5 m/s" if first["trajectory"] == "rectangle" else "Example 2, circle"
    made = {
        "example_path": path_figure(by_controller, title),
        "example_errors": running_mean_figure(by_controller, title),
    }
    identified = [flight for row, flight in flown if row["controller"] == "rls_feedback"]
    if identified:
        files["table_identified"] = str(write_text(out / "identified.md", identified_table(identified)))
        made["example_induced_velocity"] = induced_velocity_figure(identified[0], f"{title}: rls_feedback")
        made["example_parameters"] = parameter_figure(identified, f"{title}: identified coefficients")
    return files | {
        f"figure_{name}": str(save(figure, out / "figures" / name, inside=out)) for name, figure in made.items()
    }


def expected_table(rows: Sequence[Mapping[str, Any]], heights: Mapping[str, float] | None = None) -> str:
    """Markdown: time average of ||e_xi|| measured and expected, the highest point, and outcomes, by case.

    heights: key of a row -> highest altitude of its flight (m). Expected values are for the law as printed, without the
    cone.
    """
    heights = heights or {}
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        speed = None if row["trajectory"] == "lei_li_circle" else row["speed"]
        groups.setdefault((row["trajectory"], speed, row["controller"], row["variant"]), []).append(row)
    lines = []
    for (trajectory, speed, controller, variant), group in groups.items():
        good = np.array([row["mean_error"] for row in group if row["outcome"] == "ok"])
        printed = "cone=true" not in variant.lower()
        expected = EXPECTED.get((trajectory, speed, controller)) if printed else None
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
        "trajectory", "m/s", "controller", "options", "seeds", "error", "expected", "difference", "highest", "outcome",
    )  # fmt: skip
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


def _families(rows: Sequence[Mapping[str, Any]], out: Path) -> dict[str, str]:
    """Both families on both plants, as a table and as a figure."""
    means = means_by_place(rows, "plant", FAMILIES)
    return {
        "table_families": str(write_text(out / "families.md", families_table(rows).markdown())),
        "figure_families": str(save(means_figure(means), out / "figures" / "families")),
    }


def _adaptation(rows: Sequence[Mapping[str, Any]], out: Path) -> dict[str, str]:
    """Error over time around each change, as a figure and as a table of RMSE in windows."""
    flights: dict[str, dict[str, Flight]] = {}
    for row, flight in _flown(rows, CellStore(out)):
        if flight.metadata["config"]["plant"].get("schedule"):
            flights.setdefault(row["plant"], {}).setdefault(row["controller"], flight)
    if not flights:
        return {}
    figure = adaptation_figure(flights)
    return {
        "table_adaptation": str(write_text(out / "adaptation.md", adaptation_table(flights))),
        "figure_adaptation": str(save(figure, out / "figures" / "adaptation")),
    }


def adaptation_table(flights: Mapping[str, Mapping[str, Flight]]) -> str:
    """Markdown: RMSE (mm) in windows of time around the change, by change and controller."""
    lines = []
    for plant, by_controller in flights.items():
        for name, flight in by_controller.items():
            t, error = flight.t - change_time(flight), 1e3 * position_error(flight)
            cells = []
            for low, high in WINDOWS:
                inside = error[(t >= low) & (t < high)]
                cells.append(f"{np.sqrt(np.mean(inside**2)):.2f}" if len(inside) else "-")
            lines.append([TITLES.get(plant, plant), name, *cells, flight.outcome])
    heads = ["change", "controller", *(f"{low:g}..{high:g} s" for low, high in WINDOWS), "outcome"]
    left = frozenset({0, 1, len(heads) - 1})
    return Table(heads, lines, "RMSE (mm) in windows of time from the change", left=left).markdown()


def families_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Mean position error (mm) by condition and controller; bold by the rule of report/winner.py."""
    return means_table(means_by_place(rows, "plant", FAMILIES), FAMILIES_TITLE, bold=True)


def _truth(flight: Flight) -> dict[str, float]:
    """The plant's own coefficients."""
    plant = flight.metadata["config"]["plant"]
    return dict(zip(THETA, [plant["profile_drag"], plant["lift_slope"], *plant["body_drag"]], strict=True))


def change_time(flight: Flight) -> float:
    """When the vehicle of a flight changes first (s)."""
    return min(float(change["t"]) for change in flight.metadata["config"]["plant"]["schedule"])


@styled
def path_figure(flights: Mapping[str, Flight], title: str) -> Figure:
    """Path seen from above and altitude over time, the reference in grey. flights: controller -> flight."""
    figure = Figure(figsize=(10.0, 4.4), layout="constrained")
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
    return _titled(figure, title)


def _titled(figure: Figure, title: str = "") -> Figure:
    """The figure with its title, and a legend of all panels below."""
    handles, labels = entries(figure.axes)
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
    figure.suptitle(title)
    return figure


@styled
def running_mean_figure(flights: Mapping[str, Flight], title: str) -> Figure:
    """Averages since the start of ||e_xi|| (m) and of ||e_eta|| (rad), the distance to the desired attitude."""
    figure = Figure(figsize=(10.0, 3.9), layout="constrained")
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
    return _titled(figure, title)


@styled
def induced_velocity_figure(flight: Flight, title: str) -> Figure:
    """Induced velocity and speed of every rotor over time."""
    figure = Figure(figsize=(10.0, 3.9), layout="constrained")
    induced, speed = figure.subplots(1, 2)
    for i, side in enumerate(("front", "right", "rear", "left")[: flight.n_rotors]):
        look = {"color": COLOURS[i + 1], "linestyle": DASHES[i], "linewidth": 1.1, "label": f"rotor {i + 1} ({side})"}
        induced.plot(flight.t, flight[f"induced_velocity_{i}"], **look)
        speed.plot(flight.t, flight[f"rotor_speed_{i}"], **look)
    induced.set(ylabel="induced velocity (m/s)", xlabel="time (s)")
    speed.set(ylabel="rotor speed (rad/s)", xlabel="time (s)")
    return _titled(figure, title)


@styled
def parameter_figure(flights: Sequence[Flight], title: str) -> Figure:
    """Coefficients in use over time, every seed a thin line and their mean a thick one, the truth dashed."""
    truth, samples = _truth(flights[0]), min(len(flight) for flight in flights)
    t = flights[0].t[:samples]
    figure = Figure(figsize=(11.0, 5.2), layout="constrained")
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


@styled
def adaptation_figure(flights: Mapping[str, Mapping[str, Flight]]) -> Figure:
    """Position error over time around a change of the vehicle, a panel per change and a line per controller.

    flights: plant -> controller -> flight.
    """
    figure = Figure(figsize=(4.0 * len(flights) + 0.6, 4.0), layout="constrained")
    panels = figure.subplots(1, len(flights), sharey=True, squeeze=False)[0]
    look = looks([name for by_controller in flights.values() for name in by_controller])
    for panel, (plant, by_controller) in zip(panels, flights.items(), strict=True):
        for name, flight in by_controller.items():
            panel.plot(flight.t, 1e3 * position_error(flight), label=name, linewidth=1.3, **look[name].line())
        change = change_time(next(iter(by_controller.values())))
        panel.axvline(change, color="#000000", linewidth=0.9, linestyle=":")
        panel.text(change, 0.98, " change", transform=panel.get_xaxis_transform(), va="top", fontsize=8)
        panel.set(yscale="log", title=TITLES.get(plant, plant), xlabel="time (s)", ylim=(0.05, 1000))
    plain_log(panels[0].yaxis, minor=True)
    panels[0].set_ylabel("position error (mm)")
    return _titled(figure)
