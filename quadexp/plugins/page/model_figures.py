"""Figures of what is learned: a fit of Gaussian processes, the identification of a vehicle, a validation.

Each function returns a matplotlib Figure; `quadexp.plugins.drawing.style.save` writes it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LogNorm
from msgspec.structs import replace

from quadexp.models.base import AXIS, Prediction
from quadexp.models.dataset import ResidualDataset
from quadexp.models.residual import THRUST, VELOCITY
from quadexp.plugins.drawing.style import BLUE, COUNTS, ORANGE, Figure, entries, mathematics, styled
from quadexp.plugins.gaussian_process.gaussian_process import GaussianProcessModel
from quadexp.plugins.gaussian_process.posterior import OutputPosterior

CURVE_POINTS = 300  # one a pixel of a panel
MAX_COLUMNS = 4  # panels beside each other on a page
BINS = 24  # of a histogram of a panel's width
MOST_DOTS = 1500  # of a flight
QUANTITY = {  # first part of a feature's or output's name -> what it is, symbol, unit
    "v": ("body velocity", "v", "m/s"),
    "w": ("body rate", r"\omega", "rad/s"),
    "u": ("rotor thrust", "u", "N"),
    "thrust": ("collective thrust", "T", "N"),
    "a": ("residual", "a", "m/s²"),
    "tau": ("residual torque", r"\tau", "N m"),
}


class Curve(NamedTuple):
    """A model of one output over one feature x, (k,). line: linear drag, None for torques. middle: of all features."""

    x: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    line: np.ndarray | None
    middle: np.ndarray


def curve(
    model: GaussianProcessModel, output: OutputPosterior, i: int, data: ResidualDataset, count: int = CURVE_POINTS
) -> Curve:
    """The model over feature i within its data, all else at the medians of `data`."""
    points = data.matrix(output.features)
    middle = np.median(points, axis=0)
    low, high = model.feature_range.get(output.features[i], [points[:, i].min(), points[:, i].max()])
    features = np.tile(middle, (count, 1))
    features[:, i] = np.linspace(low, high, count)
    rows = _rows(output, features, data)
    prediction = _predict(model, output, rows)
    line = model.linear_drag.acceleration(rows)[:, AXIS[output.output]] if output.output in AXIS else None
    return Curve(features[:, i], prediction.mean, prediction.std, line, middle)


def moved(
    model: GaussianProcessModel, output: OutputPosterior, i: int, data: ResidualDataset
) -> tuple[np.ndarray, np.ndarray]:
    """The output's values in `data`, (n,), moved by the model's difference between their rows and the same feature i
    with all else at its median; and values minus mean."""
    features = data.matrix(output.features)
    held = np.tile(np.median(features, axis=0), (len(features), 1))
    held[:, i] = features[:, i]
    remainder = data.matrix([output.output])[:, 0] - _predict(model, output, data).mean
    return _predict(model, output, _rows(output, held, data)).mean + remainder, remainder


def _predict(model: GaussianProcessModel, output: OutputPosterior, rows: ResidualDataset) -> Prediction:
    """Prediction of one output, prior mean included."""
    return replace(model, outputs=(output,)).predict(rows)[output.output]


def _rows(output: OutputPosterior, features: np.ndarray, data: ResidualDataset) -> ResidualDataset:
    """Rows with the given features (k, d). What the prior mean and linear drag read beside them stands at its median
    in `data`; where the collective thrust is a feature, the rotors share it evenly."""
    rotors = [name for name in data.columns if name.startswith("u_")]
    beside = {}
    for name in (*VELOCITY, *rotors):
        if name in data.columns:
            beside[name] = float(np.median(data.columns[name]))
    columns = {name: np.full(len(features), value) for name, value in beside.items()}
    columns |= {name: features[:, j] for j, name in enumerate(output.features)}
    if THRUST in columns:
        columns |= {name: columns[THRUST] / len(rotors) for name in rotors if name not in output.features}
    elif not rotors:
        columns[THRUST] = np.zeros(len(features))
    return ResidualDataset(columns | {"flight": np.zeros(len(features), int)}, {})


def symbol(name: str) -> str:
    """A column's name as mathematics: a_x -> $a_x$, thrust -> $T$."""
    first, _, index = name.partition("_")
    letter = QUANTITY[first][1] if first in QUANTITY else first
    return f"${letter}_{{{index}}}$" if index else f"${letter}$"


def unit(name: str) -> str:
    """Unit of a feature or output."""
    return QUANTITY.get(name.partition("_")[0], ("", "", ""))[2]


def axis_label(name: str) -> str:
    """What stands at an axis: quantity, symbol, unit."""
    return f"{QUANTITY.get(name.partition('_')[0], ('',))[0]} {symbol(name)} ({unit(name)})".strip()


def density(panel: Any, x: np.ndarray, y: np.ndarray, extent: Sequence[float], cells: tuple[int, int]) -> None:
    """How many data lie where, darker where denser. extent: (x low, x high, y low, y high). cells: across and up."""
    look = {"mincnt": 1, "cmap": COUNTS, "norm": LogNorm(), "linewidths": 0.1, "zorder": 1}
    panel.hexbin(x, y, extent=tuple(extent), gridsize=cells, **look)


@styled
def fit_figure(model: GaussianProcessModel, data: ResidualDataset) -> Figure:
    """Mean of each output over each of its features with the data, and below it the data minus mean, with 2 sigma.

    data: samples to show, best held-out ones. With several features, a panel moves one of them and holds
    the others at their medians; the data are moved by the model's difference (`moved`).
    """
    pairs = []
    for output in model.outputs:
        for i in range(len(output.features)):
            pairs.append((output, i))
    columns = min(len(pairs), MAX_COLUMNS)
    lines = -(-len(pairs) // columns)
    figure = Figure(figsize=(3.3 * columns + 0.4, 4.6 * lines + 0.4))
    grid = figure.subplots(2 * lines, columns, squeeze=False, height_ratios=(1.7, 1) * lines)
    for k in range(lines * columns):
        panels = grid[2 * (k // columns), k % columns], grid[2 * (k // columns) + 1, k % columns]
        if k < len(pairs):
            _draw_fit(*panels, model, *pairs[k], data)
        for panel in panels[k < len(pairs) and 2 :]:
            panel.remove()
    _legend_above(figure)
    return figure


def _draw_fit(
    upper: Any, lower: Any, model: GaussianProcessModel, output: OutputPosterior, i: int, data: ResidualDataset
) -> None:
    """Mean and data over feature i; and the data minus mean, the 2-sigma band, the inducing points."""
    features = data.matrix(output.features)
    x, mean, std, line, median = curve(model, output, i, data)
    target, remainder = moved(model, output, i, data)
    band = 2 * std
    low = x[0]
    high = x[-1]
    ends = low - 0.03 * (high - low), high + 0.03 * (high - low)
    inside = (features[:, i] >= low) & (features[:, i] <= high)  # beyond, the model extrapolates
    if not inside.any():
        inside[:] = True
    top = _limits(np.concatenate([np.quantile(target[inside], [0.0005, 0.9995]), mean]))
    bottom = _limits(np.array([-1, 1]) * max(np.quantile(np.abs(remainder[inside]), 0.998), 1.15 * np.median(band)))
    points = output.inducing[:, i]
    points = points[(points > ends[0]) & (points < ends[1])]
    others = []
    for j, (name, value) in enumerate(zip(output.features, median, strict=True)):
        if j != i:
            others.append(f"{symbol(name)} = {round(value, 1) + 0.0:g} {unit(name)}")
    title = [f"{symbol(output.output)} over {symbol(output.features[i])}" + (", at" if others else "")]
    title += [", ".join(others[j : j + 3]) for j in range(0, len(others), 3)]
    density(upper, features[:, i], target, (*ends, *top), (60, 36))
    upper.plot([], [], linestyle="none", marker="h", color="#6B7690", label="data, darker where denser")
    upper.fill_between(x, mean - band, mean + band, color=BLUE, alpha=0.25, linewidth=0, label="2 σ", zorder=2)
    upper.plot(x, mean, color=BLUE, linewidth=1.8, label="GP mean", zorder=4)
    if line is not None:
        upper.plot(x, line, color=ORANGE, linestyle=(0, (5, 2)), label="linear drag", zorder=3)
    upper.tick_params(labelbottom=False)
    upper.set(title="\n".join(title), ylabel=axis_label(output.output), xlim=ends, ylim=top)
    density(lower, features[:, i], remainder, (*ends, *bottom), (60, 20))
    lower.fill_between(x, -band, band, color=BLUE, alpha=0.25, linewidth=0, zorder=2)
    lower.axhline(0, color=BLUE, linewidth=1.4, zorder=3)
    at_foot = {"marker": "|", "markersize": 9, "markeredgewidth": 1.1, "clip_on": False, "zorder": 5}
    lower.plot(points, np.full(len(points), bottom[0]), "k", linestyle="none", label="inducing points", **at_foot)
    lower.set(ylabel=f"data minus mean ({unit(output.output)})", xlabel=axis_label(output.features[i]))
    lower.set(xlim=ends, ylim=bottom)
    for panel in (upper, lower):
        mathematics(panel)


def _limits(values: np.ndarray) -> tuple[float, float]:
    """Vertical limits around the values, with a little air."""
    low = float(np.min(values))
    high = float(np.max(values))
    return low - 0.06 * (high - low), high + 0.06 * (high - low)


def _legend_above(figure: Figure) -> None:
    """One legend of all panels."""
    handles, labels = entries(figure.axes)
    figure.legend(handles, labels, loc="outside upper center", ncols=min(6, len(labels)))
