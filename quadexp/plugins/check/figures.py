"""The figure of the quality check: each sensor against what the others say."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from quadexp.log.schema import Flight
from quadexp.physics.state import finite_rows
from quadexp.plugins.check.recording import finite
from quadexp.plugins.drawing.style import COLOURS, Figure, styled
from quadexp.plugins.logs.finding import Finding
from quadexp.plugins.logs.signal.windows import Pair, cut, pairs, streams_of

HEADROOM = 0.3  # of the first row of panels, where the legends stand
QUIET = 0.995  # quantile that sets an axis's limits: one spike must not flatten the rest


COMPARED = (  # relations, title, a sensor, what the others say it should be; see quadexp/plugins/logs/signal/windows.py
    (("velocity",), "velocity, world (m/s)", "v", "dp/dt"),
    (("force", "force (p)", "thrust", "thrust (p)"), "specific force, body (m/s²)", "acc", "Rᵀ(dv/dt + g)"),
    (("rate",), "body rate (rad/s)", "w", "from the attitude"),
)
MARKS = {"warning": COLOURS[1], "blocking": COLOURS[5]}
MOST_LINES = 6  # more lines are not distinguished by their colours
LONGEST_LINE = 175  # letters


@styled
def consistency_figure(name: str, flight: Flight, findings: Sequence[Finding]) -> Figure:
    """Each sensor against its value computed from the others, as means over windows of 0.1 s; findings in the title,
    their time spans shaded. Columns: velocity, specific force, body rate; rows: the axes."""
    t, relations = _relations(flight)
    shown = [finding for finding in findings if finding.severity in MARKS]
    figure = Figure(figsize=(11, 6.4 + 0.16 * min(len(shown), MOST_LINES)))
    grid = figure.subplots(3, 3, sharex=True)
    for column, (names, title, sensor, computed) in zip(grid.T, COMPARED, strict=True):
        column[0].set_title(title)
        column[2].set_xlabel("t (s)")
        pair = next((relations[relation] for relation in names if relation in relations), None)
        for row, panel in enumerate(column):
            if pair is None:
                panel.annotate("not in the flight", (0.5, 0.5), xycoords="axes fraction", ha="center", color="#777777")
                panel.set_yticks([])
            else:
                _overlay(panel, t, pair, row, sensor, computed)
            _shade(panel, shown)
        if pair is not None:
            column[0].legend(loc="upper right", ncols=2, fontsize=8)
    for panel, axis in zip(grid[:, 0], "xyz", strict=True):
        panel.set_ylabel(axis)
    lines = [name]
    for finding in shown[:MOST_LINES]:
        line = f"{finding.severity}: {finding.name}: {finding.where}: {finding.measured}"
        if len(line) >= LONGEST_LINE:
            line = f"{line[: LONGEST_LINE - 3]}..."
        lines.append(line)
    if len(shown) > MOST_LINES:
        lines.append(f"and {len(shown) - MOST_LINES} more")
    if not shown:
        lines.append("no finding that blocks or warns")
    figure.suptitle("\n".join(lines), fontsize=9, ha="left", x=0.01)
    return figure


def _shade(panel: Any, findings: Sequence[Finding]) -> None:
    """The stretches that findings are about."""
    for finding in findings:
        if finding.span is not None:
            start, end = finding.span
            panel.axvspan(start, max(end, start + 0.02), color=MARKS[finding.severity], alpha=0.3, lw=0)


def _relations(flight: Flight) -> tuple[np.ndarray, dict[str, Pair]]:
    """Times of the windows, (n, k) (s), and what two streams say of the same quantity in each, by relation."""
    t = np.asarray(flight.t, float)
    streams = {name: x for name, x in streams_of(flight).items() if finite_rows(x).mean() > 0.5}
    good = np.isfinite(t) & finite(streams)
    windows = cut(t, streams, good, flight.columns.get("segment"))
    known = {}
    if len(windows.t):
        known = {pair.name: pair for pair in pairs(windows)}
    return windows.t, known


def _overlay(panel: Any, t: np.ndarray, pair: Pair, axis: int, sensor: str, computed: str) -> None:
    """The two lines of a panel, and its limits."""
    half = t.shape[1] // 2
    time = t[:, half]
    if len(pair.measured) == 2 * len(t):  # both halves of a window were compared
        time = np.concatenate([t[:, half // 2], t[:, half + half // 2]])
    lines = pd.DataFrame({computed: pair.expected[:, axis], sensor: pair.measured[:, axis]}, time).sort_index()
    step = np.diff(lines.index)
    after_gap = step > 3 * np.median(step)
    lines[np.append(False, after_gap)] = np.nan  # a line ends at a gap
    panel.plot(lines[computed], color=COLOURS[1], lw=1.6, label=computed)
    if not pair.name.startswith("thrust"):
        panel.plot(lines[sensor], color=COLOURS[2], lw=0.8, label=sensor)
    low, high = np.nanquantile(lines, [1 - QUIET, QUIET])
    margin = max(0.15 * (high - low), 3 * pair.relation.floor)
    above = 0.0
    if axis == 0:
        above = HEADROOM * (high - low + 2 * margin)
    panel.set_ylim(low - margin, high + margin + above)
