"""The figure of a search: every trial's error over the flights spent, and the best so far."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadexp.report.figures import save
from quadexp.report.metrics import SHOWN
from quadexp.report.style import Figure, plain_log, styled
from quadexp.report.tables import TITLES
from quadexp.tune.search import Request, Trial


@styled
def history_figure(trials: Sequence[Trial], request: Request, flights: int) -> Figure:
    """Geometric mean error of each trial over the flights spent; crosses: trials with a lost flight.

    Hollow: trials with too small a delay margin."""
    factor, unit = SHOWN[request.metric]
    spent = flights * np.arange(1, len(trials) + 1)
    error = factor * np.array([trial.worth.error for trial in trials])
    good = np.array([trial.worth.lost == 0 for trial in trials]) & np.isfinite(error)
    values = np.array([trial.worth.value for trial in trials])
    best = [int(np.argmin(values[: k + 1])) for k in range(len(values))]
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    panel = figure.subplots()
    lost = ~good & np.isfinite(error)
    short = good & np.array([trial.worth.margin < request.least_margin for trial in trials])
    good &= ~short
    panel.plot(spent[good], error[good], "o", markersize=3.5, color="#4a6fa5", alpha=0.7, label="trial")
    if short.any():
        least = f"trial with a delay margin below {1e3 * request.least_margin:g} ms"
        panel.plot(spent[short], error[short], "o", markersize=4, color="#4a6fa5", fillstyle="none", label=least)
    panel.plot(spent[lost], error[lost], "x", color="#b3261e", label="trial with a lost flight")
    panel.step(spent, error[best], where="post", color="#17191d", linewidth=1.4, label="best so far")
    panel.axhline(error[0], color="#8a9099", linewidth=1.0, linestyle="--", label="before")
    panel.set_yscale("log")
    plain_log(panel.yaxis)
    panel.set_xlabel("flights")
    panel.set_ylabel(f"{TITLES[request.metric]} ({unit}), geometric mean")
    panel.legend()
    return figure


def draw_history(trials: Sequence[Trial], request: Request, flights: int, path: Path) -> Path:
    """Write the figure as SVG and PNG; returns the path of the SVG."""
    return save(history_figure(trials, request, flights), path)
