"""Figures of a quality check: each sensor against its value computed from the others, over time, faults marked.

Three columns, three axes: velocity against dp/dt, specific force against R^T (dv/dt + g), body rate against the
derivative of the attitude, all as means over windows of 0.1 s (quadexp/log/signal/windows.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from quadexp.log.check import Finding
from quadexp.log.schema import Flight
from quadexp.log.signal.windows import STREAMS, Pair, cut, pairs
from quadexp.report.style import COLOURS, Figure, styled

COLUMNS = (
    (("velocity",), "velocity, world (m/s)", "v", "dp/dt"),
    (("force", "force (p)", "thrust", "thrust (p)"), "specific force, body (m/s²)", "acc", "Rᵀ(dv/dt + g)"),
    (("rate",), "body rate (rad/s)", "w", "from the attitude"),
)
FOUND, EXPECTED = COLOURS[2], COLOURS[1]
MARKS = {"info": "#999999", "warning": COLOURS[1], "blocking": COLOURS[5]}
MOST_LINES = 6
HEADROOM = 0.3  # of the first row of panels, where the legends stand
QUIET = 0.995  # quantile that sets an axis's limits: one spike must not flatten the rest


@styled
def consistency_figure(name: str, flight: Flight, findings: Sequence[Finding]) -> Figure:
    """Overlays of a flight's streams with the findings beneath the title and their time spans shaded."""
    t, relations = _relations(flight)
    shown = [finding for finding in findings if finding.severity != "info"]
    figure = Figure(figsize=(11, 6.4 + 0.16 * min(len(shown), MOST_LINES)), layout="constrained")
    figure.suptitle("\n".join([name, *_lines(shown)]), fontsize=9, ha="left", x=0.01)
    panels = figure.subplots(3, 3, sharex=True)
    for column, (names, title, found, expected) in enumerate(COLUMNS):
        pair = next((relations[key] for key in names if key in relations), None)
        panels[0, column].set_title(title)
        for row, axis in enumerate("xyz"):
            panel = panels[row, column]
            if pair is None:
                panel.text(0.5, 0.5, "not in the flight", transform=panel.transAxes, ha="center", color="#777777")
                panel.set_yticks([])
            else:
                _draw(panel, t, pair, row, found, expected)
            for finding in shown:
                if finding.span is not None:
                    low, high = finding.span
                    panel.axvspan(low, max(high, low + 0.02), color=MARKS[finding.severity], alpha=0.3, lw=0)
            if column == 0:
                panel.set_ylabel(axis)
        panels[2, column].set_xlabel("t (s)")
        if pair is not None:
            panels[0, column].legend(loc="upper right", ncols=2, fontsize=8)
    return figure


def _lines(findings: Sequence[Finding]) -> list[str]:
    lines = [f"{one.severity}: {one.name}: {one.where}: {one.measured}" for one in findings[:MOST_LINES]]
    lines = [line if len(line) < 175 else line[:172] + "..." for line in lines]
    if len(findings) > MOST_LINES:
        lines.append(f"and {len(findings) - MOST_LINES} more")
    return lines or ["no finding that blocks or warns"]


def _relations(flight: Flight) -> tuple[np.ndarray, dict[str, Pair]]:
    t = np.asarray(flight.t, float)
    streams = {
        name: flight.stack(columns).astype(float)
        for name, columns in STREAMS.items()
        if all(column in flight.columns for column in columns)
    }
    good = np.isfinite(t)
    streams = {name: values for name, values in streams.items() if np.isfinite(values).all(axis=1).mean() > 0.5}
    for values in streams.values():
        good &= np.isfinite(values).all(axis=1)
    windows = cut(t, streams, good, flight.columns.get("segment"))
    return windows.t, {pair.relation: pair for pair in pairs(windows)} if len(windows.t) else {}


def _draw(panel: Any, t: np.ndarray, pair: Pair, row: int, found: str, expected: str) -> None:
    half = t.shape[1] // 2
    halves = len(pair.found) == 2 * len(t)  # both halves of a window were compared
    time = np.concatenate([t[:, half // 2], t[:, half + half // 2]]) if halves else t[:, half]
    order = np.argsort(time, kind="stable")
    time, a, b = time[order], pair.expected[order, row], pair.found[order, row]
    gaps = np.diff(time)
    broken = np.flatnonzero(gaps > 3 * np.median(gaps)) + 1 if len(time) > 2 else np.zeros(0, int)
    time, a, b = (np.insert(x, broken, np.nan) for x in (time, a, b))
    panel.plot(time, a, color=EXPECTED, lw=1.6, label=expected)
    if not pair.relation.startswith("thrust"):
        panel.plot(time, b, color=FOUND, lw=0.8, label=found)
    both = np.concatenate([a, b])
    low, high = np.nanquantile(both, [1 - QUIET, QUIET])
    margin = max(0.15 * (high - low), 3 * pair.floor)
    panel.set_ylim(low - margin, high + margin + (HEADROOM * (high - low + 2 * margin) if row == 0 else 0.0))
