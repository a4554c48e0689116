"""From a data set to a checkpoint, with a report on held-out flights."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from quadexp.errors import DataError
from quadexp.experiment.build import build_vehicle
from quadexp.models.base import Model
from quadexp.models.checkpoint import load_model, save_model
from quadexp.models.dataset import ResidualDataset, read_dataset
from quadexp.models.evaluation import Fit, fit_with_report, without
from quadexp.models.gaussian_process import GPModel, GPSettings
from quadexp.models.known_noise import explained, explained_lines
from quadexp.models.linear_drag import LinearDrag
from quadexp.models.neural import NeuralModel, NNSettings
from quadexp.parts.schema import Config
from quadexp.parts.settings import part
from quadexp.provenance import provenance, versions

ProgressCallback = Callable[[float, float], None]


def fit_checkpoint(
    kind: str,
    config: Config,
    dataset: Path,
    out: Path,
    *,
    force: bool = False,
    figures: bool = True,
    after: Path | None = None,
    progress: ProgressCallback = lambda done, total: None,
) -> dict[str, Any]:
    """Fit (kind "gp", "drag" or "nn"), write the checkpoint, return the report.

    after: checkpoint whose prediction is subtracted from the data first; the fit is then to be flown in a sum with it.

    Raises UsageError or DataError before anything is written.
    """
    data = read_dataset(dataset)
    _check_vehicle(data, config, dataset)
    if after is not None:
        data = without(data, load_model(after, vehicle=build_vehicle(config.vehicle)), str(after))
    fit = fit_with_report(data, *_asked(kind, config), callback=lambda message, done: progress(round(done, 2), 1))
    report = {**fit.report, **fit.model.numbers, "summary": fit.model.summary}
    if kind == "gp":
        report |= _beside_drag(fit, config, data)
    report["explained"] = explained(report["rows"], data.metadata.get("known_noise") or {})
    if after is not None:
        report["after"] = str(after)
    report |= {"dataset": str(dataset), "versions": versions(), "provenance": provenance()}
    save_model(out, fit.model, report=report, force=force)
    files = _draw(fit, out / "figures") if figures and kind == "gp" else {}
    lines = [f"{report['summary']} from {data.n_rows} rows of {len(data.flights)} flights"]
    if after is not None:
        lines.append(f"of what {after} leaves: to be flown in a sum with it")
    lines += [*_split_lines(report), *explained_lines(report["explained"])]
    if "verdict" in report:
        from quadexp.models.verdict import verdict_lines

        lines += verdict_lines(report["verdict"])
    elif kind == "gp":
        lines.append("no comparison with linear drag: it needs held-out flights (gp.holdout above 0)")
    return {"path": out, "kind": kind, "figures": files, "lines": lines, **report}


def _check_vehicle(data: ResidualDataset, config: Config, path: Path) -> None:
    """Raise DataError where the data set is of another vehicle than the configuration's."""
    vehicle = build_vehicle(config.vehicle)
    recorded = (data.metadata.get("vehicle") or {}).get("fingerprint")
    if recorded != vehicle.fingerprint:
        name = (data.metadata.get("vehicle") or {}).get("name")
        raise DataError(
            f"{path}: flown by vehicle {name} ({recorded}), the configuration has {vehicle.name}"
            f" ({vehicle.fingerprint}): pass the vehicle=... it was collected with"
        )


def _asked(kind: str, config: Config) -> tuple[type[Model], Any]:
    """The kind of model, and the settings of its fit."""
    if kind == "gp":
        return GPModel, part(GPSettings, config.gp, features=asdict(config.gp.features))
    return (NeuralModel, part(NNSettings, config.nn)) if kind == "nn" else (LinearDrag, config.drag)


def _beside_drag(fit: Fit, config: Config, data: ResidualDataset) -> dict[str, Any]:
    """Of Gaussian processes: the target of recorded flights, and the comparison with linear drag."""
    found = {"target": data.metadata["target"]} if data.metadata.get("target") else {}
    if fit.test is None:
        return found
    from quadexp.models.verdict import verdict

    _, settings = _asked("gp", config)
    search = config.gp.alternatives
    return found | {"verdict": verdict(fit.held_out_model, fit.train, fit.test, settings, search=search)}


def _draw(fit: Fit, folder: Path) -> dict[str, str]:
    from quadexp.report.model_figures import fit_figure
    from quadexp.report.style import save

    figure = fit_figure(fit.held_out_model, fit.train if fit.test is None else fit.test)
    return {"fit": str(save(figure, folder / "fit", inside=folder.parent))}


def _split_lines(report: Mapping[str, Any]) -> list[str]:
    """The held-out table."""
    lines = report_lines(report["rows"], report["held_out_flights"])
    shares = {name: share for name, share in report.get("out_of_range", {}).items() if share > 0}
    if shares and report.get("target"):
        worst = ", ".join(f"{name} {100 * share:.1f} %" for name, share in shares.items() if name != "any")
        lines.append(f"outside the range of the fit: {100 * shares['any']:.1f} % of the held-out rows ({worst})")
    return lines


def report_lines(rows: Sequence[Mapping[str, Any]], held_out: Sequence[str]) -> list[str]:
    """The held-out table as text: one line per output, one column per predictor."""
    if not rows:
        return ["no flights held out, so no report"]
    predictors = list(dict.fromkeys(row["predictor"] for row in rows))
    by_output: dict[str, dict[str, Mapping[str, Any]]] = {}
    for row in rows:
        by_output.setdefault(row["output"], {})[row["predictor"]] = row
    width = 34
    lines = [
        (
            f"on {len(held_out)} held-out flights, {rows[0]['n']} rows:"
            " RMSE, negative log density, share inside 1 and 2 sigma"
        ),
        "        " + "".join(f"{name:<{width}}" for name in predictors),
    ]
    for output, found in by_output.items():
        cells = [_score(found[name]) if name in found else "" for name in predictors]
        lines.append(f"{output:<8}" + "".join(f"{cell:<{width}}" for cell in cells).rstrip())
    return lines


def _score(row: Mapping[str, Any]) -> str:
    return f"{row['rmse']:8.4f} {row['nlpd']:7.3f}  {100 * row['inside_1']:3.0f} % {100 * row['inside_2']:3.0f} %"
