"""Figures of a vehicle identification: thrust curve, drag, comparison of models.

Each function returns a matplotlib Figure and changes no global state; `quadexp.report.figures.save` writes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm

from quadexp.models.regression import half_width
from quadexp.models.residual import AXES
from quadexp.models.samples import SIGNALS, Samples
from quadexp.models.terms import TermModel
from quadexp.models.thrust_curve import ThrustCurve, scaled_signal
from quadexp.models.vehicle_model import VehicleModel
from quadexp.report.style import COLOURS, COUNTS, KNOWN, ORANGE, Figure, styled

QUADRATIC = KNOWN["quadratic drag"][0]
LEVEL_COLOURS = {
    "nominal": KNOWN["nominal"][0],
    "offset": "#B5BAC2",
    "linear": ORANGE,
    "quadratic": QUADRATIC,
    "blade_element": KNOWN["blade element"][0],
    "blade_element_still": "#7F8C99",
}
BINS = 24


def draw_identification(model: VehicleModel, samples: Samples, report: Mapping[str, Any]) -> dict[str, Figure]:
    """Every figure by name."""
    return {
        "thrust": thrust_figure(model.thrust, samples),
        "drag": drag_figure(model.linear, model.thrust, samples, model.quadratic),
        "models": ladder_figure(report["selection"]),
    }


@styled
def thrust_figure(curve: ThrustCurve, samples: Samples) -> Figure:
    """Specific force along z over the mean signal of the rotors, the curve, and the residual over time."""
    scaled = scaled_signal(samples.signal, samples.voltage, curve.reference_voltage, curve.voltage_exponent)
    mean = scaled.mean(axis=1)
    grid = np.linspace(mean.min(), mean.max(), 100)
    plain = samples.signal.shape[1] if curve.signal != "thrust_acceleration" else 1
    total = curve.of_signal(np.repeat(grid[:, None], plain, axis=1), np.full(100, curve.reference_voltage)).sum(axis=1)
    left = samples.force[:, 2] - curve.of_signal(samples.signal, samples.voltage).sum(axis=1)
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    above, below = figure.subplots(1, 2)
    for i, name in enumerate(samples.names):
        own = samples.flight == i
        colour = COLOURS[(i + 1) % len(COLOURS)]
        thin = max(1, int(own.sum()) // 1500)
        above.plot(
            mean[own][::thin], samples.force[own, 2][::thin], ".", color=colour, markersize=1.5, alpha=0.5,
            rasterized=True,
        )  # fmt: skip
        centre, low, high = _binned(mean[own], left[own])
        below.fill_between(centre, low, high, color=colour, alpha=0.2, linewidth=0)
        below.plot(centre, (low + high) / 2, color=colour, label=name)
    above.plot(grid, total, color="#000000", label="thrust curve")
    unit = SIGNALS[curve.signal]
    label = f"{curve.signal.replace('_', ' ')}, mean of the rotors" + (f" ({unit})" if unit != "1" else "")
    if curve.reference_voltage:
        power = "" if curve.voltage_exponent == 1 else f"$^{{{curve.voltage_exponent:.3g}}}$"
        label += f", times (V / {curve.reference_voltage:g} V){power}"
    above.set(xlabel=label, ylabel="specific force along z (m/s²)", title="thrust curve")
    above.legend()
    below.axhline(0, color="#000000", linewidth=0.8)
    below.set(xlabel=label, ylabel="specific force minus curve (m/s²)", title="residual: mean ± 1 std in bins")
    below.legend(fontsize=7)
    return figure


@styled
def drag_figure(model: TermModel, curve: ThrustCurve, samples: Samples, quadratic: TermModel | None = None) -> Figure:
    """Specific force beyond the thrust over body velocity, axis by axis, with the fitted drag."""
    rotors = curve.of_signal(samples.signal, samples.voltage)
    target = samples.force - rotors.sum(axis=1)[:, None] * [0, 0, 1]
    usual = np.median(rotors, axis=0)
    figure = Figure(figsize=(9.6, 3.4), layout="constrained")
    for i, panel in enumerate(figure.subplots(1, 3)):
        v, a = samples.velocity[:, i], target[:, i]
        low, high = np.quantile(a, [0.002, 0.998])
        margin = 0.15 * (high - low)
        panel.hexbin(
            v, a, gridsize=(50, 30), mincnt=1, cmap=COUNTS, norm=LogNorm(), linewidths=0.1,
            extent=(v.min(), v.max(), low - margin, high + margin),
        )  # fmt: skip
        grid = np.zeros((100, 3))
        grid[:, i] = np.linspace(v.min(), v.max(), 100)
        for one, colour, dash in ((model, ORANGE, "-"), (quadratic, QUADRATIC, "--")):
            if one is not None:
                line = one.acceleration(grid, np.tile(usual, (100, 1)))[:, i]
                panel.plot(grid[:, i], line, color=colour, linestyle=dash, label=one.kind)
        value, error = model.coefficient(AXES[i], "linear")
        half = half_width(error, model.freedom[i])
        panel.set_title(f"$d_{AXES[i]}$ = {value:.3f} ± {half:.3f} 1/s", fontweight="normal", parse_math=True)
        panel.set_ylim(low - margin, high + margin)
        panel.set_xlabel(f"$v_{AXES[i]}$ relative to the air (m/s)", parse_math=True)
        panel.set_ylabel(f"$a_{AXES[i]}$ beyond the thrust (m/s²)", parse_math=True)
        if i == 0:
            panel.legend()
    return figure


@styled
def ladder_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """RMSE of every model in sample and on flights left out, axis by axis."""
    rows = [row for row in rows if row["in_sample"]]
    columns = ("x", "y", "z", "norm")
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    panels = figure.subplots(1, 2, sharey=True)
    width = 0.8 / max(len(rows), 1)
    for panel, part, title in zip(panels, ("in_sample", "held_out"), ("in sample", "flights left out"), strict=True):
        for k, row in enumerate(rows):
            if row[part]:
                at = np.arange(len(columns)) + (k - (len(rows) - 1) / 2) * width
                values = [row[part][name] for name in columns]
                panel.bar(at, values, width * 0.9, color=LEVEL_COLOURS[row["level"]], label=row["name"])
        panel.set_xticks(range(len(columns)), ["$a_x$", "$a_y$", "$a_z$", "vector"], parse_math=True)
        panel.set_title(title)
    if not any(row["held_out"] for row in rows):
        panels[1].text(0.5, 0.5, "one flight: nothing left out", ha="center", transform=panels[1].transAxes)
    panels[0].set_ylabel("RMSE of the specific force (m/s²)")
    panels[0].legend(fontsize=8)
    return figure


def _binned(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres, mean - std and mean + std of y in bins of equal count over x."""
    edges = np.quantile(x, np.linspace(0, 1, BINS + 1))
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, BINS - 1)
    kept = [y[index == b] for b in range(BINS)]
    centre = np.array([x[index == b].mean() for b in range(BINS) if (index == b).any()])
    mean = np.array([part.mean() for part in kept if len(part)])
    std = np.array([part.std() for part in kept if len(part)])
    return centre, mean - std, mean + std
