"""The panels of the report, drawn on given axes: error over speed, error over time of the control step, learned models.

Learned models: the residual models of the checkpoints that flew, and the coefficients identified in flight. Every
function takes a Palette, so that the same panel is used on the page (themed) and on paper (PDF).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import FuncFormatter

from quadexp.errors import DataError, UsageError
from quadexp.learn.checkpoint import MODEL_FILE, load_model, load_report
from quadexp.learn.dataset import ResidualDataset, read_dataset
from quadexp.learn.gaussian_process import GPModel, OutputPosterior
from quadexp.log.schema import ESTIMATE_COLUMNS, Flight, describe
from quadexp.report.fit_figures import axis_label, curve, moved, symbol, unit
from quadexp.report.page.palette import Palette, dress
from quadexp.report.page.source import Comparison, spoken
from quadexp.report.pairing import Condition
from quadexp.report.statistics import Statistic
from quadexp.report.style import LOOKS, Look, plain_log
from quadexp.report.tables import TITLES
from quadexp.report.text import duration, shown, typeset

AROUND = 2.5  # times that an interval may reach beyond the means before the panel cuts it
Course = tuple[str, str, str, str]  # plant, vehicle, trajectory, other settings
CURVE_POINTS = 120
DOTS = 400  # of the data set behind a curve
COEFFICIENTS = [name for name in ESTIMATE_COLUMNS if name.startswith("C_")]
SYMBOLS = {"C_d0": "$C_{d0}$", "C_la": "$C_{l\\alpha}$"} | {f"C_D{i}": f"$C_{{D{i}}}$" for i in "xyz"}
TRUTH = {"C_d0": ("profile_drag", None), "C_la": ("lift_slope", None)} | {
    f"C_D{axis}": ("body_drag", i) for i, axis in enumerate("xyz")
}


def course_of(condition: Condition) -> Course:
    """A condition without its speed."""
    plant, vehicle, trajectory, _, setting = condition
    return plant, vehicle, trajectory, setting


def _points(comparison: Comparison) -> list[Statistic]:
    """The statistics of the main metric that have a speed and a mean over common flights."""
    return [s for s in comparison.select(comparison.metric) if s.common and not math.isnan(s.speed)]


def courses(comparison: Comparison) -> list[Course]:
    """Courses with at least one mean over common flights at one speed or more."""
    return list(dict.fromkeys(course_of(s.condition) for s in _points(comparison)))


def course_title(comparison: Comparison, course: Course) -> str:
    """The trajectory, with settings, plant and vehicle as far as they distinguish it from the others."""
    plant, vehicle, trajectory, setting = course
    worlds = comparison.worlds
    parts = [comparison.courses[trajectory, setting]]
    parts += [plant] if len({w[0] for w in worlds}) > 1 else []
    parts += [vehicle] if len({w[1] for w in worlds}) > 1 else []
    return ", ".join(parts)


def _on(comparison: Comparison, course: Course) -> list[Statistic]:
    return [s for s in _points(comparison) if course_of(s.condition) == course]


def labels_on(comparison: Comparison, course: Course) -> list[str]:
    """Labels with a point on a course, in the order of the page."""
    flown = {comparison.labels[s.contestant] for s in _on(comparison, course)}
    return [label for label in comparison.look if label in flown]


def error_limits(comparison: Comparison) -> tuple[float, float]:
    """Vertical limits of all panels of error over speed, in the printed unit."""
    factor, _ = shown(comparison.metric)
    chosen = _points(comparison)
    means = [factor * s.common_mean for s in chosen if s.common_mean > 0]
    if not means:
        return 0.1, 10.0
    ends = [factor * v for s in chosen for v in (s.common_low, s.common_high) if math.isfinite(v) and v > 0]
    low, high = min([*means, *ends]), max([*means, *ends])
    return max(low / 1.35, min(means) / AROUND), min(high * 1.35, max(means) * AROUND)


def speed_panel(panel: Any, comparison: Comparison, course: Course, palette: Palette) -> None:
    """Mean error over nominal speed with its interval, a line per contestant, over the common flights.

    Points of one speed are set apart a little, so that their intervals do not overlap.
    """
    factor, unit = shown(comparison.metric)
    chosen = _on(comparison, course)
    labels = labels_on(comparison, course)
    speeds = sorted({s.speed for s in chosen})
    apart = 0.012 * ((speeds[-1] - speeds[0]) or 1.0)
    for k, label in enumerate(labels):
        mine = sorted((s for s in chosen if comparison.labels[s.contestant] == label), key=lambda s: s.speed)
        look = comparison.look[label]
        colour = palette.series[look.token]
        x = np.array([s.speed for s in mine]) + apart * (k - (len(labels) - 1) / 2)
        mean, low, high = (
            factor * np.array([getattr(s, f"common_{name}") for s in mine]) for name in ("mean", "low", "high")
        )
        known = np.isfinite(low) & np.isfinite(high)
        panel.vlines(x[known], np.maximum(low[known], 1e-9), high[known], color=colour, linewidth=3.2, alpha=0.35)
        panel.plot(x, mean, linestyle=look.dash, label=label, zorder=3, **palette.mark(look))
    panel.set_yscale("log")
    panel.set_ylim(*error_limits(comparison))
    panel.set_xticks(speeds)
    room = max(6.0, len(labels) / 2 + 1) * apart
    panel.set_xlim(speeds[0] - room, speeds[-1] + room)
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    plain_log(panel.yaxis)
    panel.set_xlabel("trajectory.speed (m/s)")
    panel.set_ylabel(f"{TITLES[comparison.metric]} ({unit})")
    panel.set_title(course_title(comparison, course), color=palette.ink)
    dress(panel, palette)


def pareto_points(comparison: Comparison) -> dict[str, tuple[float, float, float, float]]:
    """Label -> (time of the step, s; error, its low, its high) of all with a flight that ended well.

    The error is in percent of the baseline's over all conditions; without a baseline the geometric mean in the printed
    unit (without an interval).
    """
    points = {}
    factor, _ = shown(comparison.metric)
    for label in comparison.order:
        time, one = comparison.time(label), comparison.overall.get(label)
        if not math.isfinite(time):
            continue
        if comparison.reference is None:
            points[label] = (time, factor * comparison.geometric_mean(label), math.nan, math.nan)
        elif label == comparison.reference:
            points[label] = (time, 100.0, math.nan, math.nan)
        elif one is not None and math.isfinite(one.reduction):
            points[label] = (time, 100 - one.reduction, 100 - one.reduction_high, 100 - one.reduction_low)
    return points


def pareto_front(points: dict[str, tuple[float, float, float, float]], bounds: Sequence[str] = ()) -> list[str]:
    """Labels for which no other is better in both time and error, by time. bounds: labels to leave out."""
    rivals = {label: point for label, point in points.items() if label not in bounds}
    front = [
        label
        for label, (time, error, *_) in rivals.items()
        if not any(t <= time and e <= error and (t, e) != (time, error) for t, e, *_ in rivals.values())
    ]
    return sorted(front, key=lambda label: points[label][0])


def pareto_panel(panel: Any, comparison: Comparison, palette: Palette) -> None:
    """Error against the time of one control step, both logarithmic; the front joined, the deadline marked.

    A point: median time; the whisker to the right: 99th percentile; the vertical bar: interval of the error.
    """
    points = pareto_points(comparison)
    front = pareto_front(points, comparison.bounds)
    tails = {label: comparison.time(label, "p99") for label in points}
    corners = [points[label][:2] for label in front]
    stairs = [(t, e) for (t0, e0), (t1, _) in zip(corners, corners[1:], strict=False) for t, e in ((t0, e0), (t1, e0))]
    path = np.array([*stairs, *corners[-1:]])
    if len(front) > 1:
        panel.plot(1e6 * path[:, 0], path[:, 1], color=palette.accent, linewidth=1.1, alpha=0.6, zorder=1)
    for label, (time, error, low, high) in points.items():
        look, colour = comparison.look[label], palette.series[comparison.look[label].token]
        faded = 1.0 if label in front else 0.75
        if math.isfinite(low):
            panel.vlines(1e6 * time, max(low, 1e-6), high, color=colour, linewidth=3.2, alpha=0.35)
        panel.hlines(error, 1e6 * time, 1e6 * max(tails[label], time), color=colour, linewidth=1.0, alpha=0.55)
        panel.plot(1e6 * time, error, markersize=8, alpha=faded, zorder=4, linestyle="none", **palette.mark(look))
    periods = [p for label in points if math.isfinite(p := comparison.period(label))]
    times = [1e6 * t for t in (*(p[0] for p in points.values()), *tails.values(), *periods)]
    errors = [v for p in points.values() for v in p[1:] if math.isfinite(v) and v > 0]
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.set_xlim(min(times) / 1.5, max(times) * 1.9)
    panel.set_ylim(min(errors) / 2.2, max(errors) * 2.2)
    if periods:
        deadline = 1e6 * min(periods)
        panel.axvspan(deadline, panel.get_xlim()[1], color=palette.alarm, alpha=0.08, linewidth=0)
        panel.axvline(deadline, color=palette.alarm, linewidth=1.0)
        panel.annotate(
            f"next command due, {typeset(duration(min(periods), exact=True))}", (deadline, 0.03), (-4, 0),
            xycoords=("data", "axes fraction"), textcoords="offset points", rotation=90, ha="right", va="bottom",
            color=palette.alarm, fontsize=7.5,
        )  # fmt: skip
    _name_points(panel, comparison, points, front, palette)
    plain_log(panel.yaxis)
    plain_log(panel.xaxis)
    panel.xaxis.set_major_formatter(FuncFormatter(lambda value, _: typeset(duration(1e-6 * value, exact=True))))
    panel.set_xlabel("time of one control step: median, whisker to the 99th percentile")
    unit = shown(comparison.metric)[1]
    against = comparison.reference and f"error (% of {spoken(comparison.reference)})"
    panel.set_ylabel(against or f"{TITLES[comparison.metric]} ({unit}), geometric mean")
    dress(panel, palette)


def _name_points(
    panel: Any, comparison: Comparison, points: dict[str, tuple[Any, ...]], front: Sequence[str], palette: Palette
) -> None:
    """Write the names beside the points, without covering other names or points."""
    height = 72 * panel.figure.get_size_inches()[1]
    at = {
        label: panel.transData.transform((1e6 * time, error)) * 72 / panel.figure.dpi
        for label, (time, error, *_) in points.items()
    }
    taken = [(x - 5, y - 5, x + 5, y + 5) for x, y in at.values()]
    for label in sorted(points, key=lambda label: -points[label][1]):
        name = spoken(label)
        x, y = at[label]
        spots = [(-2, 8), (-2, -17), (-2, 20), (-2, -29), (-2, 32)]
        boxes = [(x + dx, y + dy, x + dx + 5.1 * len(name), y + dy + 9) for dx, dy in spots]
        free = [not any(_overlap(box, other) for other in taken) and 0 < box[1] < height for box in boxes]
        chosen = free.index(True) if any(free) else 0
        taken.append(boxes[chosen])
        panel.annotate(
            name, points[label][:2] * np.array([1e6, 1.0]), spots[chosen], textcoords="offset points", ha="left",
            va="bottom", color=palette.series[comparison.look[label].token], fontsize=8.5,
            fontweight="bold" if label in front else "normal",
        )  # fmt: skip


def _overlap(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    """Whether two boxes (left, bottom, right, top) meet."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint that flew. model, data: None if they are missing; note: the reason."""

    path: str
    sha256: str
    model: GPModel | None
    data: ResidualDataset | None
    report: Mapping[str, Any]
    note: str


def read_checkpoint(path: str, sha256: str) -> Checkpoint:
    """The checkpoint, if its file is unchanged, and the residual data it was fitted to, if they are still there."""
    try:
        file = Path(path) / MODEL_FILE
        if file.is_file() and hashlib.sha256(file.read_bytes()).hexdigest() != sha256:
            return Checkpoint(path, sha256, None, None, {}, "another model lies there now, not the one that flew")
        model, report = load_model(path), load_report(path)
    except (UsageError, DataError):
        return Checkpoint(path, sha256, None, None, {}, "it is not there any more")
    if not isinstance(model, GPModel):
        return Checkpoint(path, sha256, None, None, report, "")
    return Checkpoint(path, sha256, model, _data(model, report), report, "")


def _data(model: GPModel, report: Mapping[str, Any]) -> ResidualDataset | None:
    """The samples that the model was fitted to, if the file is unchanged."""
    try:
        data = read_dataset(report["dataset"])
    except (KeyError, UsageError, DataError):
        return None
    return data if data.sha256 == model.dataset.get("sha256") else None


def fit_panel(panel: Any, checkpoint: Checkpoint, output: OutputPosterior, palette: Palette) -> None:
    """Mean and 2-sigma band of one output over its first feature, linear drag, and data; see `fit_figures.curve`."""
    model = checkpoint.model
    assert model is not None
    data = checkpoint.data
    x, mean, std, line, middle = curve(model, output, 0, data, CURVE_POINTS)
    colour, other, grey = (palette.series[LOOKS[name][0] + "-0"] for name in ("gp_mpc", "linear drag", "nominal"))
    if data is not None:
        every = max(1, data.n_rows // DOTS)
        target, _ = moved(model, output, 0, data)
        panel.plot(
            data.matrix(output.features[:1])[::every, 0],
            target[::every],
            ".",
            color=grey,
            markersize=6,
            alpha=0.4,
            markeredgewidth=0,
        )
    panel.fill_between(x, mean - 2 * std, mean + 2 * std, color=colour, alpha=0.25, linewidth=0)
    panel.plot(x, mean, color=colour, linewidth=1.4)
    if line is not None:
        panel.plot(x, line, color=other, linestyle=(0, (5, 2)), linewidth=1.3)
    around = np.concatenate([mean - 3 * std, mean + 3 * std])
    margin = 0.15 * (around.max() - around.min())
    panel.set_xlim(x[0], x[-1])
    panel.set_ylim(around.min() - margin, around.max() + margin)
    held_at = [
        f"{symbol(key)} = {value:.1f} {unit(key)}" for key, value in zip(output.features[1:], middle[1:], strict=True)
    ]
    panel.set_title(
        symbol(output.output) + (f"  at {', '.join(held_at)}" if held_at else ""),
        fontweight="normal",
        color=palette.ink,
        parse_math=True,
    )
    panel.set_xlabel(axis_label(output.features[0]), parse_math=True)
    panel.set_ylabel(f"residual ({unit(output.output)})")
    dress(panel, palette)


def identified(flight: Flight) -> list[str]:
    """Coefficients that a flight's controller identified: those that change."""
    return [name for name in COEFFICIENTS if name in flight.columns and np.ptp(flight[name]) > 0]


def truth(flight: Flight, name: str) -> np.ndarray | None:
    """True value of a coefficient over the flight, (k,); None if its plant has no constant one."""
    plant = flight.metadata.get("config", {}).get("plant", {})
    key, index = TRUTH[name]
    value = plant.get(key)
    if value is None or plant.get("schedule"):
        return None
    return np.full(len(flight), float(value if index is None else value[index]))


def estimate_panel(
    panel: Any, name: str, flights: Sequence[tuple[str, Flight]], look: Mapping[str, Look], palette: Palette
) -> None:
    """One coefficient over time, a line per flight (label, flight), and the plant's own value. look: by label."""
    values = []
    for label, flight in flights:
        every = slice(None, None, max(1, len(flight) // 500))
        line = {"color": palette.series[look[label].token], "linestyle": look[label].dash}
        panel.plot(flight.t[every], flight[name][every], linewidth=1.2, alpha=0.9, **line)
        values.append(flight[name][len(flight) // 20 :])
    true = truth(flights[0][1], name)
    if true is not None:
        panel.plot(flights[0][1].t, true, color=palette.ink, linestyle=(0, (4, 3)), linewidth=1.1)
        values.append(true)
    shown = np.concatenate(values)
    low, high = np.quantile(shown, [0.005, 0.995])
    margin = 0.15 * (high - low) or 0.1 * abs(high) or 1.0
    if math.isfinite(margin):
        panel.set_ylim(low - margin, high + margin)
    column = describe(name, "estimates")
    title = f"{SYMBOLS[name]}  {column.description.removesuffix(', in use')}"
    panel.set_title(title, fontweight="normal", color=palette.ink, parse_math=True)
    panel.set_xlabel("time (s)")
    unit_text = f" ({column.unit})" if column.unit not in ("", "1") else ""
    panel.set_ylabel(f"{SYMBOLS[name]}{unit_text}", parse_math=True)
    dress(panel, palette)
