"""Figures of a validation: residual by axis and by speed, error against horizon, thrust scale over time.

Each function returns a matplotlib Figure and touches no global state; `quadexp.report.figures.save` writes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from quadexp.learn.validation import Residuals
from quadexp.report.style import COLOURS, looks, styled

UNITS = {"position": "m", "velocity": "m/s", "attitude": "rad", "rate": "rad/s"}


@styled
def residual_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """RMS of the vector with its interval, a bar a predictor: as fitted, and with the thrust scale tracked."""
    names = list(dict.fromkeys(row["predictor"] for row in rows))
    figure = Figure(figsize=(6.4, 0.9 + 0.5 * len(names)), layout="constrained")
    panel = figure.subplots()
    for tracked, colour, label in ((False, COLOURS[1], "as fitted"), (True, COLOURS[2], "thrust scale tracked")):
        found = {row["predictor"]: row for row in rows if row["thrust_tracked"] == tracked}
        at = np.arange(len(names)) + (0.2 if tracked else -0.2)
        value = np.array([found[name]["rms"] for name in names])
        low = value - [found[name]["rms_low"] for name in names]
        high = np.array([found[name]["rms_high"] for name in names]) - value
        panel.barh(at, value, 0.36, xerr=np.maximum([low, high], 0), color=colour, label=label, ecolor="#444444")
    panel.set_yticks(range(len(names)), names)
    panel.invert_yaxis()
    panel.set_xlabel("residual of the specific force, RMS (m/s²)")
    panel.legend()
    return figure


@styled
def band_figure(bands: Sequence[Mapping[str, Any]]) -> Figure:
    """RMS of the vector over speed, as fitted (left) and with the thrust scale tracked (right)."""
    names = list(dict.fromkeys(row["predictor"] for row in bands))
    worn = looks(names)
    figure = Figure(figsize=(7.6, 3.4), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for panel, key, title in zip(panels, ("rms", "rms_tracked"), ("as fitted", "thrust scale tracked"), strict=True):
        for name in names:
            own = [row for row in bands if row["predictor"] == name]
            x = [(row["low"] + row["high"]) / 2 for row in own]
            y = [row[key] for row in own]
            panel.plot(x, y, label=name, **worn[name].points())
        panel.set_title(title)
        panel.set_xlabel("speed (m/s)")
        panel.set_ylim(bottom=0)
    panels[0].set_ylabel("residual, RMS (m/s²)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=min(6, len(names)))
    return figure


@styled
def rollout_figure(rollouts: Sequence[Mapping[str, Any]]) -> Figure:
    """Open-loop errors over the horizon, a panel a quantity; attitude and rate where all 13 states were predicted."""
    shown = [
        (mode, quantity)
        for mode in ("attitude", "full")
        for quantity in UNITS
        if any(row["mode"] == mode and quantity in row for row in rollouts)
    ]
    columns = min(2, len(shown))
    lines = -(-len(shown) // columns)
    figure = Figure(figsize=(4.0 * columns, 3.0 * lines + 0.5), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False)
    names = list(dict.fromkeys(row["predictor"] for row in rollouts))
    worn = looks(names)
    for panel, (mode, quantity) in zip(panels.flat, shown, strict=False):
        for name in names:
            shown_as = quantity if mode == "attitude" else f"{quantity}_median"
            own = sorted(
                (row["horizon"], row[shown_as])
                for row in rollouts
                if row["predictor"] == name and row["mode"] == mode and row["thrust_tracked"] and quantity in row
            )
            if own:
                panel.plot(*zip(*own, strict=True), label=name, **worn[name].points())
        panel.set_title("attitude as measured" if mode == "attitude" else "all states predicted")
        panel.set_xlabel("horizon (s)")
        mean = "RMS" if mode == "attitude" else "median"
        panel.set_ylabel(f"{quantity} error, {mean} ({UNITS[quantity]})")
        panel.set_ylim(bottom=0)
        panel.set_xlim(left=0)
    for panel in list(panels.flat)[len(shown) :]:
        panel.set_axis_off()
    figure.legend(*panels.flat[0].get_legend_handles_labels(), loc="outside upper center", ncols=min(6, len(names)))
    return figure


@styled
def scale_figure(found: Sequence[Residuals], flights: Sequence[str]) -> Figure:
    """The tracked scale of the thrust over each flight, by the predictor that leaves least."""
    best = min(found, key=lambda one: float(np.mean(one.tracked**2)))
    figure = Figure(figsize=(6.4, 3.0), layout="constrained")
    panel = figure.subplots()
    for k, index in enumerate(np.unique(best.flight)):
        scale = best.scale[best.flight == index]
        label = flights[int(index)] if int(index) < len(flights) else str(index)
        panel.plot(np.linspace(0, 1, len(scale)), scale, color=COLOURS[k % len(COLOURS)], label=label)
    panel.axhline(1, color="#777777", linewidth=1)
    panel.set_xlabel("share of the flight")
    panel.set_ylabel("thrust over thrust curve")
    panel.set_title(f"tracked beside {best.predictor}", fontweight="normal")
    panel.legend()
    return figure
