"""Figures of what is learned: a fit of Gaussian processes, the identification of a vehicle, a validation.

Each function returns a matplotlib Figure; `quadexp.plugins.drawing.style.save` writes it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LogNorm
from msgspec.structs import replace
from numpy.typing import ArrayLike

from quadexp.models.base import AXIS, Prediction
from quadexp.models.dataset import ResidualDataset
from quadexp.models.residual import THRUST, VELOCITY
from quadexp.names import named
from quadexp.plugins.drawing.style import BLUE, COUNTS, ORANGE, Figure, entries, mathematics, styled
from quadexp.plugins.gaussian_process.gaussian_process import GaussianProcessModel
from quadexp.plugins.gaussian_process.posterior import OutputPosterior

CURVE_POINTS = 300  # one a pixel of a panel
MAX_COLUMNS = 4  # panels beside each other on a page
BINS = 24  # of a histogram of a panel's width
MOST_DOTS = 1500  # of a flight
MARGIN = 0.06  # of the values, above and below them
MARGIN_ALONG = 0.03  # of a feature, on either side


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
    x = np.linspace(low, high, count)
    rows = _rows_along(output, i, x, data)
    prediction = _predict(model, output, rows)
    line = None
    if output.output in AXIS:
        line = model.linear_drag.acceleration(rows)[:, AXIS[output.output]]
    return Curve(x, prediction.mean, prediction.std, line, middle)


def moved(
    model: GaussianProcessModel, output: OutputPosterior, i: int, data: ResidualDataset
) -> tuple[np.ndarray, np.ndarray]:
    """The output's values in `data`, (n,), moved by the model's difference between their rows and the same feature i
    with all else at its median; and values minus mean."""
    rows = _rows_along(output, i, data.matrix([output.features[i]])[:, 0], data)
    values = data.matrix([output.output])[:, 0]
    remainder = values - _predict(model, output, data).mean
    return _predict(model, output, rows).mean + remainder, remainder


def _predict(model: GaussianProcessModel, output: OutputPosterior, rows: ResidualDataset) -> Prediction:
    """Prediction of one output, prior mean included."""
    return replace(model, outputs=(output,)).predict(rows)[output.output]


def _rows_along(output: OutputPosterior, i: int, x: np.ndarray, data: ResidualDataset) -> ResidualDataset:
    """Rows of an output over x (k,), the values of its feature i. All else, also what the prior mean and linear drag
    read beside the features, stands at its median in `data`; where the collective thrust is a feature, the rotors share
    it evenly."""
    rotors = [name for name in data.columns if name.startswith("u_")]
    medians = {name: np.median(data.columns[name]) for name in (*VELOCITY, *rotors) if name in data.columns}
    medians |= named(output.features, np.median(data.matrix(output.features), axis=0))
    columns = {name: np.full(len(x), value) for name, value in medians.items()}
    columns[output.features[i]] = x
    if THRUST in columns:
        each = columns[THRUST] / len(rotors)
        columns |= {name: each for name in rotors if name not in output.features}
    elif not rotors:
        columns[THRUST] = np.zeros(len(x))
    return ResidualDataset(columns | {"flight": np.zeros(len(x), int)}, {})


class Quantity(NamedTuple):
    """What a feature or output is."""

    name: str
    letter: str  # as mathematics
    unit: str


QUANTITIES = {  # by the first part of a column's name
    "v": Quantity("body velocity", "v", "m/s"),
    "w": Quantity("body rate", r"\omega", "rad/s"),
    "u": Quantity("rotor thrust", "u", "N"),
    "thrust": Quantity("collective thrust", "T", "N"),
    "a": Quantity("residual", "a", "m/s²"),
    "tau": Quantity("residual torque", r"\tau", "N m"),
}


def quantity(name: str) -> Quantity:
    """The quantity of a column."""
    first = name.partition("_")[0]
    return QUANTITIES.get(first, Quantity("", first, ""))


def symbol(name: str) -> str:
    """A column's name as mathematics: a_x -> $a_x$, thrust -> $T$."""
    index = name.partition("_")[2]
    letter = quantity(name).letter
    if index:
        return f"${letter}_{{{index}}}$"
    return f"${letter}$"


def axis_label(name: str) -> str:
    """What stands at an axis: quantity, symbol, unit."""
    return f"{quantity(name).name} {symbol(name)} ({quantity(name).unit})".strip()


def density(panel: Any, x: np.ndarray, y: np.ndarray, extent: Sequence[float], cells: tuple[int, int]) -> None:
    """How many data lie where, darker where denser. extent: (x low, x high, y low, y high). cells: across and up."""
    panel.hexbin(
        x, y, extent=tuple(extent), gridsize=cells, mincnt=1, cmap=COUNTS, norm=LogNorm(), linewidths=0.1, zorder=1
    )


@styled
def fit_figure(model: GaussianProcessModel, data: ResidualDataset) -> Figure:
    """Mean of each output over each of its features with the data, and below it the data minus mean, with 2 sigma.

    data: samples to show, best held-out ones. With several features, a panel moves one of them and holds
    the others at their medians; the data are moved by the model's difference (`moved`).
    """
    pairs = []
    for output in model.outputs:
        pairs += [(output, i) for i in range(len(output.features))]
    columns = min(len(pairs), MAX_COLUMNS)
    lines = math.ceil(len(pairs) / columns)
    figure = Figure(figsize=(3.3 * columns + 0.4, 4.6 * lines + 0.4))
    grid = figure.subplots(2 * lines, columns, squeeze=False, height_ratios=(1.7, 1) * lines)
    uppers = grid[0::2].flat
    lowers = grid[1::2].flat
    for upper, lower, (output, i) in zip(uppers, lowers, pairs, strict=False):
        _draw_fit(upper, lower, model, output, i, data)
    n = len(pairs)
    for panel in [*uppers[n:], *lowers[n:]]:
        panel.remove()
    _legend_above(figure)
    return figure


def _draw_fit(
    upper: Any, lower: Any, model: GaussianProcessModel, output: OutputPosterior, i: int, data: ResidualDataset
) -> None:
    """Mean and data over feature i; and the data minus mean, the 2-sigma band, the inducing points."""
    feature = output.features[i]
    values = data.matrix([feature])[:, 0]
    x, mean, std, line, medians = curve(model, output, i, data)
    target, remainder = moved(model, output, i, data)
    band = 2 * std
    ends = _limits(x, MARGIN_ALONG)
    inside = (values >= x[0]) & (values <= x[-1])  # beyond, the model extrapolates
    if not inside.any():
        inside[:] = True
    extremes = np.quantile(target[inside], [0.0005, 0.9995])
    top = _limits([*extremes, *mean])
    large = np.quantile(np.abs(remainder[inside]), 0.998)
    largest = max(large, 1.15 * np.median(band))
    bottom = _limits([-largest, largest])
    density(upper, values, target, (*ends, *top), (60, 36))
    upper.plot([], [], linestyle="none", marker="h", color="#6B7690", label="data, darker where denser")
    upper.fill_between(x, mean - band, mean + band, color=BLUE, alpha=0.25, linewidth=0, label="2 σ", zorder=2)
    upper.plot(x, mean, color=BLUE, linewidth=1.8, label="GP mean", zorder=4)
    if line is not None:
        upper.plot(x, line, color=ORANGE, linestyle=(0, (5, 2)), label="linear drag", zorder=3)
    upper.tick_params(labelbottom=False)
    upper.set(title=_fit_title(output, i, medians), ylabel=axis_label(output.output), xlim=ends, ylim=top)
    density(lower, values, remainder, (*ends, *bottom), (60, 20))
    lower.fill_between(x, -band, band, color=BLUE, alpha=0.25, linewidth=0, zorder=2)
    lower.axhline(0, color=BLUE, linewidth=1.4, zorder=3)
    inducing = output.inducing[:, i]
    shown = (inducing > ends[0]) & (inducing < ends[1])
    inducing = inducing[shown]
    lower.plot(
        inducing,
        np.full(len(inducing), bottom[0]),
        "k|",
        markersize=9,
        markeredgewidth=1.1,
        clip_on=False,
        zorder=5,
        label="inducing points",
    )
    lower.set(ylabel=f"data minus mean ({quantity(output.output).unit})", xlabel=axis_label(feature))
    lower.set(xlim=ends, ylim=bottom)
    mathematics(upper)
    mathematics(lower)


def _fit_title(output: OutputPosterior, i: int, medians: np.ndarray) -> str:
    """An output over its feature i, and at what the others are held, three in a line."""
    held = []
    for name, value in zip(output.features, medians, strict=True):
        if name != output.features[i]:
            held.append(f"{symbol(name)} = {round(value, 1) + 0.0:g} {quantity(name).unit}")
    title = f"{symbol(output.output)} over {symbol(output.features[i])}"
    lines = [f"{title}, at" if held else title]
    for k in range(0, len(held), 3):
        lines.append(", ".join(held[k : k + 3]))
    return "\n".join(lines)


def _limits(values: ArrayLike, margin: float = MARGIN) -> tuple[float, float]:
    """Limits around the values, with a little air, a share of their span."""
    low = float(np.min(values))
    high = float(np.max(values))
    air = margin * (high - low)
    return low - air, high + air


def _legend_above(figure: Figure) -> None:
    """One legend of all panels."""
    handles, labels = entries(figure.axes)
    figure.legend(handles, labels, loc="outside upper center", ncols=min(6, len(labels)))
