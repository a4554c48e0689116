"""From a data set to a checkpoint, with a report on held-out flights."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.config.schema import Config
from quadexp.config.settings import part
from quadexp.errors import DataError
from quadexp.experiment.build import build_vehicle
from quadexp.learn.checkpoint import save_model
from quadexp.learn.dataset import ResidualDataset, read_dataset
from quadexp.learn.known_noise import explained, explained_lines
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
        data = _rest(data, after, config)
    if kind == "gp":
        model, report, draw = _fit_gp(data, config, progress)
    elif kind == "nn":
        model, report, draw = _fit_nn(data, config, progress)
    else:
        model, report, draw = _fit_drag(data, config)
    report["explained"] = explained(report["rows"], data.metadata.get("known_noise") or {})
    if after is not None:
        report["after"] = str(after)
    report |= {"dataset": str(dataset), "versions": versions(), "provenance": provenance()}
    save_model(out, model, report=report, force=force)
    files = draw(out / "figures") if figures else {}
    lines = [f"{report['summary']} from {data.n_rows} rows of {len(data.flights)} flights"]
    if after is not None:
        lines.append(f"of what {after} leaves: to be flown in a sum with it")
    lines += [*_split_lines(report), *explained_lines(report["explained"])]
    if "verdict" in report:
        from quadexp.learn.verdict import verdict_lines

        lines += verdict_lines(report["verdict"])
    elif kind == "gp":
        lines.append("no comparison with linear drag: it needs held-out flights (gp.holdout above 0, gp.split=flight)")
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


def _fit_gp(data: ResidualDataset, config: Config, progress: ProgressCallback) -> tuple[Any, ...]:
    from quadexp.learn.evaluation import fit_with_report
    from quadexp.learn.gaussian_process import GPSettings

    settings = part(GPSettings, config.gp, features=asdict(config.gp.features))
    fit = fit_with_report(data, settings, callback=lambda message, done: progress(round(done, 2), 1))
    report = dict(fit.report)
    if data.metadata.get("target"):
        report["target"] = data.metadata["target"]
    chosen = "; ".join(f"{o.output} <- {', '.join(o.features)}" for o in fit.model.outputs)
    report["summary"] = f"Gaussian processes {chosen} ({settings.inducing} points, {settings.method})"
    if fit.test is not None and settings.split == "flight":
        from quadexp.learn.verdict import verdict

        report["verdict"] = verdict(fit.held_out_model, fit.train, fit.test, settings, search=settings.alternatives)

    def draw(folder: Path) -> dict[str, str]:
        from quadexp.report import fit_figures
        from quadexp.report.figures import save

        shown = fit.test if fit.test is not None else fit.train
        made = {"fit": fit_figures.fit_figure(fit.held_out_model, shown)}
        if fit.test is not None:
            made["calibration"] = fit_figures.calibration_figure(fit.held_out_model, fit.test)
        return {name: str(save(figure, folder / name, inside=folder.parent)) for name, figure in made.items()}

    return fit.model, report, draw


def _fit_drag(data: ResidualDataset, config: Config) -> tuple[Any, ...]:
    from quadexp.learn.evaluation import drag_baseline, evaluate, split_by_flight
    from quadexp.learn.linear_drag import fit_linear_drag

    options = {name: getattr(config.drag, name) for name in ("intercept", "thrust", "loss")}
    rows: list[dict[str, Any]] = []
    held_out: list[str] = []
    if config.drag.holdout > 0:
        train, test = split_by_flight(data, config.drag.holdout, config.drag.seed)
        rows = evaluate(drag_baseline(train, **options), train, test)
        held_out = sorted(set(map(str, test.columns["flight_name"])))
    model = fit_linear_drag(data, **options)
    report: dict[str, Any] = {
        "rows": rows,
        "held_out_flights": held_out,
        "refitted": True,
        "summary": f"linear drag {model}",
    }
    half = [None if np.isnan(value) else float(value) for value in model.half_width[:3]]
    report["drag"] = {
        "drag": model.drag.tolist(), "error": model.drag_error.tolist(), "half_width_95": half,
        "intervals": model.label,
    }  # fmt: skip
    return model, report, lambda folder: {}


def _rest(data: ResidualDataset, after: Path, config: Config) -> ResidualDataset:
    """The data without what a checkpoint predicts of them."""
    from quadexp.learn.checkpoint import load_model
    from quadexp.learn.evaluation import without

    return without(data, load_model(after, vehicle=build_vehicle(config.vehicle)), str(after))


def _fit_nn(data: ResidualDataset, config: Config, progress: ProgressCallback) -> tuple[Any, ...]:
    from quadexp.learn.evaluation import evaluate, split_by_flight
    from quadexp.learn.neural import NNSettings, fit_network

    settings = part(NNSettings, config.nn)
    refit, rows, held_out = settings.holdout == 0 or settings.refit, [], []
    parts = (settings.holdout > 0) + refit

    def follow(first: int) -> Callable[[str, float], None]:
        return lambda message, done: progress(round((first + done) / parts, 2), 1)

    model = None
    if settings.holdout > 0:
        train, test = split_by_flight(data, settings.holdout, settings.seed)
        model = fit_network(train, settings, callback=follow(0))
        rows = evaluate(model, train, test)
        held_out = sorted(set(map(str, test.columns["flight_name"])))
    if refit:
        model = fit_network(data, settings, callback=follow(parts - 1))
    assert model is not None
    layers = "-".join(map(str, model.sizes))
    report = {
        "rows": rows,
        "held_out_flights": held_out,
        "refitted": bool(rows) and refit,
        "lipschitz": model.lipschitz,
        "summary": f"neural network {layers}, {', '.join(model.outputs)} <- {', '.join(model.features)}, largest slope"
        f" of the scaled network at most {model.lipschitz:.3g},",
    }
    return model, report, lambda folder: {}


def _split_lines(report: Mapping[str, Any]) -> list[str]:
    """The held-out table; for a split by sample both tables, with a warning on the first."""
    if "misleading" not in report:
        lines = report_lines(report["rows"], report["held_out_flights"])
    else:
        by_flight = report_lines(report["rows_by_flight"], report["held_out_flights"])
        lines = [f"warning: {report['misleading']}", "split by sample:"]
        lines += [*report_lines(report["rows"], report["held_out_flights"])[1:], "split by flight:", *by_flight[1:]]
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
