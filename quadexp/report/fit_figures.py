"""Figures of a fit: mean and 2-sigma band against held-out data, and calibration.

Each function returns a matplotlib Figure and changes no global state; `quadexp.report.figures.save` writes it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.ticker import PercentFormatter
from msgspec.structs import replace

from quadexp.models.base import AXIS, Prediction
from quadexp.models.dataset import ResidualDataset
from quadexp.models.gaussian_process import GPModel, OutputPosterior
from quadexp.models.residual import THRUST, VELOCITY
from quadexp.models.terms import TermMean
from quadexp.physics.vehicle import GRAVITY
from quadexp.report.style import BLUE, COLOURS, COUNTS, GREY, MARKERS, ORANGE, Figure, entries, styled

CURVE_POINTS = 300
MAX_COLUMNS = 4


@styled
def fit_figure(model: GPModel, data: ResidualDataset) -> Figure:
    """Mean of each output over each of its features with the data, and below it the data minus mean, with 2 sigma.

    data: samples to show, best held-out ones. With several features, a panel moves one of them and holds
    the others at their medians; the data are moved by the model's difference (`moved`).
    """
    shown = [(output, i) for output in model.outputs for i in range(len(output.features))]
    columns = min(len(shown), MAX_COLUMNS)
    blocks = -(-len(shown) // columns)
    figure = Figure(figsize=(3.3 * columns + 0.4, 4.6 * blocks + 0.4), layout="constrained")
    panels = figure.subplots(2 * blocks, columns, squeeze=False, height_ratios=(1.7, 1) * blocks)
    for k, (output, i) in enumerate(shown):
        row, column = divmod(k, columns)
        _fit_panels(panels[2 * row, column], panels[2 * row + 1, column], model, output, i, data)
    for k in range(len(shown), blocks * columns):
        for row in (0, 1):
            panels[2 * (k // columns) + row, k % columns].set_axis_off()
    handles, labels = entries(panels.flat)
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure


class Curve(NamedTuple):
    """A model of one output over one feature x, (k,). line: linear drag, None for torques. middle: of all features."""

    x: np.ndarray
    mean: np.ndarray
    std: np.ndarray
    line: np.ndarray | None
    middle: np.ndarray


def curve(
    model: GPModel, output: OutputPosterior, i: int, data: ResidualDataset | None, count: int = CURVE_POINTS
) -> Curve:
    """The model over feature i within its data, all else at the medians of `data`; None: of the inducing points."""
    points = output.inducing if data is None else data.matrix(output.features)
    middle = np.median(points, axis=0)
    low, high = model.feature_range.get(output.features[i], [points[:, i].min(), points[:, i].max()])
    features = np.tile(middle, (count, 1))
    features[:, i] = np.linspace(low, high, count)
    rows = _rows(model, output, features, data)
    prediction = _predict(model, output, rows)
    line = model.linear_drag.acceleration(rows)[:, AXIS[output.output]] if output.output in AXIS else None
    return Curve(features[:, i], prediction.mean, prediction.std, line, middle)


def moved(model: GPModel, output: OutputPosterior, i: int, data: ResidualDataset) -> tuple[np.ndarray, np.ndarray]:
    """The output's values in `data`, (n,), moved by the model's difference between their rows and the same feature i
    with all else at its median; and values minus mean."""
    features = data.matrix(output.features)
    held = np.tile(np.median(features, axis=0), (len(features), 1))
    held[:, i] = features[:, i]
    remainder = data.matrix([output.output])[:, 0] - _predict(model, output, data).mean
    return _predict(model, output, _rows(model, output, held, data)).mean + remainder, remainder


def _fit_panels(upper: Any, lower: Any, model: GPModel, output: OutputPosterior, i: int, data: ResidualDataset) -> None:
    """upper: mean and data over feature i. lower: data minus mean, the 2-sigma band, the inducing points."""
    features = data.matrix(output.features)
    x, mean, std, line, median = curve(model, output, i, data)
    target, remainder = moved(model, output, i, data)
    band, low, high = 2 * std, x[0], x[-1]
    margin = 0.03 * (high - low)
    inside = (features[:, i] >= low) & (features[:, i] <= high)  # beyond, the model extrapolates
    if not inside.any():
        inside[:] = True
    top = _limits(np.concatenate([np.quantile(target[inside], [0.0005, 0.9995]), mean]))
    bottom = _limits(np.array([-1, 1]) * max(np.quantile(np.abs(remainder[inside]), 0.998), 1.15 * np.median(band)))
    for panel, values, limits, size in ((upper, target, top, (60, 36)), (lower, remainder, bottom, (60, 20))):
        panel.hexbin(
            features[:, i], values, gridsize=size, mincnt=1, cmap=COUNTS, norm=LogNorm(), linewidths=0.1,
            extent=(low - margin, high + margin, *limits), zorder=1,
        )  # fmt: skip
        panel.set_xlim(low - margin, high + margin)
        panel.set_ylim(*limits)
    upper.plot([], [], linestyle="none", marker="h", color="#6B7690", label="data, darker where denser")
    upper.fill_between(x, mean - band, mean + band, color=BLUE, alpha=0.25, linewidth=0, label="2 σ", zorder=2)
    upper.plot(x, mean, color=BLUE, linewidth=1.8, label="GP mean", zorder=4)
    if line is not None:
        upper.plot(x, line, color=ORANGE, linestyle=(0, (5, 2)), label="linear drag", zorder=3)
    lower.fill_between(x, -band, band, color=BLUE, alpha=0.25, linewidth=0, zorder=2)
    lower.axhline(0, color=BLUE, linewidth=1.4, zorder=3)
    points = output.inducing[:, i]
    points = points[(points > low - margin) & (points < high + margin)]
    lower.plot(
        points, np.zeros(len(points)), linestyle="none", marker="|", markersize=9, markeredgewidth=1.1, color="black",
        transform=lower.get_xaxis_transform(), clip_on=False, zorder=5, label="inducing points",
    )  # fmt: skip
    others = [
        f"{symbol(name)} = {round(value, 1) + 0.0:g} {unit(name)}"
        for j, (name, value) in enumerate(zip(output.features, median, strict=True))
        if j != i
    ]
    heading = f"{symbol(output.output)} over {symbol(output.features[i])}"
    lines = [", ".join(others[j : j + 3]) for j in range(0, len(others), 3)]
    upper.set_title(
        "\n".join([heading + (", at" if others else ""), *lines]), fontweight="normal", fontsize=9, parse_math=True
    )
    upper.tick_params(labelbottom=False)
    upper.set_ylabel(axis_label(output.output), parse_math=True)
    lower.set_ylabel(f"data minus mean ({unit(output.output)})")
    lower.set_xlabel(axis_label(output.features[i]), parse_math=True)


@styled
def calibration_figure(model: GPModel, data: ResidualDataset) -> Figure:
    """Share of held-out samples inside the central interval against the probability the model gives that interval."""
    from scipy.special import ndtr

    figure = Figure(figsize=(4.4, 4.2), layout="constrained")
    panel = figure.subplots()
    panel.plot([0, 1], [0, 1], color=GREY, linewidth=1, linestyle=(0, (4, 3)))
    panel.text(0.97, 0.04, "overconfident", ha="right", va="center", color=GREY, fontsize=8.5)
    panel.text(0.03, 0.96, "too careful", ha="left", va="center", color=GREY, fontsize=8.5)
    for k, (name, prediction) in enumerate(model.predict(data).items()):
        error = np.abs(data.matrix([name])[:, 0] - prediction.mean) / prediction.std
        probability = np.sort(2 * ndtr(error) - 1)
        share = np.arange(1, len(probability) + 1) / len(probability)
        colour = COLOURS[(k + 1) % len(COLOURS)]
        panel.plot(probability, share, color=colour)
        for sigma in (1, 2):
            at = 2 * ndtr(sigma) - 1
            panel.plot(at, np.mean(error < sigma), color=colour, marker=MARKERS[k], markersize=5, linestyle="none")
        panel.plot([], [], color=colour, marker=MARKERS[k], markersize=5, label=symbol(name))
    for sigma in (1, 2):
        panel.axvline(2 * ndtr(sigma) - 1, color="#BBBBBB", linewidth=0.8, zorder=0)
        panel.text(
            2 * ndtr(sigma) - 1, 1.01, f"{sigma} σ", ha="center", va="bottom", fontsize=8.5, color="#444444",
            transform=panel.get_xaxis_transform(),
        )  # fmt: skip
    panel.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    panel.set_xlabel("predicted probability of the central interval")
    panel.set_ylabel("held-out samples inside")
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_formatter(PercentFormatter(1.0))
    for text in panel.legend(loc="center right", bbox_to_anchor=(0.94, 0.27)).get_texts():
        text.set_parse_math(True)
    return figure


def symbol(name: str) -> str:
    """A column's name as mathematics: a_x -> $a_x$, thrust -> $T$."""
    letter, _, index = name.partition("_")
    letter = {"thrust": "T", "tau": r"\tau", "w": r"\omega"}.get(letter, letter)
    return f"${letter}_{{{index}}}$" if index else f"${letter}$"


def unit(name: str) -> str:
    """Unit of a feature or output."""
    return {"v": "m/s", "w": "rad/s", "u": "N", "thrust": "N", "a": "m/s²", "tau": "N m"}.get(
        name.split("_", maxsplit=1)[0], ""
    )


def axis_label(name: str) -> str:
    """What stands at an axis: quantity, symbol, unit."""
    words = {
        "v": "body velocity", "w": "body rate", "u": "rotor thrust", "thrust": "collective thrust",
        "a": "residual", "tau": "residual torque",
    }  # fmt: skip
    return f"{words.get(name.split('_', maxsplit=1)[0], '')} {symbol(name)} ({unit(name)})".strip()


def _limits(values: np.ndarray) -> tuple[float, float]:
    """Vertical limits around the values, with a little air."""
    low, high = float(np.min(values)), float(np.max(values))
    return low - 0.06 * (high - low), high + 0.06 * (high - low)


def _predict(model: GPModel, output: OutputPosterior, rows: ResidualDataset) -> Prediction:
    """Prediction of one output, prior mean included."""
    return replace(model, outputs=(output,)).predict(rows)[output.output]


def _rows(
    model: GPModel, output: OutputPosterior, features: np.ndarray, data: ResidualDataset | None
) -> ResidualDataset:
    """Rows with the given features (k, d). What the prior mean and linear drag read beside them stands at its median
    in `data`, without data at hover; where the collective thrust is a feature, the rotors share it evenly."""
    if data is not None:
        rotors = [name for name in data.columns if name.startswith("u_")]
        beside = {name: float(np.median(data.columns[name])) for name in (*VELOCITY, *rotors) if name in data.columns}
    else:
        rotors, beside = [], dict.fromkeys(VELOCITY, 0.0)
        if isinstance(model.mean, TermMean):
            rotors = [f"u_{j}" for j in range(model.mean.model.rotors)]
            beside |= dict.fromkeys(rotors, model.mean.mass * GRAVITY / len(rotors))
    columns = {name: np.full(len(features), value) for name, value in beside.items()}
    columns |= {name: features[:, j] for j, name in enumerate(output.features)}
    if THRUST in columns:
        columns |= {name: columns[THRUST] / len(rotors) for name in rotors if name not in output.features}
    elif not rotors:
        columns[THRUST] = np.zeros(len(features))
    return ResidualDataset(columns | {"flight": np.zeros(len(features), int)}, {})
