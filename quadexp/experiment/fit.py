"""From a data set to a checkpoint, with a report on held-out flights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from quadexp.errors import DataError
from quadexp.experiment.build import build_vehicle
from quadexp.models.base import ModelPart, figure_of
from quadexp.models.checkpoint import load_model, save_model
from quadexp.models.dataset import read_dataset
from quadexp.models.verdict import fit_with_report, verdict, verdict_lines, without
from quadexp.names import distinct
from quadexp.parts.schema import Config
from quadexp.plugin import brought
from quadexp.provenance import provenance, versions

WIDTH = 34  # of a column of the report


def fit_checkpoint(
    part: ModelPart, config: Config, dataset: Path, out: Path, *, force: bool = False, figures: bool = True,
    after: Path | None = None, progress: Callable[[float, float], None] = lambda done, total: None,
) -> dict[str, Any]:  # fmt: skip
    """Fit a model, write the checkpoint, return the report.

    after: checkpoint whose prediction is subtracted from the data first; the fit is then to be flown in a sum with it.

    Raises UsageError or DataError before anything is written.
    """
    data = read_dataset(dataset)
    vehicle = build_vehicle(config.vehicle)
    flown = data.metadata.get("vehicle") or {}
    if flown.get("fingerprint") != vehicle.fingerprint:
        raise DataError(
            f"{dataset}: flown by vehicle {flown.get('name')} ({flown.get('fingerprint')}), the configuration has"
            f" {vehicle.name} ({vehicle.fingerprint}): pass the vehicle=... it was collected with"
        )
    if after is not None:
        data = without(data, load_model(after, vehicle=vehicle), str(after))
    fit = fit_with_report(data, part, callback=lambda message, done: progress(round(done, 2), 1))
    report = {**fit.report, **fit.model.numbers, "summary": fit.model.summary}
    if part.judged:
        report |= {"target": data.metadata["target"]} if data.metadata.get("target") else {}
        report |= {"verdict": verdict(fit.held_out_model, fit.train, fit.test)} if fit.test else {}
    if after is not None:
        report["after"] = str(after)
    report |= {"dataset": str(dataset), "versions": versions(), "provenance": provenance()}
    save_model(out, fit.model, report=report, force=force)
    files = {}
    drawing = brought("services", "drawing") if figures and fit.model.figure else None
    if drawing is not None:
        figure = figure_of(fit.held_out_model, fit.test or fit.train, str(out))
        files = {"fit": str(drawing.save(figure, out / "figures" / "fit"))}
    lines = [f"{report['summary']} from {data.n_rows} rows of {len(data.flights)} flights"]
    if after is not None:
        lines.append(f"of what {after} leaves: to be flown in a sum with it")
    lines += _held_out_lines(report)
    if "verdict" in report:
        lines += verdict_lines(report["verdict"])
    elif part.judged:
        lines.append("no comparison with linear drag: it needs held-out flights (model.holdout above 0)")
    return {"path": out, "kind": part.kind, "figures": files, "lines": lines, **report}


def _held_out_lines(report: Mapping[str, Any]) -> list[str]:
    """The table of held-out flights as text: one line per output, one column per predictor."""
    rows = report["rows"]
    if not rows:
        return ["no flights held out, so no report"]
    predictors = distinct(row["predictor"] for row in rows)
    by_output: dict[str, dict[str, str]] = {}
    for row in rows:
        score = f"{row['rmse']:8.4f} {row['nlpd']:7.3f}  {100 * row['inside_1']:3.0f} % {100 * row['inside_2']:3.0f} %"
        by_output.setdefault(row["output"], {})[row["predictor"]] = score
    what = "RMSE, negative log density, share inside 1 and 2 sigma"
    lines = [f"on {len(report['held_out_flights'])} held-out flights, {rows[0]['n']} rows: {what}"]
    lines.append("        " + "".join(f"{name:<{WIDTH}}" for name in predictors))
    for output, scores in by_output.items():
        lines.append(f"{output:<8}" + "".join(f"{scores.get(name, ''):<{WIDTH}}" for name in predictors).rstrip())
    shares = {name: share for name, share in report.get("out_of_range", {}).items() if share > 0}
    if shares and report.get("target"):
        worst = ", ".join(f"{name} {100 * share:.1f} %" for name, share in shares.items() if name != "any")
        lines.append(f"outside the range of the fit: {100 * shares['any']:.1f} % of the held-out rows ({worst})")
    return lines
