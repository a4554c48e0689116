"""Figures of one flight."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np

from quadexp.physics.state import POSITION, STATE_COLUMNS
from quadexp.report.style import COLOURS, STYLE, Figure

GREY = "0.6"


def over_time(flight: Any, columns: Sequence[str]) -> Figure:
    """Columns over time; those that share a unit share a panel."""
    units = flight.attrs.get("units", {})
    groups: dict[str, list[str]] = {}
    for name in columns:
        groups.setdefault(units.get(name, ""), []).append(name)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 0.6 + 1.8 * len(groups)), layout="constrained")
        panels = figure.subplots(len(groups), sharex=True, squeeze=False)[:, 0]
        for panel, (unit, names) in zip(panels, groups.items(), strict=True):
            for i, name in enumerate(names):
                panel.plot(flight["t"], flight[name], color=COLOURS[i % len(COLOURS)], label=name)
            panel.set_ylabel(f"({unit})" if unit else "")
            panel.legend(loc="upper right", ncols=4)
        panels[-1].set_xlabel("t (s)")
    return figure


def overview(flight: Any) -> Figure:
    """The path from above, the distance to the reference, and the rotor thrusts; of a log what it has."""
    position = list(STATE_COLUMNS[POSITION])
    reference = [f"ref_{name}" for name in position]
    thrusts = [name for name in flight if name.startswith("u_")]
    tracked = set(reference) <= set(flight)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(7.2, 3.4), layout="constrained")
        panels = figure.subplot_mosaic([["path", "upper"], ["path", "lower"]])
        path, upper, lower = (panels[name] for name in ("path", "upper", "lower"))
        if tracked:
            path.plot(flight[reference[0]], flight[reference[1]], color=GREY, linewidth=4, label="reference")
            distance = np.linalg.norm(flight[position].to_numpy() - flight[reference].to_numpy(), axis=1)
            upper.plot(flight["t"], 1e3 * distance, color=COLOURS[2])
            upper.set_ylabel("position error (mm)")
        else:
            speed = np.linalg.norm(flight[["v_x", "v_y", "v_z"]].to_numpy(), axis=1)
            upper.plot(flight["t"], speed, color=COLOURS[2])
            upper.set_ylabel("speed (m/s)")
        path.plot(flight["p_x"], flight["p_y"], color=COLOURS[2], label="flown")
        path.set(xlabel="x (m)", ylabel="y (m)", aspect="equal", adjustable="datalim")
        figure.legend(*path.get_legend_handles_labels(), loc="outside lower left", ncols=2)
        for i, name in enumerate(thrusts or ["p_z"]):
            lower.plot(flight["t"], flight[name], color=COLOURS[i % len(COLOURS)], linewidth=0.8)
        lower.set(xlabel="t (s)", ylabel="rotor thrusts (N)" if thrusts else "z (m)")
    return figure
