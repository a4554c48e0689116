"""The picture of `quadexp compare`: paths and errors of flights, errors of results, held-out scores of checkpoints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.log.store import read_flight, read_table
from quadexp.report.compare import names_of
from quadexp.report.draw import line_figure
from quadexp.report.frame import SweepFrame
from quadexp.report.metrics import mean_error, position_error
from quadexp.report.result_rows import ROW_COLUMNS, from_columns
from quadexp.report.style import Figure, looks, plain_log, styled
from quadexp.report.summary import MODEL_FILE, RESULTS_FILE
from quadexp.report.view import view

SOURCE = "results"  # key of the folder that a flight of several results comes from


def picture(kind: str, paths: Sequence[Path]) -> Figure:
    """The figure of several flights, results or checkpoints; UsageError where there is nothing to draw."""
    return {"flight": flights_figure, "results": results_figure, "checkpoint": checkpoints_figure}[kind](paths)


@styled
def flights_figure(paths: Sequence[Path]) -> Figure:
    """Left the paths from above with the reference, right the position error over time."""
    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    above, error = figure.subplots(1, 2)
    names = names_of(paths)
    found = looks([f"{_controller(path)} {name}" for path, name in zip(paths, names, strict=True)])
    for k, (path, name, look) in enumerate(zip(paths, names, found.values(), strict=True)):
        flight = read_flight(path)
        if not len(flight):
            raise UsageError(f"{path}: holds no samples ({flight.outcome}), there is nothing to draw")
        if k == 0:
            above.plot(flight["ref_p_x"], flight["ref_p_y"], color="#888888", linewidth=0.8, label="reference")
        above.plot(flight["p_x"], flight["p_y"], label=name, **look.line())
        values, mean = 1e3 * position_error(flight), 1e3 * mean_error(flight)
        error.plot(flight.t, np.maximum(values, 1e-6), label=f"{name}: mean {mean:.3g} mm", **look.line())
    above.set_aspect("equal", adjustable="datalim")
    above.set_xlabel("x (m)")
    above.set_ylabel("y (m)")
    error.set_yscale("log")
    error.set_xlabel("time (s)")
    error.set_ylabel("position error (mm)")
    largest = max(float(line.get_ydata().max()) for line in error.get_lines())
    error.set_ylim(
        bottom=max(1e-4 * largest, 0.5 * min(float(np.percentile(line.get_ydata(), 2)) for line in error.get_lines()))
    )
    plain_log(error.yaxis, minor=True)
    for panel in (above, error):
        panel.legend(fontsize=8)
    return figure


@styled
def results_figure(paths: Sequence[Path]) -> Figure:
    """Errors of every results folder, a line each: over the key with most values, a panel a controller and path."""
    frame = joined(paths)
    metric = str(frame.record.get("metric", "mean_error"))
    axes = [key for key in frame.swept if key not in (SOURCE, "controller", "model", "trajectory", "seed")]
    x = max(axes, key=lambda key: len(frame.values(key))) if axes else "controller"
    return line_figure(view(frame, x=x, by=[SOURCE], y=metric))


def joined(paths: Sequence[Path]) -> SweepFrame:
    """The flights that stand in all results, with the name of their folder as the key `results`."""
    rows: list[dict[str, Any]] = []
    record: dict[str, Any] = {}
    for path, name in zip(paths, names_of(paths), strict=True):
        columns, own = read_table(path / RESULTS_FILE, "results")
        record = record or {key: own[key] for key in ("metric", "confidence") if key in own}
        for row in from_columns(columns):
            variant = f"{row.get('variant') or ''} {SOURCE}={name}".strip()
            rows.append({**dict.fromkeys(ROW_COLUMNS), **row, "variant": variant})
    return SweepFrame(rows, paths[0], record)


@styled
def checkpoints_figure(paths: Sequence[Path]) -> Figure:
    """Held-out RMSE of every output, of each checkpoint and its predictors; a panel a unit."""
    from quadexp.report.held_out import held_out_rows

    names = names_of(paths)
    made: dict[str, dict[str, dict[str, float]]] = {}  # unit -> label -> output -> RMSE
    for path, name in zip(paths, names, strict=True):
        for row in held_out_rows(path.parent if path.name == MODEL_FILE else path):
            if row["predictor"] != "zero":
                label = f"{row['predictor'].replace('_', ' ')} {name}"
                made.setdefault(row["unit"], {}).setdefault(label, {})[row["output"]] = row["rmse"]
    if not made:
        raise UsageError("--out: none of these checkpoints has held-out scores to draw")
    figure = Figure(figsize=(max(5.6, 4.6 * len(made)), 3.8), layout="constrained")
    panels = figure.subplots(1, len(made), squeeze=False)[0]
    labels = list(dict.fromkeys(label for by_label in made.values() for label in by_label))
    drawn_as = {"gp": "gp_mpc", "linear": "linear_drag_mpc"}  # a predictor looks as the controller that uses it
    names = [" ".join([drawn_as.get(label.split(" ")[0], label.split(" ")[0]), label]) for label in labels]
    found = dict(zip(labels, looks(names).values(), strict=True))
    for panel, (unit, by_label) in zip(panels, made.items(), strict=True):
        outputs = list(dict.fromkeys(output for values in by_label.values() for output in values))
        for k, (label, values) in enumerate(by_label.items()):
            at = [outputs.index(output) + 0.6 * ((k + 0.5) / len(by_label) - 0.5) for output in values]
            panel.plot(at, list(values.values()), **found[label].points() | {"linestyle": "none"}, label=label)
        panel.set_xticks(range(len(outputs)), outputs)
        panel.set_xlim(-0.6, len(outputs) - 0.4)
        panel.set_ylabel(f"held-out RMSE ({unit})")
        panel.set_yscale("log")
        plain_log(panel.yaxis, minor=True)
        panel.grid(False, axis="x")
    handles, texts = panels[0].get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside lower center", ncols=max(1, math.floor(90 / (max(map(len, texts)) + 6))))
    return figure


def _controller(path: Path) -> str:
    return str(read_flight(path, check=False).metadata.get("controller", ""))
