"""Panels of learned models: residual models of the checkpoints that flew, and coefficients identified in flight."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.learn.checkpoint import MODEL_FILE, load_model, load_report
from quadexp.learn.dataset import ResidualDataset, read_dataset
from quadexp.learn.model import GPModel, OutputPosterior
from quadexp.log.schema import ESTIMATE_COLUMNS, Flight, describe
from quadexp.report.fit_figures import axis_label, curve, moved, symbol, unit
from quadexp.report.page.palette import Palette, dress
from quadexp.report.style import LOOKS, Look

CURVE_POINTS = 120
DOTS = 400  # of the data set behind a curve
COEFFICIENTS = [name for name in ESTIMATE_COLUMNS if name.startswith("C_")]
SYMBOLS = {"C_d0": "$C_{d0}$", "C_la": "$C_{l\\alpha}$"} | {f"C_D{i}": f"$C_{{D{i}}}$" for i in "xyz"}
TRUTH = {"C_d0": ("profile_drag", None), "C_la": ("lift_slope", None)} | {
    f"C_D{axis}": ("body_drag", i) for i, axis in enumerate("xyz")
}


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
    points = output.inducing if data is None else data.matrix(output.features)
    x, mean, std, line, middle = curve(model, output, 0, points, CURVE_POINTS)
    colour, other, grey = (palette.series[LOOKS[name][0] + "-0"] for name in ("gp_mpc", "linear drag", "nominal"))
    if data is not None:
        every = max(1, data.n_rows // DOTS)
        target, _ = moved(model, output, 0, points[::every], data.matrix([output.output])[::every, 0], middle)
        panel.plot(points[::every, 0], target, ".", color=grey, markersize=6, alpha=0.4, markeredgewidth=0)
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
    )
    panel.set_xlabel(axis_label(output.features[0]))
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
    panel.set_title(
        f"{SYMBOLS[name]}  {column.description.removesuffix(', in use')}", fontweight="normal", color=palette.ink
    )
    panel.set_xlabel("time (s)")
    panel.set_ylabel(f"{SYMBOLS[name]}" + (f" ({column.unit})" if column.unit not in ("", "1") else ""))
    dress(panel, palette)
