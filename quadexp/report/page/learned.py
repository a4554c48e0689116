"""What was learned: the residual models of the checkpoints that flew, and the coefficients identified in flight."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.log.outcome import UNFLOWN
from quadexp.log.schema import ESTIMATE_COLUMNS, Flight, describe
from quadexp.models.checkpoint import MODEL_FILE, load_model, load_report
from quadexp.models.dataset import ResidualDataset, read_dataset
from quadexp.models.gaussian_process import GPModel, OutputPosterior
from quadexp.report.model_figures import axis_label, curve, moved, symbol, unit
from quadexp.report.page.palette import Palette, dress
from quadexp.report.page.sheet import Sheet, sheet_name
from quadexp.report.page.source import Comparison, spoken
from quadexp.report.style import LOOKS, Look
from quadexp.report.text import number, percent

CURVE_POINTS = 120
DOTS = 400  # of the data set behind a curve
PREDICTORS = {"gp": "GP", "linear_drag": "linear drag", "zero": "nothing"}
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


def fit_sheets(comparison: Comparison) -> list[Sheet]:
    """One for each checkpoint that flew."""
    flown: dict[str, str] = {}
    for row in comparison.rows:
        if row["model"] and row["model"] not in flown and row["outcome"] not in UNFLOWN:
            flown[row["model"]] = (comparison.flight_record(row) or {}).get("model_sha256", "")
    return [_fit_sheet(read_checkpoint(path, sha256)) for path, sha256 in flown.items()]


def _fit_sheet(checkpoint: Checkpoint) -> Sheet:
    path, name = checkpoint.path.rstrip("/"), sheet_name("residuals", checkpoint.path)
    if checkpoint.model is None:
        return Sheet(name, path, {}, text=f"Not drawn: {checkpoint.note or 'it holds linear drag only'}.")
    outputs, data = checkpoint.model.outputs, checkpoint.model.dataset
    draws = {
        f"Residual {output.output} over {output.features[0]}": partial(fit_panel, checkpoint=checkpoint, output=output)
        for output in outputs
    }
    text = "; ".join(f"{o.output} from {', '.join(o.features)}, {len(o.alpha)} points" for o in outputs) + "."
    text += f" Fitted to {data['rows']} samples of {data['flights']} flights." if data.get("rows") else ""
    more = {"has_data": checkpoint.data is not None, **_scores(checkpoint.report.get("rows", []))}
    return Sheet(name, path, draws, text=text, more=more)


def _scores(rows: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Held-out errors of a checkpoint's report, a line per output and a column per predictor."""
    predictors = [name for name in dict.fromkeys(row["predictor"] for row in rows) if name in PREDICTORS]
    texts = {
        (row["output"], row["predictor"]): {
            "rmse": f"{row['rmse']:.3g}",
            "inside": percent(100 * row["inside_2"], least=0)[0],
        }
        for row in rows
        if row["predictor"] in PREDICTORS
    }
    lines = []
    for output in dict.fromkeys(row["output"] for row in rows):
        name, _, index = output.partition("_")
        unit = describe(output, "residuals").unit.replace("^2", "²")
        cells = [texts.get((output, predictor), {}) for predictor in predictors]
        lines.append({"name": name, "index": index, "unit": unit, "cells": cells})
    return {"scores": lines, "predictors": [PREDICTORS[name] for name in predictors]}


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
    """Mean and 2-sigma band of one output over its first feature, linear drag, and data; see `model_figures.curve`."""
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


def estimate_sheets(comparison: Comparison) -> list[Sheet]:
    """Of each trajectory and plant the flights that identified coefficients: fastest speed, one per contestant."""
    chosen: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for row in comparison.rows:
        identifies = "rls" in row["controller"] or row["controller"].startswith("literal")
        if identifies and row["outcome"] not in UNFLOWN:
            fastest = chosen.setdefault((row["plant"], row["trajectory"]), {})
            rival = fastest.setdefault(comparison.label(row), row)
            if (row["speed"] or 0) > (rival["speed"] or 0):
                fastest[comparison.label(row)] = row
    made = []
    for (plant, trajectory), rows in chosen.items():
        flights = [(label, f) for label, row in rows.items() if (f := comparison.flight(row)) and identified(f)]
        if flights:
            made.append(_estimate_sheet(comparison, f"{trajectory} on {plant}", flights))
    return made


def _estimate_sheet(comparison: Comparison, title: str, flights: list[tuple[str, Flight]]) -> Sheet:
    (label, last), draw = flights[0], partial(estimate_panel, flights=flights, look=comparison.look)
    names = identified(last)
    ends = [
        f"{name} {number(float(last[name][-1]))} of {number(float(true[-1]))}"
        for name in names
        if (true := truth(last, name)) is not None and math.isfinite(float(last[name][-1]))
    ]
    text = f"Dashed: the plant's own value. At the end, {spoken(label)}: {', '.join(ends)}." if ends else ""
    draws = {f"{name} identified over time": partial(draw, name=name) for name in names}
    return Sheet(sheet_name("coefficients", title), title, draws, [label for label, _ in flights], text)


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
