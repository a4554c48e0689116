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
from quadexp.report.metrics import ROW_COLUMNS, from_columns, mean_error, position_error
from quadexp.report.style import Figure, looks, plain_log, styled
from quadexp.report.summary import RESULTS_FILE
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
    flights = {name: read_flight(path) for name, path in zip(names_of(paths), paths, strict=True)}
    every = looks([f"{flight.metadata.get('controller', '')} {name}" for name, flight in flights.items()])
    for path, (name, flight), look in zip(paths, flights.items(), every.values(), strict=True):
        if not len(flight):
            raise UsageError(f"{path}: holds no samples ({flight.outcome}), there is nothing to draw")
        if path is paths[0]:
            above.plot(flight["ref_p_x"], flight["ref_p_y"], color="#888888", linewidth=0.8, label="reference")
        above.plot(flight["p_x"], flight["p_y"], label=name, **look.line())
        values, mean = 1e3 * position_error(flight), 1e3 * mean_error(flight)
        error.plot(flight.t, np.maximum(values, 1e-6), label=f"{name}: mean {mean:.3g} mm", **look.line())
    above.set(xlabel="x (m)", ylabel="y (m)")
    above.set_aspect("equal", adjustable="datalim")
    error.set(yscale="log", xlabel="time (s)", ylabel="position error (mm)")
    drawn = [line.get_ydata() for line in error.get_lines()]
    least, largest = min(float(np.percentile(values, 2)) for values in drawn), max(map(np.max, drawn))
    error.set_ylim(bottom=max(1e-4 * largest, 0.5 * least))
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
    from quadexp.report.summary import held_out_rows

    rows = [
        {**row, "label": f"{row['predictor'].replace('_', ' ')} {name}"}
        for path, name in zip(paths, names_of(paths), strict=True)
        for row in held_out_rows(path)
        if row["predictor"] != "zero"
    ]
    if not rows:
        raise UsageError("--out: none of these checkpoints has held-out scores to draw")
    units = list(dict.fromkeys(row["unit"] for row in rows))
    figure = Figure(figsize=(max(5.6, 4.6 * len(units)), 3.8), layout="constrained")
    panels = figure.subplots(1, len(units), squeeze=False)[0]
    drawn_as = {"gp": "gp_mpc", "linear": "linear_drag_mpc"}  # a predictor looks as the controller that uses it
    labels = list(dict.fromkeys(row["label"] for row in rows))
    first = (label.partition(" ")[0] for label in labels)
    every = looks([f"{drawn_as.get(word, word)} {label}" for word, label in zip(first, labels, strict=True)])
    for panel, unit in zip(panels, units, strict=True):
        for label, look in zip(labels, every.values(), strict=True):
            errors = {row["output"]: row["rmse"] for row in rows if (row["unit"], row["label"]) == (unit, label)}
            panel.plot(list(errors), list(errors.values()), **look.points() | {"linestyle": "none"}, label=label)
        panel.set_ylabel(f"held-out RMSE ({unit})")
        panel.set_yscale("log")
        plain_log(panel.yaxis, minor=True)
        panel.grid(False, axis="x")
    columns = max(1, math.floor(90 / (max(map(len, labels)) + 6)))
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=columns)
    return figure
