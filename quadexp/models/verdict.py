"""How well a model predicts flights that it was not fitted to, and whether better than linear drag.

    rmse     sqrt(mean (a - mean)^2)                                                    unit of the output
    nlpd     mean [ (a - mean)^2 / (2 s^2) + log s + log(2 pi)/2 ], s^2 = variance + noise      nats per row
    inside_k share of the rows with |a - mean| < k s; a Gaussian has 0.683 for k = 1 and 0.954 for k = 2

Neighbouring rows of a flight are correlated, so whole flights are held out: a split by row would underestimate the
error. For the same reason the comparison with linear drag, fitted to the same rows, is paired over flights: with
g_f and d_f the RMSEs of model and drag on held-out flight f, per axis,

    ratio = exp(mean_f log(g_f / d_f)),     95 % interval over the flights (regression.between_flights)

better: the whole interval is below 1. worse: it is above 1. open: neither, or fewer than LEAST_FLIGHTS are held out, of
which no interval tells anything; the text says so, and how to hold out as many.

The noise of the data is estimated as half the variogram of a flight's residual r at LAG rows,

    noise^2 = mean (r_k - r_{k + LAG})^2 / 2,       unexplained^2 = rmse^2 - noise^2

taking the least over the predictors. LAG = 2, because targets from differences of a noisy velocity are anticorrelated
between neighbours. Noise that a filter spreads over more rows counts as unexplained; an effect shorter than LAG rows
counts as noise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.models.base import AXIS, Callback, Model, ModelPart, Prediction, outside_shares, quiet, rms
from quadexp.models.common_scale import has_thrust_scale
from quadexp.models.dataset import DT_RANGE, ResidualDataset
from quadexp.models.linear_drag import LinearDrag, baseline
from quadexp.models.regression import LEAST_FLIGHTS, between_flights
from quadexp.physics.state import root_mean_square
from quadexp.plugin import brought

Row = dict[str, Any]
ACCELERATION = list(AXIS)
LAG = 2
CONFIDENCE = 0.95  # of every interval, as in the tables of results
WORDS = {"better": "BETTER than linear drag", "worse": "WORSE than linear drag", "open": "NOT SHOWN TO BE BETTER"}


class Fit(NamedTuple):
    """A fit and the report on it.

    model: the result, fitted to all rows if refitted. held_out_model: fitted without the flights of `test`; the
    report's rows describe this one. train, test: the split (test None: nothing was held out, the report has no rows).
    report: JSON-able: rows (one per output and predictor), held_out_flights, refitted.
    """

    model: Any
    held_out_model: Any
    train: ResidualDataset
    test: ResidualDataset | None
    report: dict[str, Any]


def fit_with_report(dataset: ResidualDataset, part: ModelPart, *, callback: Callback = quiet) -> Fit:
    """Fit a model without the held-out flights, report on these, then refit to all rows from there.

    part: with holdout, seed and, where there is a choice, refit.
    Raises DataError as `part.fit` does, and where a single flight cannot be split.
    """
    if part.holdout == 0:
        model = part.fit(dataset, callback=callback)
        return Fit(model, model, dataset, None, {"rows": [], "held_out_flights": [], "refitted": False})
    train, test = split_by_flight(dataset, part.holdout, part.seed)
    refit = getattr(part, "refit", True)
    share = 0.8 if refit else 1.0

    def progress(begin: float, length: float) -> Callback:
        """The callback of a part of the work."""
        return lambda message, done: callback(message, begin + length * done)

    first = model = part.fit(train, callback=progress(0.0, share), intervals=not refit)
    if refit:
        model = part.fit(dataset, start=first, callback=progress(share, 1.0 - share))
    held_out = sorted(set(map(str, test.columns["flight_name"])))
    report = {"rows": evaluate(first, train, test), "held_out_flights": held_out, "refitted": refit}
    return Fit(model, first, train, test, report | {"out_of_range": outside_shares(first.feature_range, test)})


def split_by_flight(dataset: ResidualDataset, share: float, seed: int = 0) -> tuple[ResidualDataset, ResidualDataset]:
    """Train and test rows: whole flights, drawn by the seed, at least one in each set.

    Raises DataError for fewer than two flights.
    """
    if not dataset.n_rows:
        raise DataError("dataset: it has no rows")
    flights = dataset.flights
    if len(flights) < 2:
        raise DataError(
            "the data set holds one flight, which cannot be split into flights to fit and to hold out: collect more"
            " with collect.duration, or hold none out: model.holdout=0"
        )
    count = int(np.clip(round(share * len(flights)), 1, len(flights) - 1))
    held_out = np.random.default_rng(seed).permutation(flights)[:count]
    test = np.isin(dataset.columns["flight"], held_out)
    return dataset.rows(~test), dataset.rows(test)


def evaluate(model: Model, train: ResidualDataset, test: ResidualDataset) -> list[Row]:
    """One row per output and predictor (the model, linear_drag, zero) with rmse, nlpd, inside_1, inside_2, n.

    train: rows that the baselines (linear drag, and the standard deviations) are fitted to.
    """
    drag = model if isinstance(model, LinearDrag) else baseline(train, intervals=False)
    of_drag = {} if drag is model else drag.predict(test)
    rows = []
    for output, of_model in model.predict(test).items():
        target = test.matrix([output])[:, 0]
        zero = Prediction(np.zeros(len(target)), None, float(np.mean(train.matrix([output]) ** 2)))
        for name, prediction in ((model.predictor, of_model), (drag.predictor, of_drag.get(output)), ("zero", zero)):
            if prediction is not None:
                rows.append({"output": output, "predictor": name} | score(target, prediction.mean, prediction.std))
    return rows


def without(data: ResidualDataset, model: Model, label: str) -> ResidualDataset:
    """The dataset with the model's predictions subtracted from its outputs; label: of the model, for the record.

    Raises UsageError for an identified vehicle, and for recorded flights, whose thrust scale is fitted with the model.
    """
    if has_thrust_scale(data):
        raise UsageError("--after: only of simulated flights; recorded ones have a thrust scale that is fitted too")
    try:
        predictions = model.predict(data)
    except UsageError as error:
        raise UsageError(f"{label}: {error}; --after needs a checkpoint of `quadexp fit`") from None
    columns = {output: data.matrix([output])[:, 0] - part.mean for output, part in predictions.items()}
    return ResidualDataset(dict(data.columns) | columns, dict(data.metadata) | {"after": label})


def score(target: np.ndarray, mean: np.ndarray, std: np.ndarray) -> Row:
    """rmse, nlpd, inside_1, inside_2, n of predictions (k,) with standard deviations (k,) for targets (k,)."""
    error = target - mean
    std = np.maximum(std, 1e-12)
    scaled = error / std
    return {
        "rmse": root_mean_square(error),
        "nlpd": float(np.mean(0.5 * scaled**2 + np.log(std) + 0.5 * np.log(2 * np.pi))),
        "inside_1": float(np.mean(np.abs(scaled) < 1)),
        "inside_2": float(np.mean(np.abs(scaled) < 2)),
        "n": len(target),
    }


class Ratio(NamedTuple):
    """Ratio of two RMSEs paired over flights, with its 95 % interval (NaN for fewer than LEAST_FLIGHTS)."""

    value: float
    low: float
    high: float
    flights: int

    @property
    def verdict(self) -> str:
        if self.high < 1:
            return "better"
        return "worse" if self.low > 1 else "open"

    def record(self) -> dict[str, Any]:
        """JSON-able."""
        ends = (None, None) if np.isnan(self.low) else (self.low, self.high)
        return {"verdict": self.verdict, "ratio": self.value, "low": ends[0], "high": ends[1], "text": str(self)}

    def __str__(self) -> str:
        if np.isnan(self.low):
            return f"{self.value:.3g} (no interval)"
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


def paired_ratio(error: np.ndarray, other: np.ndarray, flight: np.ndarray) -> Ratio:
    """Ratio of the RMSEs of two predictors' errors, (k,) or (k, 3) each, paired over flights (k,)."""
    logs = []
    for index in np.unique(flight):
        mean, base = (max(float(np.mean(values[flight == index] ** 2)), 1e-24) for values in (error, other))
        logs.append(0.5 * np.log(mean / base))
    middle = float(np.mean(logs))
    half = between_flights(np.array(logs), np.ones(len(logs)), CONFIDENCE)
    return Ratio(float(np.exp(middle)), float(np.exp(middle - half)), float(np.exp(middle + half)), len(logs))


def noise_floor(residuals: Sequence[np.ndarray], dataset: ResidualDataset) -> float:
    """Noise of an output (see the module), the least over the residuals (k,) of several predictors; NaN if unknown."""
    t = np.asarray(dataset.columns["t"], float)
    flight = dataset.columns["flight"]
    step = float(np.median(np.asarray(dataset.columns["dt"], float)))
    gap = t[LAG:] - t[:-LAG]
    together = (flight[LAG:] == flight[:-LAG]) & (gap > 0) & (gap < DT_RANGE[1] * LAG * step)
    if not together.any():
        return float("nan")
    return min(float(np.sqrt(np.mean((r[LAG:] - r[:-LAG])[together] ** 2) / 2)) for r in residuals)


def verdict(model: Model, train: ResidualDataset, test: ResidualDataset) -> dict[str, Any]:
    """Comparison that `fit` reports, JSON-able: flights (held out), of (how many), duration of these (s), outputs
    {a_x: {...}}, beside [...]: the model's rivals; for recorded flights also what the service `recorded_verdict` finds.
    model: fitted to train."""
    flight = np.asarray(test.columns["flight"])
    target = test.matrix(ACCELERATION)
    of_drag = target - baseline(train, intervals=False).acceleration(test)
    predictions = model.predict(test)
    of_model = of_drag.copy()
    outputs: dict[str, Any] = {}
    for output, axis in ((name, axis) for name, axis in AXIS.items() if name in predictions):
        of_model[:, axis] = target[:, axis] - predictions[output].mean
        errors = of_model[:, axis], of_drag[:, axis]
        rmse = rms(errors[0])
        floor = noise_floor(errors, test)
        outputs[output] = paired_ratio(*errors, flight).record() | {
            "rmse": rmse, "drag_rmse": rms(errors[1]), "noise": floor,
            "unexplained": float(np.sqrt(max(rmse**2 - floor**2, 0.0))),
        }  # fmt: skip
    report: dict[str, Any] = {"outputs": outputs, "flights": len(test.flights)}
    report["of"] = len(train.flights) + len(test.flights)
    report["duration"] = float(sum(np.sum(data.columns["dt"]) for data in (train, test)))
    report["beside"] = []
    for name, acceleration in model.rivals(train).items():
        error = target - acceleration(test)
        row = {"model": name, "rms": rms(error), "this": rms(of_model)}
        report["beside"].append(row | paired_ratio(of_model, error, flight).record())
    recorded = brought("services", "recorded_verdict") if has_thrust_scale(train) else None
    if recorded is None:
        return report
    return report | recorded.compared(train, test, of_model, of_drag)


def verdict_lines(report: dict[str, Any]) -> list[str]:
    """The comparison as text."""
    flights = "1 held-out flight" if report["flights"] == 1 else f"{report['flights']} held-out flights"
    few = report["flights"] < LEAST_FLIGHTS
    lines = _more_lines(report) if few else []
    lines += [
        f"verdict on {flights}: RMSE relative to linear drag's, paired over flights, 95 % interval",
        "  (noise: an upper limit, from the change of the residual over two rows)",
    ]
    for output, row in report["outputs"].items():
        lines.append(f"  {output}  {'TOO FEW FLIGHTS TO TELL' if few else WORDS[row['verdict']]}: {row['text']}")
        lines.append(
            f"       RMSE {row['rmse']:.3g} m/s^2 (linear drag {row['drag_rmse']:.3g}): of it"
            f" noise at most {row['noise']:.3g},"
            f" the model's error at least {row['unexplained']:.3g}"
        )
    for row in report.get("beside", []):
        ratio = f"{row['this']:.3g} m/s^2 for {row['rms']:.3g}, ratio {row['text']}"
        lines.append(f"  all axes, beside {row['model']}: {ratio}")
    recorded = brought("services", "recorded_verdict") if report.get("identified") else None
    if recorded is None:
        return lines
    return lines + recorded.lines(report)


def _more_lines(report: Mapping[str, Any]) -> list[str]:
    """How to hold out as many flights as a verdict takes."""
    held_out = report["flights"]
    every = max(report["of"], 2 * LEAST_FLIGHTS + 1)  # most are still fitted
    said = f"{held_out} held-out flight{'s are' if held_out > 1 else ' is'} too few to tell, {LEAST_FLIGHTS} the least"
    share = math.ceil(100 * LEAST_FLIGHTS / every) / 100
    if every == report["of"]:
        return [f"{said}: model.holdout={share:g} holds out {LEAST_FLIGHTS} of these {every}"]
    duration = math.ceil(report["duration"] * every / report["of"] / 10) * 10
    more = "add flights" if report.get("identified") else f"collect.duration={duration}"
    return [f"{said}: collect {every} in all ({more}), and model.holdout={share:g} holds out {LEAST_FLIGHTS} of them"]
