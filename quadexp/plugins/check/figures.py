"""The figure of the quality check: each sensor against what the others say."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from quadexp.log.schema import Flight
from quadexp.physics.state import finite_rows
from quadexp.plugins.drawing.style import COLOURS, Figure, styled
from quadexp.plugins.logs.finding import Finding
from quadexp.plugins.logs.signal.windows import Pair, cut, pairs, streams_of

HEADROOM = 0.3  # of the first row of panels, where the legends stand
QUIET = 0.995  # quantile that sets an axis's limits: one spike must not flatten the rest


@styled
def consistency_figure(name: str, flight: Flight, findings: Sequence[Finding]) -> Figure:
    """Each sensor against its value computed from the others, as means over windows of 0.1 s; findings in the title,
    their time spans shaded. Columns: velocity, specific force, body rate; rows: the axes."""
    t, relations = _relations(flight)
    shown = [finding for finding in findings if finding.severity in MARKS]
    figure = Figure(figsize=(11, 6.4 + 0.16 * min(len(shown), MOST_LINES)))
    grid = figure.subplots(3, 3, sharex=True)
    for column, (names, title, sensor, computed) in zip(grid.T, COMPARED, strict=True):
        pair = next((relations[relation] for relation in names if relation in relations), None)
        for row, panel in enumerate(column):
            if pair is None:
                panel.annotate("not in the flight", (0.5, 0.5), xycoords="axes fraction", ha="center", color="#777777")
                panel.set_yticks([])
            else:
                _overlay(panel, t, pair, row, sensor, computed)
            for finding in shown:
                if finding.span is not None:
                    end = max(finding.span[1], finding.span[0] + 0.02)
                    panel.axvspan(finding.span[0], end, color=MARKS[finding.severity], alpha=0.3, lw=0)
        column[0].set_title(title)
        column[2].set_xlabel("t (s)")
        if pair is not None:
            column[0].legend(loc="upper right", ncols=2, fontsize=8)
    for panel, axis in zip(grid[:, 0], "xyz", strict=True):
        panel.set_ylabel(axis)
    lines = [f"{f.severity}: {f.name}: {f.where}: {f.measured}" for f in shown[:MOST_LINES]]
    lines = [line if len(line) < LONGEST_LINE else line[: LONGEST_LINE - 3] + "..." for line in lines]
    lines += [f"and {len(shown) - MOST_LINES} more"] if len(shown) > MOST_LINES else []
    figure.suptitle("\n".join([name, *(lines or ["no finding that blocks or warns"])]), fontsize=9, ha="left", x=0.01)
    return figure


def _relations(flight: Flight) -> tuple[np.ndarray, dict[str, Pair]]:
    """Times of the windows, (n, k) (s), and what two streams say of the same quantity in each, by relation."""
    t = np.asarray(flight.t, float)
    streams = {name: x for name, x in streams_of(flight).items() if finite_rows(x).mean() > 0.5}
    good = np.isfinite(t) & np.all([finite_rows(values) for values in streams.values()], axis=0)
    windows = cut(t, streams, good, flight.columns.get("segment"))
    return windows.t, {pair.name: pair for pair in pairs(windows)} if len(windows.t) else {}


def _overlay(panel: Any, t: np.ndarray, pair: Pair, row: int, sensor: str, computed: str) -> None:
    """The two lines of a panel, and its limits."""
    half = t.shape[1] // 2
    halves = len(pair.measured) == 2 * len(t)  # both halves of a window were compared
    time = np.concatenate([t[:, half // 2], t[:, half + half // 2]]) if halves else t[:, half]
    order = np.argsort(time, kind="stable")
    time, expected, measured = time[order], pair.expected[order, row], pair.measured[order, row]
    gaps = np.diff(time)
    broken = np.flatnonzero(gaps > 3 * np.median(gaps)) + 1 if len(time) > 2 else np.zeros(0, int)
    time, expected, measured = (np.insert(x, broken, np.nan) for x in (time, expected, measured))
    panel.plot(time, expected, color=COLOURS[1], lw=1.6, label=computed)
    if not pair.name.startswith("thrust"):
        panel.plot(time, measured, color=COLOURS[2], lw=0.8, label=sensor)
    low, high = np.nanquantile(np.concatenate([expected, measured]), [1 - QUIET, QUIET])
    margin = max(0.15 * (high - low), 3 * pair.relation.floor)
    above = HEADROOM * (high - low + 2 * margin) if row == 0 else 0.0
    panel.set_ylim(low - margin, high + margin + above)


COMPARED = (  # relations, title, a sensor, what the others say it should be; see quadexp/plugins/logs/signal/windows.py
    (("velocity",), "velocity, world (m/s)", "v", "dp/dt"),
    (("force", "force (p)", "thrust", "thrust (p)"), "specific force, body (m/s²)", "acc", "Rᵀ(dv/dt + g)"),
    (("rate",), "body rate (rad/s)", "w", "from the attitude"),
)
MARKS = {"warning": COLOURS[1], "blocking": COLOURS[5]}
MOST_LINES = 6  # more lines are not distinguished by their colours
LONGEST_LINE = 175  # letters
