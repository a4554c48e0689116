"""Figures of what is learned: a fit of Gaussian processes, the identification of a vehicle, a validation.

Each function returns a matplotlib Figure; `quadexp.report.figures.save` writes it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.ticker import PercentFormatter
from msgspec.structs import replace

from quadexp.models.base import AXIS, Prediction
from quadexp.models.dataset import ResidualDataset
from quadexp.models.gaussian_process import GPModel, OutputPosterior
from quadexp.models.regression import half_width
from quadexp.models.residual import AXES, THRUST, VELOCITY
from quadexp.models.samples import SIGNALS, Samples
from quadexp.models.terms import TermMean, TermModel
from quadexp.models.thrust_curve import ThrustCurve, scaled_signal
from quadexp.models.validation import Residuals
from quadexp.models.vehicle_model import VehicleModel
from quadexp.physics.vehicle import GRAVITY
from quadexp.report.model_lines import MODES, NORMS, QUANTITIES, error_of, mean_of
from quadexp.report.panels import Mark, Panel, density, mark, panel_figure
from quadexp.report.style import BLUE, COLOURS, GREY, KNOWN, MARKERS, ORANGE, Figure, Look, looks

CURVE_POINTS = 300
MAX_COLUMNS = 4
BINS = 24
MOST_DOTS = 1500  # of a flight
QUANTITY = {  # first part of a feature's or output's name -> what it is, symbol, unit
    "v": ("body velocity", "v", "m/s"),
    "w": ("body rate", r"\omega", "rad/s"),
    "u": ("rotor thrust", "u", "N"),
    "thrust": ("collective thrust", "T", "N"),
    "a": ("residual", "a", "m/s²"),
    "tau": ("residual torque", r"\tau", "N m"),
}
LEVEL_COLOURS = {
    "nominal": KNOWN["nominal"][0],
    "offset": "#B5BAC2",
    "linear": ORANGE,
    "quadratic": KNOWN["quadratic drag"][0],
    "blade_element": KNOWN["blade element"][0],
    "blade_element_still": "#7F8C99",
}


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


def fit_figure(model: GPModel, data: ResidualDataset) -> Figure:
    """Mean of each output over each of its features with the data, and below it the data minus mean, with 2 sigma.

    data: samples to show, best held-out ones. With several features, a panel moves one of them and holds
    the others at their medians; the data are moved by the model's difference (`moved`).
    """
    pairs = [_fit_panels(model, output, i, data) for output in model.outputs for i in range(len(output.features))]
    columns = min(len(pairs), MAX_COLUMNS)
    rows: list[list[Panel | None]] = []
    for start in range(0, len(pairs), columns):
        for panels in zip(*pairs[start : start + columns], strict=True):
            rows.append([*panels, *[None] * (columns - len(panels))])
    size = 3.3 * columns + 0.4, 2.3 * len(rows) + 0.4
    return panel_figure(rows, size, legend=True, height_ratios=(1.7, 1) * (len(rows) // 2))


def _fit_panels(model: GPModel, output: OutputPosterior, i: int, data: ResidualDataset) -> tuple[Panel, Panel]:
    """Mean and data over feature i; and the data minus mean, the 2-sigma band, the inducing points."""
    features = data.matrix(output.features)
    x, mean, std, line, median = curve(model, output, i, data)
    target, remainder = moved(model, output, i, data)
    band, low, high = 2 * std, x[0], x[-1]
    ends = low - 0.03 * (high - low), high + 0.03 * (high - low)
    inside = (features[:, i] >= low) & (features[:, i] <= high)  # beyond, the model extrapolates
    if not inside.any():
        inside[:] = True
    top = _limits(np.concatenate([np.quantile(target[inside], [0.0005, 0.9995]), mean]))
    bottom = _limits(np.array([-1, 1]) * max(np.quantile(np.abs(remainder[inside]), 0.998), 1.15 * np.median(band)))
    points = output.inducing[:, i]
    points = points[(points > ends[0]) & (points < ends[1])]
    others = [
        f"{symbol(name)} = {round(value, 1) + 0.0:g} {unit(name)}"
        for j, (name, value) in enumerate(zip(output.features, median, strict=True))
        if j != i
    ]
    lines = [f"{symbol(output.output)} over {symbol(output.features[i])}" + (", at" if others else "")]
    lines += [", ".join(others[j : j + 3]) for j in range(0, len(others), 3)]
    upper = [
        density(features[:, i], target, (*ends, *top), (60, 36)),
        mark("plot", [], [], linestyle="none", marker="h", color="#6B7690", label="data, darker where denser"),
        mark("fill_between", x, mean - band, mean + band, color=BLUE, alpha=0.25, linewidth=0, label="2 σ", zorder=2),
        mark("plot", x, mean, color=BLUE, linewidth=1.8, label="GP mean", zorder=4),
    ]
    if line is not None:
        upper.append(mark("plot", x, line, color=ORANGE, linestyle=(0, (5, 2)), label="linear drag", zorder=3))
    upper.append(mark("tick_params", labelbottom=False))
    lower = [
        density(features[:, i], remainder, (*ends, *bottom), (60, 20)),
        mark("fill_between", x, -band, band, color=BLUE, alpha=0.25, linewidth=0, zorder=2),
        mark("axhline", 0, color=BLUE, linewidth=1.4, zorder=3),
        mark("plot", points, np.full(len(points), bottom[0]), linestyle="none", marker="|", markersize=9,
             markeredgewidth=1.1, color="black", clip_on=False, zorder=5, label="inducing points"),
    ]  # fmt: skip
    above = {"title": "\n".join(lines), "ylabel": axis_label(output.output), "xlim": ends, "ylim": top}
    beside = f"data minus mean ({unit(output.output)})"
    below = {"ylabel": beside, "xlabel": axis_label(output.features[i]), "xlim": ends, "ylim": bottom}
    return Panel(upper, above, math=True), Panel(lower, below, math=True)


def _limits(values: np.ndarray) -> tuple[float, float]:
    """Vertical limits around the values, with a little air."""
    low, high = float(np.min(values)), float(np.max(values))
    return low - 0.06 * (high - low), high + 0.06 * (high - low)


def calibration_figure(model: GPModel, data: ResidualDataset) -> Figure:
    """Share of held-out samples inside the central interval against the probability the model gives that interval."""
    from scipy.special import ndtr

    inside = {sigma: 2 * ndtr(sigma) - 1 for sigma in (1, 2)}
    marks = [mark("plot", [0, 1], [0, 1], color=GREY, linewidth=1, linestyle=(0, (4, 3)))]
    for x, y, text, side in ((0.97, 0.04, "overconfident", "right"), (0.03, 0.96, "too careful", "left")):
        marks.append(mark("text", x, y, text, ha=side, va="center", color=GREY, fontsize=8.5))
    for k, (name, prediction) in enumerate(model.predict(data).items()):
        error = np.abs(data.matrix([name])[:, 0] - prediction.mean) / prediction.std
        probability = np.sort(2 * ndtr(error) - 1)
        look = {"color": COLOURS[(k + 1) % len(COLOURS)], "label": symbol(name)}
        at = [max(int(np.searchsorted(probability, share)) - 1, 0) for share in inside.values()]
        dots = {"marker": MARKERS[k], "markersize": 5, "markevery": at}
        marks.append(mark("plot", probability, np.arange(1, len(error) + 1) / len(error), **look, **dots))
    for sigma, at in inside.items():
        marks.append(mark("axvline", at, color="#BBBBBB", linewidth=0.8, zorder=0))
        marks.append(mark("text", at, 1.01, f"{sigma} σ", ha="center", va="bottom", fontsize=8.5, color="#444444"))
    words = {"xlabel": "predicted probability of the central interval", "ylabel": "held-out samples inside"}
    legend = {"loc": "center right", "bbox_to_anchor": (0.94, 0.27)}
    figure = panel_figure(
        [[Panel(marks, {**words, "xlim": (0, 1), "ylim": (0, 1), "aspect": "equal"}, legend, math=True)]], (4.4, 4.2)
    )
    for axis in (figure.axes[0].xaxis, figure.axes[0].yaxis):
        axis.set_major_formatter(PercentFormatter(1.0))
    return figure


def identification_figures(model: VehicleModel, samples: Samples, report: Mapping[str, Any]) -> dict[str, Figure]:
    """Every figure of an identification by name."""
    return {
        "thrust": thrust_figure(model.thrust, samples),
        "drag": drag_figure(model, samples),
        "models": models_figure(report["selection"]),
    }


def thrust_figure(curve: ThrustCurve, samples: Samples) -> Figure:
    """Specific force along z over the mean signal of the rotors with the curve, and what that leaves, by flight."""
    scaled = scaled_signal(samples.signal, samples.voltage, curve.reference_voltage, curve.voltage_exponent)
    mean = scaled.mean(axis=1)
    grid = np.linspace(mean.min(), mean.max(), 100)
    plain = samples.signal.shape[1] if curve.signal != "thrust_acceleration" else 1
    total = curve.of_signal(np.repeat(grid[:, None], plain, axis=1), np.full(100, curve.reference_voltage)).sum(axis=1)
    residual = samples.force[:, 2] - curve.of_signal(samples.signal, samples.voltage).sum(axis=1)
    dots, bands = [], [mark("axhline", 0, color="#000000", linewidth=0.8)]
    for i, name in enumerate(samples.names):
        own = np.flatnonzero(samples.flight == i)
        thin = own[:: max(1, len(own) // MOST_DOTS)]
        colour = COLOURS[(i + 1) % len(COLOURS)]
        few = {"markersize": 1.5, "alpha": 0.5, "rasterized": True}
        dots.append(mark("plot", mean[thin], samples.force[thin, 2], ".", color=colour, **few))
        centre, low, high = _binned(mean[own], residual[own])
        bands.append(mark("fill_between", centre, low, high, color=colour, alpha=0.2, linewidth=0))
        bands.append(mark("plot", centre, (low + high) / 2, color=colour, label=name))
    dots.append(mark("plot", grid, total, color="#000000", label="thrust curve"))
    units = SIGNALS[curve.signal]
    label = f"{curve.signal.replace('_', ' ')}, mean of the rotors" + (f" ({units})" if units != "1" else "")
    if curve.reference_voltage:
        power = "" if curve.voltage_exponent == 1 else f"^{curve.voltage_exponent:.3g}"
        label += f", times (V / {curve.reference_voltage:g} V){power}"
    force = {"xlabel": label, "ylabel": "specific force along z (m/s²)", "title": "thrust curve"}
    beyond = {"xlabel": label, "ylabel": "specific force minus curve (m/s²)", "title": "residual: mean ± 1 std in bins"}
    return panel_figure([[Panel(dots, force, {}), Panel(bands, beyond, {"fontsize": 7})]], (9.0, 3.6))


def _binned(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres, mean - std and mean + std of y in bins of equal count over x."""
    edges = np.quantile(x, np.linspace(0, 1, BINS + 1))
    index = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, BINS - 1)
    bins = [index == b for b in range(BINS) if (index == b).any()]
    centre, mean, std = (
        np.array([of(values[own]) for own in bins]) for of, values in ((np.mean, x), (np.mean, y), (np.std, y))
    )
    return centre, mean - std, mean + std


def drag_figure(model: VehicleModel, samples: Samples) -> Figure:
    """Specific force beyond the thrust over body velocity, axis by axis, with the fitted drag."""
    rotors = model.thrust.of_signal(samples.signal, samples.voltage)
    target = samples.force - rotors.sum(axis=1)[:, None] * [0, 0, 1]
    usual = np.tile(np.median(rotors, axis=0), (100, 1))
    fitted: list[tuple[TermModel, str, str]] = [(model.linear, ORANGE, "-")]
    fitted += [(model.quadratic, LEVEL_COLOURS["quadratic"], "--")] if model.quadratic is not None else []
    panels = []
    for i, axis in enumerate(AXES):
        v, a = samples.velocity[:, i], target[:, i]
        low, high = np.quantile(a, [0.002, 0.998])
        limits = low - 0.15 * (high - low), high + 0.15 * (high - low)
        grid = np.zeros((100, 3))
        grid[:, i] = np.linspace(v.min(), v.max(), 100)
        marks = [density(v, a, (v.min(), v.max(), *limits), (50, 30))]
        for terms, colour, dash in fitted:
            line = terms.acceleration(grid, usual)[:, i]
            marks.append(mark("plot", grid[:, i], line, color=colour, linestyle=dash, label=terms.kind))
        value, error = model.linear.coefficient(axis, "linear")
        half = half_width(error, model.linear.freedom[i])
        words = {
            "title": f"$d_{axis}$ = {value:.3f} ± {half:.3f} 1/s",
            "xlabel": f"$v_{axis}$ relative to the air (m/s)",
            "ylabel": f"$a_{axis}$ beyond the thrust (m/s²)",
        }
        panels.append(Panel(marks, {**words, "ylim": limits}, None if i else {}, math=True))
    return panel_figure([panels], (9.6, 3.4))


def models_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """RMSE of every model in sample and on flights left out, axis by axis."""
    rows = [row for row in rows if row["in_sample"]]
    width = 0.8 / max(len(rows), 1)
    places = {"xticks": range(len(NORMS)), "xticklabels": ["$a_x$", "$a_y$", "$a_z$", "vector"]}
    panels = []
    for part, title in (("in_sample", "in sample"), ("held_out", "flights left out")):
        marks = []
        for k, row in enumerate(rows):
            at = np.arange(len(NORMS)) + (k - (len(rows) - 1) / 2) * width
            look = {"color": LEVEL_COLOURS[row["level"]], "label": row["name"]}
            marks += [mark("bar", at, [row[part][name] for name in NORMS], width * 0.9, **look)] if row[part] else []
        if not marks:
            marks = [mark("text", 1.5, 0, "one flight: nothing left out", ha="center", va="bottom")]
        panels.append(Panel(marks, {**places, "title": title}, math=True))
    panels[0] = Panel(
        panels[0].marks, {**panels[0].axes, "ylabel": "RMSE of the specific force (m/s²)"}, {"fontsize": 8}, math=True
    )
    return panel_figure([panels], (9.0, 3.4), sharey=True)


def validation_figures(report: Mapping[str, Any], found: Sequence[Residuals]) -> dict[str, Figure]:
    """Every figure of a validation by name. found: the residuals of each predictor, as fitted and with the thrust scale
    tracked."""
    return {
        "residuals": residual_figure(report["rows"]),
        "speed": band_figure(report["bands"]),
        "rollouts": rollout_figure(report["rollouts"]),
        "thrust_scale": scale_figure(found, report["flights"]),
    }


def residual_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """RMS of the vector with its interval, a bar per predictor: as fitted, and with the thrust scale tracked."""
    names = list(dict.fromkeys(row["predictor"] for row in rows))
    marks = []
    for tracked, colour, label in ((False, COLOURS[1], "as fitted"), (True, COLOURS[2], "thrust scale tracked")):
        by_name = {row["predictor"]: row for row in rows if row["thrust_tracked"] == tracked}
        rms, low, high = ([by_name[name][key] for name in names] for key in ("rms", "rms_low", "rms_high"))
        reach = np.maximum([np.subtract(rms, low), np.subtract(high, rms)], 0)
        at = np.arange(len(names)) + (0.2 if tracked else -0.2)
        marks.append(mark("barh", at, rms, 0.36, xerr=reach, color=colour, label=label, ecolor="#444444"))
    axes = {"xlabel": "residual of the specific force, RMS (m/s²)", "yticks": range(len(names)), "yticklabels": names}
    panel = Panel(marks, {**axes, "ylim": (len(names) - 0.4, -0.6)}, {})
    return panel_figure([[panel]], (6.4, 0.9 + 0.5 * len(names)))


def band_figure(bands: Sequence[Mapping[str, Any]]) -> Figure:
    """RMS of the vector over speed, as fitted (left) and with the thrust scale tracked (right)."""
    look = looks([row["predictor"] for row in bands])
    panels = []
    for key, title in (("rms", "as fitted"), ("rms_tracked", "thrust scale tracked")):
        points = [(row["predictor"], (row["low"] + row["high"]) / 2, row[key]) for row in bands]
        words = {"title": title, "xlabel": "speed (m/s)", "ylabel": "residual, RMS (m/s²)"}
        panels.append(Panel(_curves(points, look), {**words, "ylim": (0, None)}))
    return panel_figure([panels], (7.6, 3.4), legend=True, sharey=True)


def rollout_figure(rollouts: Sequence[Mapping[str, Any]]) -> Figure:
    """Open-loop errors over the horizon with the thrust scale tracked: a row per mode, a column per quantity.

    Modes with all 13 states have errors of attitude and rate too.
    """
    rows = [row for row in rollouts if row["thrust_tracked"]]
    modes = [mode for mode in MODES if any(row["mode"] == mode for row in rows)]
    quantities = [name for name in QUANTITIES if any(name in row for row in rows)]
    look = looks([row["predictor"] for row in rows])

    def panel(mode: str, quantity: str) -> Panel | None:
        own = sorted((row for row in rows if row["mode"] == mode and quantity in row), key=lambda row: row["horizon"])
        points = [(row["predictor"], row["horizon"], error_of(row, quantity)) for row in own]
        label = f"{quantity} error, {mean_of(mode)} ({QUANTITIES[quantity][0]})"
        words = {"title": MODES[mode][0], "xlabel": "horizon (s)", "ylabel": label}
        return Panel(_curves(points, look), {**words, "xlim": (0, None), "ylim": (0, None)}) if points else None

    size = 0.6 + 3.1 * len(quantities), 0.5 + 2.5 * len(modes)
    return panel_figure([[panel(mode, name) for name in quantities] for mode in modes], size, legend=True)


def _curves(points: Sequence[tuple[str, float, float]], look: Mapping[str, Look]) -> list[Mark]:
    """A line with markers for each predictor. points: predictor, x, y."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for name, x, y in points:
        curves.setdefault(name, []).append((x, y))
    return [
        mark("plot", *zip(*curve, strict=True), label=name, **look[name].points()) for name, curve in curves.items()
    ]


def scale_figure(found: Sequence[Residuals], flights: Sequence[str]) -> Figure:
    """The tracked scale of the thrust over each flight, by the predictor with the least residual."""
    best = min(found, key=lambda residuals: float(np.mean(residuals.tracked**2)))
    marks = [mark("axhline", 1, color=GREY, linewidth=1)]
    for k, index in enumerate(np.unique(best.flight)):
        scale = best.scale[best.flight == index]
        label = flights[int(index)] if int(index) < len(flights) else str(index)
        look = {"color": COLOURS[k % len(COLOURS)], "label": label}
        marks.append(mark("plot", np.linspace(0, 1, len(scale)), scale, **look))
    words = {"xlabel": "share of the flight", "ylabel": "thrust over thrust curve"}
    return panel_figure([[Panel(marks, {**words, "title": f"tracked beside {best.predictor}"}, {})]], (6.4, 3.0))
