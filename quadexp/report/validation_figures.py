"""Figures of a validation: residual by axis and by speed, error against horizon, thrust scale over time.

Each function returns a matplotlib Figure and changes no global state; `quadexp.report.figures.save` writes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quadexp.models.validation import Residuals
from quadexp.report.style import COLOURS, GREY, Figure, entries, looks, styled
from quadexp.report.validation_table import MODES, QUANTITIES, error_of, mean_of


@styled
def residual_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """RMS of the vector with its interval, a bar per predictor: as fitted, and with the thrust scale tracked."""
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
    look = looks(names)
    figure = Figure(figsize=(7.6, 3.4), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    for panel, key, title in zip(panels, ("rms", "rms_tracked"), ("as fitted", "thrust scale tracked"), strict=True):
        for name in names:
            own = [row for row in bands if row["predictor"] == name]
            x = [(row["low"] + row["high"]) / 2 for row in own]
            y = [row[key] for row in own]
            panel.plot(x, y, label=name, **look[name].points())
        panel.set_title(title)
        panel.set_xlabel("speed (m/s)")
        panel.set_ylim(bottom=0)
    panels[0].set_ylabel("residual, RMS (m/s²)")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=min(6, len(names)))
    return figure


@styled
def rollout_figure(rollouts: Sequence[Mapping[str, Any]]) -> Figure:
    """Open-loop errors over the horizon with the thrust scale tracked: a row per mode, a column per quantity.

    Modes with all 13 states have errors of attitude and rate too.
    """
    rows = [row for row in rollouts if row["thrust_tracked"]]
    modes = [mode for mode in MODES if any(row["mode"] == mode for row in rows)]
    quantities = [name for name in QUANTITIES if any(name in row for row in rows)]
    look = looks(list(dict.fromkeys(row["predictor"] for row in rows)))
    size = (0.6 + 3.1 * len(quantities), 0.5 + 2.5 * len(modes))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(modes), len(quantities), squeeze=False, sharex=True)
    for line, mode in zip(panels, modes, strict=True):
        for panel, quantity in zip(line, quantities, strict=True):
            found = [row for row in rows if row["mode"] == mode and quantity in row]
            if not found:
                panel.set_axis_off()
                continue
            for name in look:
                own = sorted((row["horizon"], error_of(row, quantity)) for row in found if row["predictor"] == name)
                panel.plot(*zip(*own, strict=True), label=name, **look[name].points())
            panel.set_title(MODES[mode][0])
            panel.set_xlabel("horizon (s)")
            panel.set_ylabel(f"{quantity} error, {mean_of(mode)} ({QUANTITIES[quantity][0]})")
            panel.set_ylim(bottom=0)
            panel.set_xlim(left=0)
            panel.xaxis.set_tick_params(labelbottom=True)
    figure.legend(*entries(panels.flat), loc="outside upper center", ncols=min(6, len(look)))
    return figure


@styled
def scale_figure(found: Sequence[Residuals], flights: Sequence[str]) -> Figure:
    """The tracked scale of the thrust over each flight, by the predictor with the least residual."""
    best = min(found, key=lambda one: float(np.mean(one.tracked**2)))
    figure = Figure(figsize=(6.4, 3.0), layout="constrained")
    panel = figure.subplots()
    for k, index in enumerate(np.unique(best.flight)):
        scale = best.scale[best.flight == index]
        label = flights[int(index)] if int(index) < len(flights) else str(index)
        panel.plot(np.linspace(0, 1, len(scale)), scale, color=COLOURS[k % len(COLOURS)], label=label)
    panel.axhline(1, color=GREY, linewidth=1)
    panel.set_xlabel("share of the flight")
    panel.set_ylabel("thrust over thrust curve")
    panel.set_title(f"tracked beside {best.predictor}", fontweight="normal")
    panel.legend()
    return figure
