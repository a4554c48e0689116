"""Figures of what was identified: the delays, a vehicle, a validation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import binned_statistic

from quadexp.models.regression import half_width
from quadexp.models.residual import AXES
from quadexp.plugins.drawing.style import COLOURS, HUES, ORANGE, Figure, Look, looks, mathematics, styled
from quadexp.plugins.identification.lines import MODES, QUANTITIES, error_of, mean_of
from quadexp.plugins.identification.thrust_curve import ThrustCurve, scaled_signal
from quadexp.plugins.identification.vehicle_model import VehicleModel
from quadexp.plugins.logs.samples import SIGNALS, Samples
from quadexp.plugins.page.model_figures import BINS, MOST_DOTS, _legend_above, density
from quadexp.report.pairing import grouped

MS = 1e3  # of a second
SHOWN = 20.0  # log likelihood below the best that is drawn


class Profile(NamedTuple):
    """One delay. candidates: (k,) (s). score: log likelihood of each less that of the best, (k,). best, error: the
    delay and its standard error (s)."""

    name: str
    candidates: np.ndarray
    score: np.ndarray
    best: float
    error: float


@styled
def delay_figure(profiles: Sequence[Profile]) -> Figure:
    """A panel for each profile: what every candidate leaves unexplained."""
    figure = Figure(figsize=(9.0, 2.8))
    places = figure.subplot_mosaic([[profile.name for profile in profiles]])
    for profile in profiles:
        panel = places[profile.name]
        panel.plot(MS * profile.candidates, profile.score, color=HUES["blue"])
        interval = profile.best + profile.error * np.array([-1.0, 1.0])
        low, high = MS * np.clip(interval, profile.candidates[0], profile.candidates[-1])
        panel.axvspan(low, high, color=HUES["vermillion"], alpha=0.15, linewidth=0)
        panel.axvline(MS * profile.best, color=HUES["vermillion"], linestyle="--")
        result = f"found {MS * profile.best:.1f} ms, standard error {MS * profile.error:.1f}"
        panel.set(title=profile.name, xlabel=f"candidate, ms\n{result}", ylim=(-SHOWN, 0.05 * SHOWN))
        likely = MS * profile.candidates[profile.score > -SHOWN]
        panel.set_xlim(likely[0], likely[-1])
    places[profiles[0].name].set_ylabel("log likelihood, less the best")
    return figure


def identification_figures(model: VehicleModel, samples: Samples) -> dict[str, Figure]:
    """Every figure of an identification by name."""
    return {"thrust": thrust_figure(model.thrust, samples), "drag": drag_figure(model, samples)}


@styled
def thrust_figure(curve: ThrustCurve, samples: Samples) -> Figure:
    """Specific force along z over the mean signal of the rotors with the curve, and what that leaves, by flight."""
    scaled = scaled_signal(samples.signal, samples.voltage, curve.reference_voltage, curve.voltage_exponent)
    mean = scaled.mean(axis=1)
    grid = np.linspace(mean.min(), mean.max(), 100)
    total = curve.collective(grid)
    thrust = curve.of_signal(samples.signal, samples.voltage).sum(axis=1)
    residual = samples.force[:, 2] - thrust
    figure = Figure(figsize=(9.0, 3.6))
    force, beyond = figure.subplots(1, 2)
    beyond.axhline(0, color="#000000", linewidth=0.8)
    for i, name in enumerate(samples.names):
        of_flight = np.flatnonzero(samples.flight == i)
        thin = of_flight[:: max(1, len(of_flight) // MOST_DOTS)]
        colour = COLOURS[(i + 1) % len(COLOURS)]
        force.plot(mean[thin], samples.force[thin, 2], ".", color=colour, markersize=1.5, alpha=0.5, rasterized=True)
        centre, low, high = _binned(mean[of_flight], residual[of_flight])
        beyond.fill_between(centre, low, high, color=colour, alpha=0.2, linewidth=0)
        beyond.plot(centre, (low + high) / 2, color=colour, label=name)
    force.plot(grid, total, color="#000000", label="thrust curve")
    units = SIGNALS[curve.signal]
    label = f"{curve.signal.replace('_', ' ')}, mean of the rotors"
    if units != "1":
        label += f" ({units})"
    if curve.reference_voltage:
        label += f", times (V / {curve.reference_voltage:g} V)"
        if curve.voltage_exponent != 1:
            label += f"^{curve.voltage_exponent:.3g}"
    force.set(xlabel=label, ylabel="specific force along z (m/s²)", title="thrust curve")
    beyond.set(xlabel=label, ylabel="specific force minus curve (m/s²)", title="residual: mean ± 1 std in bins")
    force.legend()
    beyond.legend(fontsize=7)
    return figure


def _binned(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres, mean - std and mean + std of y in bins of equal count over x."""
    edges = np.unique(np.quantile(x, np.linspace(0, 1, BINS + 1)))
    centre = binned_statistic(x, x, "mean", edges).statistic
    mean = binned_statistic(x, y, "mean", edges).statistic
    std = binned_statistic(x, y, "std", edges).statistic
    return centre, mean - std, mean + std


@styled
def drag_figure(model: VehicleModel, samples: Samples) -> Figure:
    """Specific force beyond the thrust over body velocity, axis by axis, with the fitted drag."""
    rotors = model.thrust.of_signal(samples.signal, samples.voltage)
    target = samples.force - rotors.sum(axis=1)[:, None] * [0, 0, 1]
    usual = np.tile(np.median(rotors, axis=0), (100, 1))
    fitted = [(model.linear, ORANGE, "-")]
    if model.quadratic is not None:
        fitted.append((model.quadratic, HUES["green"], "--"))
    figure = Figure(figsize=(9.6, 3.4))
    panels = figure.subplots(1, 3)
    for i, (axis, panel) in enumerate(zip(AXES, panels, strict=True)):
        v = samples.velocity[:, i]
        a = target[:, i]
        low, high = np.quantile(a, [0.002, 0.998])
        margin = 0.15 * (high - low)
        limits = (low - margin, high + margin)
        grid = np.zeros((100, 3))
        grid[:, i] = np.linspace(v.min(), v.max(), 100)
        density(panel, v, a, (v.min(), v.max(), *limits), (50, 30))
        for terms, colour, dash in fitted:
            drag = terms.acceleration(grid, usual)
            panel.plot(grid[:, i], drag[:, i], color=colour, linestyle=dash, label=terms.kind)
        value, error = model.linear.coefficient(axis, "linear")
        half = half_width(error, model.linear.freedom[i])
        panel.set(title=f"$d_{axis}$ = {value:.3f} ± {half:.3f} 1/s", ylim=limits)
        panel.set(xlabel=f"$v_{axis}$ relative to the air (m/s)", ylabel=f"$a_{axis}$ beyond the thrust (m/s²)")
        mathematics(panel)
    panels[0].legend()
    return figure


def validation_figures(report: Mapping[str, Any]) -> dict[str, Figure]:
    """Every figure of a validation by name."""
    return {"speed": band_figure(report["bands"]), "rollouts": rollout_figure(report["rollouts"])}


@styled
def band_figure(bands: Sequence[Mapping[str, Any]]) -> Figure:
    """RMS of the vector over speed, as fitted (left) and with the thrust scale tracked (right)."""
    look = looks([row["predictor"] for row in bands])
    figure = Figure(figsize=(7.6, 3.4))
    panels = figure.subplots(1, 2, sharey=True)
    titles = {"rms": "as fitted", "rms_tracked": "thrust scale tracked"}
    for panel, (key, title) in zip(panels, titles.items(), strict=True):
        points = [(row["predictor"], (row["low"] + row["high"]) / 2, row[key]) for row in bands]
        _draw_curves(panel, points, look)
        panel.set(title=title, xlabel="speed (m/s)", ylabel="residual, RMS (m/s²)", ylim=(0, None))
    _legend_above(figure)
    return figure


@styled
def rollout_figure(rollouts: Sequence[Mapping[str, Any]]) -> Figure:
    """Open-loop errors over the horizon with the thrust scale tracked: a row per mode, a column per quantity.

    Modes with all 13 states have errors of attitude and rate too.
    """
    rows = [row for row in rollouts if row["thrust_tracked"]]
    flown_modes = {row["mode"] for row in rows}
    modes = [mode for mode in MODES if mode in flown_modes]
    quantities = [name for name in QUANTITIES if any(name in row for row in rows)]
    by_horizon = sorted(rows, key=lambda row: row["horizon"])
    look = looks([row["predictor"] for row in rows])
    figure = Figure(figsize=(0.6 + 3.1 * len(quantities), 0.5 + 2.5 * len(modes)))
    grid = figure.subplots(len(modes), len(quantities), squeeze=False)
    for (i, j), panel in np.ndenumerate(grid):
        mode = modes[i]
        quantity = quantities[j]
        errors = []
        for row in by_horizon:
            if row["mode"] == mode and quantity in row:
                errors.append((row["predictor"], row["horizon"], error_of(row, quantity)))
        if not errors:
            panel.remove()
            continue
        _draw_curves(panel, errors, look)
        panel.set(title=MODES[mode][0], xlabel="horizon (s)", xlim=(0, None), ylim=(0, None))
        panel.set_ylabel(f"{quantity} error, {mean_of(mode)} ({QUANTITIES[quantity][0]})")
    _legend_above(figure)
    return figure


def _draw_curves(panel: Any, points: Sequence[tuple[str, float, float]], look: Mapping[str, Look]) -> None:
    """A line with markers for each predictor. points: predictor, x, y."""
    curves = grouped((name, (x, y)) for name, x, y in points)
    for name, curve in curves.items():
        x, y = zip(*curve, strict=True)
        panel.plot(x, y, label=name, **look[name].points())
