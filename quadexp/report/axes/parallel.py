"""Parallel coordinates: an axis a key, a line a combination, its colour the error, which is the last axis.

Combinations without a flight that ended well are dashed and grey, and end below the last axis.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize

from quadexp.report.axes.lines import caption, is_log, notes_of
from quadexp.report.axes.view import Axis, View
from quadexp.report.figures import ERROR_COLOURS
from quadexp.report.style import Figure, plain_log, styled
from quadexp.report.text import significant

MOST_TICKS = 12
MOST_COMBINATIONS = 400  # that are drawn: with more, a line cannot be told from its neighbours


@styled
def parallel_figure(view: View) -> Figure:
    """The figure of a view of kind "parallel"."""
    means = [view.factor * point.mean for point in view.places.values() if point.is_shown]
    log = is_log(view)
    norm = LogNorm(min(means), max(means)) if log else Normalize(min(means), max(means) or 1.0)
    n = len(view.along)
    lines = sorted(view.places.items(), key=lambda one: -one[1].mean if one[1].is_shown else -math.inf)
    if len(lines) > MOST_COMBINATIONS:  # the best and the worst, and as many between them as can be seen
        every = np.linspace(0, len(lines) - 1, MOST_COMBINATIONS).round().astype(int)
        said = f"{MOST_COMBINATIONS} of {len(lines)} combinations drawn, from the best to the worst"
        view, lines = replace(view, notes=(*view.notes, said)), [lines[i] for i in every]
    width = max(5.6, 1.6 * len(view.along) + 2.4)
    figure = Figure(figsize=(width, 4.2 + 0.17 * len(notes_of(view, (), width))), layout="constrained")
    panel = figure.subplots()
    for place, point in lines:
        heights = [height(axis, value) for axis, value in zip(view.along, place, strict=True)]
        if point.is_shown:
            value = view.factor * point.mean
            end, colour = float(norm(value)) if max(means) > min(means) else 0.5, ERROR_COLOURS(norm(value))
            panel.plot(range(n + 1), [*heights, end], color=colour, linewidth=1.4, alpha=0.9)
            if point.ended < point.trials:
                panel.annotate(
                    f"{point.ended}/{point.trials}", (n, end), (3, -2), textcoords="offset points", fontsize=6
                )
        else:
            panel.plot(range(n + 1), [*heights, -0.08], color="#AAAAAA", linewidth=0.9, linestyle=":")
    for k, axis in enumerate(view.along):
        _ticks(panel, k, axis)
    panel.set_xticks(range(n + 1), [*(axis.label for axis in view.along), view.y_label], rotation=20, ha="right")
    panel.set_yticks([])
    panel.set_ylim(-0.12, 1.06)
    panel.set_xlim(-0.35, n + 0.25)
    panel.grid(False)
    for name in ("left", "bottom"):
        panel.spines[name].set_visible(False)
    for k in range(n + 1):
        panel.axvline(k, color="#555555", linewidth=0.8, zorder=0)
    gone = sum(not point.is_shown for point in view.places.values())
    if gone:
        panel.text(
            n, -0.1, f" {gone} without a flight that ended well", fontsize=7, color="#777777", va="center", ha="right"
        )
    bar = figure.colorbar(ScalarMappable(norm, ERROR_COLOURS), ax=panel, label=view.y_label)
    if log:
        plain_log(bar.ax.yaxis)
    caption(figure, view, (), width)
    return figure


def height(axis: Axis, value: Any) -> float:
    """Where a value stands on its axis, in [0, 1]."""
    if axis.kind == "group":
        return axis.values.index(value) / (len(axis.values) - 1) if len(axis.values) > 1 else 0.5
    low, high = float(min(axis.values)), float(max(axis.values))
    if low == high:
        return 0.5
    if axis.scale == "log":
        return (math.log(float(value)) - math.log(low)) / (math.log(high) - math.log(low))
    return (float(value) - low) / (high - low)


def _ticks(panel: Any, k: int, axis: Axis) -> None:
    every = np.linspace(0, len(axis.values) - 1, min(len(axis.values), MOST_TICKS)).round().astype(int)
    for i in dict.fromkeys(every.tolist()):
        value = axis.values[i]
        text = (
            axis.text(value)
            if axis.kind == "group"
            else significant(float(value))
            if isinstance(value, float)
            else f"{value}"
        )
        text = f"{value:g}" if axis.kind == "number" else text
        panel.text(k - 0.03, height(axis, value), text, fontsize=7, ha="right", va="center",
                   bbox={"facecolor": "#FFFFFF", "edgecolor": "none", "pad": 0.6, "alpha": 0.8})  # fmt: skip
