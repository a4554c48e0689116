"""Figures of a flight or a log over time: its quality check, its delays, and whatever columns are asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quadexp.log.check import Finding
from quadexp.log.schema import Flight
from quadexp.log.signal.windows import Pair, cut, pairs, streams_of
from quadexp.physics.state import POSITION, STATE_COLUMNS
from quadexp.report.panels import Mark, Panel, mark, panel_figure
from quadexp.report.style import COLOURS, HUES, Figure

MS = 1e3
COMPARED = (  # relations, title, a sensor, what the others say it should be; see quadexp/log/signal/windows.py
    (("velocity",), "velocity, world (m/s)", "v", "dp/dt"),
    (("force", "force (p)", "thrust", "thrust (p)"), "specific force, body (m/s²)", "acc", "Rᵀ(dv/dt + g)"),
    (("rate",), "body rate (rad/s)", "w", "from the attitude"),
)
MARKS = {"warning": COLOURS[1], "blocking": COLOURS[5]}
MOST_LINES = 6
LONGEST_LINE = 175  # letters
HEADROOM = 0.3  # of the first row of panels, where the legends stand
QUIET = 0.995  # quantile that sets an axis's limits: one spike must not flatten the rest
SHOWN = 20.0  # log likelihood below the best that is drawn
BELIEVED = {  # column -> what it is, hue
    "delay_time": ("age of the state", "blue"),
    "delay_dead_time": ("dead time of the commands", "vermillion"),
    "delay_lag": ("lag of the motors", "green"),
}


def consistency_figure(name: str, flight: Flight, findings: Sequence[Finding]) -> Figure:
    """Each sensor against its value computed from the others, as means over windows of 0.1 s; findings in the title,
    their time spans shaded. Columns: velocity, specific force, body rate; rows: the axes."""
    t, relations = _relations(flight)
    shown = [finding for finding in findings if finding.severity in MARKS]
    spans = [
        mark("axvspan", finding.span[0], max(finding.span[1], finding.span[0] + 0.02), color=MARKS[finding.severity],
             alpha=0.3, lw=0)
        for finding in shown
        if finding.span is not None
    ]  # fmt: skip
    rows: list[list[Panel]] = [[], [], []]
    for names, title, sensor, computed in COMPARED:
        pair = next((relations[relation] for relation in names if relation in relations), None)
        for row, axis in enumerate("xyz"):
            words = {"title": "" if row else title, "xlabel": "t (s)" if row == 2 else ""}
            words["ylabel"] = axis if names == COMPARED[0][0] else ""
            if pair is None:
                missing = mark("annotate", "not in the flight", (0.5, 0.5), xycoords="axes fraction", ha="center",
                               color="#777777")  # fmt: skip
                rows[row].append(Panel([missing, *spans], {**words, "yticks": []}))
            else:
                marks, limits = _overlay(t, pair, row, sensor, computed)
                legend = None if row else {"loc": "upper right", "ncols": 2, "fontsize": 8}
                rows[row].append(Panel([*marks, *spans], {**words, "ylim": limits}, legend))
    figure = panel_figure(rows, (11, 6.4 + 0.16 * min(len(shown), MOST_LINES)), sharex=True)
    figure.suptitle("\n".join([name, *_lines(shown)]), fontsize=9, ha="left", x=0.01)
    return figure


def _lines(findings: Sequence[Finding]) -> list[str]:
    lines = [f"{f.severity}: {f.name}: {f.where}: {f.measured}" for f in findings[:MOST_LINES]]
    lines = [line if len(line) < LONGEST_LINE else line[: LONGEST_LINE - 3] + "..." for line in lines]
    if len(findings) > MOST_LINES:
        lines.append(f"and {len(findings) - MOST_LINES} more")
    return lines or ["no finding that blocks or warns"]


def _relations(flight: Flight) -> tuple[np.ndarray, dict[str, Pair]]:
    """Times of the windows, (n, k) (s), and what two streams say of the same quantity in each, by relation."""
    t = np.asarray(flight.t, float)
    streams = {name: x for name, x in streams_of(flight).items() if np.isfinite(x).all(axis=1).mean() > 0.5}
    good = np.isfinite(t) & np.all([np.isfinite(values).all(axis=1) for values in streams.values()], axis=0)
    windows = cut(t, streams, good, flight.columns.get("segment"))
    return windows.t, {pair.name: pair for pair in pairs(windows)} if len(windows.t) else {}


def _overlay(t: np.ndarray, pair: Pair, row: int, sensor: str, computed: str) -> tuple[list[Mark], tuple[float, float]]:
    """The two lines of a panel, and the limits of y."""
    half = t.shape[1] // 2
    halves = len(pair.measured) == 2 * len(t)  # both halves of a window were compared
    time = np.concatenate([t[:, half // 2], t[:, half + half // 2]]) if halves else t[:, half]
    order = np.argsort(time, kind="stable")
    time, expected, measured = time[order], pair.expected[order, row], pair.measured[order, row]
    gaps = np.diff(time)
    broken = np.flatnonzero(gaps > 3 * np.median(gaps)) + 1 if len(time) > 2 else np.zeros(0, int)
    time, expected, measured = (np.insert(x, broken, np.nan) for x in (time, expected, measured))
    marks = [mark("plot", time, expected, color=COLOURS[1], lw=1.6, label=computed)]
    if not pair.name.startswith("thrust"):
        marks.append(mark("plot", time, measured, color=COLOURS[2], lw=0.8, label=sensor))
    low, high = np.nanquantile(np.concatenate([expected, measured]), [1 - QUIET, QUIET])
    margin = max(0.15 * (high - low), 3 * pair.relation.floor)
    return marks, (low - margin, high + margin + (HEADROOM * (high - low + 2 * margin) if row == 0 else 0.0))


class Profile(NamedTuple):
    """One delay. candidates: (k,) (s). score: log likelihood of each less that of the best, (k,). found, error: the
    delay and its standard error (s)."""

    name: str
    candidates: np.ndarray
    score: np.ndarray
    found: float
    error: float

    def panel(self) -> Panel:
        """What every candidate leaves unexplained."""
        colour = HUES["vermillion"][0]
        low, high = (MS * max(self.found + side * self.error, 0.0) for side in (-1, 1))
        marks = [
            mark("plot", MS * self.candidates, self.score, color=HUES["blue"][0]),
            mark("axvspan", low, high, color=colour, alpha=0.15, linewidth=0),
            mark("axvline", MS * self.found, color=colour, linestyle="--"),
        ]
        result = f"found {MS * self.found:.1f} ms, standard error {MS * self.error:.1f}"
        limits = {"ylim": (-SHOWN, 0.05 * SHOWN), "xlim": (MS * self.candidates[0], MS * self.candidates[-1])}
        return Panel(marks, {"title": self.name, "xlabel": f"candidate, ms\n{result}", **limits})


def delay_figure(
    profiles: Sequence[Profile], columns: Mapping[str, np.ndarray], true: Mapping[str, float] | None = None
) -> Figure:
    """A panel for each profile; below them, where the flight had delay=identified, what was believed over time.

    columns: of the flight. true: by column of BELIEVED, what the flight's world states (s).
    """
    rows = [[profile.panel() for profile in profiles]]
    if "delay_known" in columns:
        marks = []
        for column, (name, hue) in BELIEVED.items():
            look = {"color": HUES[hue][0]}
            marks.append(mark("step", columns["t"], MS * columns[column], where="post", label=name, **look))
            if true and column in true:
                marks.append(mark("axhline", MS * true[column], linestyle=":", linewidth=1.0, **look))
        title = "made good in flight; dotted: true" if true else "made good in flight"
        rows.append([Panel(marks, {"title": title, "xlabel": "time, s", "ylabel": "ms"}, {"loc": "center right"})])
    figure = panel_figure(rows, (9.0, 2.8 * len(rows)))
    figure.axes[0].set_ylabel("log likelihood, less the best")
    return figure


def over_time(flight: Any, columns: Sequence[str]) -> Figure:
    """Columns over time; those that share a unit share a panel."""
    units = flight.attrs.get("units", {})
    groups: dict[str, list[str]] = {}
    for name in columns:
        groups.setdefault(units.get(name, ""), []).append(name)
    panels = [
        [Panel(_lines_of(flight, names), {"ylabel": f"({unit})" if unit else ""}, {"loc": "upper right", "ncols": 4})]
        for unit, names in groups.items()
    ]
    figure = panel_figure(panels, (7.2, 0.6 + 1.8 * len(groups)), sharex=True)
    figure.axes[-1].set_xlabel("t (s)")
    return figure


def _lines_of(flight: Any, names: Sequence[str], **look: Any) -> list[Mark]:
    return [
        mark("plot", flight["t"], flight[name], color=COLOURS[i % len(COLOURS)], label=name, **look)
        for i, name in enumerate(names)
    ]


def overview(flight: Any) -> Figure:
    """The path from above, the distance to the reference, and the rotor thrusts; of a log what it has."""
    position = list(STATE_COLUMNS[POSITION])
    reference = [f"ref_{name}" for name in position]
    thrusts = [name for name in flight if name.startswith("u_")]
    path = [mark("plot", flight["p_x"], flight["p_y"], color=COLOURS[2], label="flown")]
    if set(reference) <= set(flight):
        path.insert(0, mark("plot", *(flight[name] for name in reference[:2]), color="0.6", lw=4, label="reference"))
        distance, label = (
            MS * np.linalg.norm(flight[position].to_numpy() - flight[reference], axis=1),
            "position error (mm)",
        )
    else:
        distance, label = np.linalg.norm(flight[["v_x", "v_y", "v_z"]].to_numpy(), axis=1), "speed (m/s)"
    above = {"xlabel": "x (m)", "ylabel": "y (m)", "aspect": "equal", "adjustable": "datalim"}
    below = {"xlabel": "t (s)", "ylabel": "rotor thrusts (N)" if thrusts else "z (m)"}
    upper = Panel([mark("plot", flight["t"], distance, color=COLOURS[2])], {"ylabel": label})
    lower = Panel(_lines_of(flight, thrusts or ["p_z"], linewidth=0.8), below)
    flown = Panel(path, above, {"loc": "lower left", "bbox_to_anchor": (0, 1), "ncols": 2})
    return panel_figure([[flown, upper], [flown, lower]], (7.2, 3.4))
