"""The figure of a search: every trial's error over the flights spent, and the best so far."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadexp.report.metrics import SHOWN
from quadexp.report.panels import Panel, mark, panel_figure
from quadexp.report.style import Figure
from quadexp.report.tables import TITLES
from quadexp.tune.search import Request, Trial


def history_figure(trials: Sequence[Trial], request: Request, flights: int) -> Figure:
    """Geometric mean error of each trial over the flights spent; crosses: trials with a lost flight.

    Hollow: trials with too small a delay margin."""
    factor, unit = SHOWN[request.metric]
    spent = flights * np.arange(1, len(trials) + 1)
    error = factor * np.array([trial.worth.error for trial in trials])
    values = np.array([trial.worth.value for trial in trials])
    best = [int(np.argmin(values[: k + 1])) for k in range(len(values))]
    ended = np.array([trial.worth.lost == 0 for trial in trials])
    short = ended & np.array([trial.worth.margin < request.least_margin for trial in trials])
    least = f"trial with a delay margin below {1e3 * request.least_margin:g} ms"
    kinds: list[tuple[np.ndarray, str, dict[str, object]]] = [
        (ended & ~short, "trial", {"marker": "o", "markersize": 3.5, "color": "#4a6fa5", "alpha": 0.7}),
        (short, least, {"marker": "o", "markersize": 4, "color": "#4a6fa5", "fillstyle": "none"}),
        (~ended, "trial with a lost flight", {"marker": "x", "color": "#b3261e"}),
    ]
    marks = []
    for chosen, label, look in kinds:
        shown = chosen & np.isfinite(error)
        if shown.any() or label != least:
            marks.append(mark("plot", spent[shown], error[shown], linestyle="none", label=label, **look))
    marks.append(mark("step", spent, error[best], where="post", color="#17191d", linewidth=1.4, label="best so far"))
    marks.append(mark("axhline", error[0], color="#8a9099", linewidth=1.0, linestyle="--", label="before"))
    ylabel = f"{TITLES[request.metric]} ({unit}), geometric mean"
    return panel_figure([[Panel(marks, {"yscale": "log", "xlabel": "flights", "ylabel": ylabel}, {})]], (6.4, 3.4))
