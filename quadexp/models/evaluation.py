"""How well a model predicts flights that it was not fitted to: error, predictive density, calibration.

    rmse     sqrt(mean (a - mean)^2)                                                    unit of the output
    nlpd     mean [ (a - mean)^2 / (2 s^2) + log s + log(2 pi)/2 ], s^2 = variance + noise      nats per row
    inside_k share of the rows with |a - mean| < k s; a Gaussian has .683 for k = 1 and .954 for k = 2

Neighbouring rows of a flight are correlated, so whole flights are held out: a split by row would underestimate the
error.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.models.base import Callback, Model, Prediction
from quadexp.models.dataset import ResidualDataset
from quadexp.models.linear_drag import LinearDrag, fit_linear_drag
from quadexp.models.support import outside_shares
from quadexp.models.thrust_scale import has_thrust_scale, with_common_scale

Row = dict[str, Any]


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


def fit_with_report(
    dataset: ResidualDataset, kind: type[Model], settings: Any, *, callback: Callback | None = None
) -> Fit:
    """Fit a model without the held-out flights, report on these, then refit to all rows from there (settings.refit).

    settings: of `kind.fit`, with holdout, seed and, where there is a choice, refit.
    Raises DataError as `kind.fit` does, and where a single flight cannot be split.
    """
    if settings.holdout == 0:
        model = kind.fit(dataset, settings, callback=callback)
        return Fit(model, model, dataset, None, {"rows": [], "held_out_flights": [], "refitted": False})
    train, test = split_by_flight(dataset, settings.holdout, settings.seed)
    refit = getattr(settings, "refit", True) and getattr(settings, "method", "") != "exact"
    share = 0.8 if refit else 1.0
    first = kind.fit(train, settings, callback=_scaled(callback, 0.0, share), intervals=not refit)
    model = kind.fit(dataset, settings, start=first, callback=_scaled(callback, share, 1.0)) if refit else first
    report = {
        "rows": evaluate(first, train, test),
        "held_out_flights": sorted(set(map(str, test.columns["flight_name"]))),
        "refitted": refit,
        "out_of_range": outside_shares(first.feature_range, test),
    }
    return Fit(model, first, train, test, report)


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
            " with collect.duration, or hold none out: gp.holdout=0 for fit-gp, drag.holdout=0 for fit-drag"
        )
    count = int(np.clip(round(share * len(flights)), 1, len(flights) - 1))
    held_out = np.random.default_rng(seed).permutation(flights)[:count]
    test = np.isin(dataset.columns["flight"], held_out)
    return dataset.rows(~test), dataset.rows(test)


def evaluate(model: Model, train: ResidualDataset, test: ResidualDataset) -> list[Row]:
    """One row per output and predictor (the model, linear_drag, zero) with rmse, nlpd, inside_1, inside_2, n.

    train: rows that the baselines (linear drag, and the standard deviations) are fitted to.
    """
    drag = model if isinstance(model, LinearDrag) else drag_baseline(train)
    baseline = {} if drag is model else drag.predict(test)
    rows = []
    for output, of_model in model.predict(test).items():
        target = test.matrix([output])[:, 0]
        zero = Prediction(np.zeros(len(target)), None, float(np.mean(train.matrix([output]) ** 2)))
        for name, prediction in ((model.predictor, of_model), (drag.predictor, baseline.get(output)), ("zero", zero)):
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
        found = model.predict(data)
    except UsageError as error:
        raise UsageError(f"{label}: {error}; --after needs a checkpoint of fit-drag, fit-gp or fit-nn") from None
    columns = {output: data.matrix([output])[:, 0] - one.mean for output, one in found.items()}
    return ResidualDataset(dict(data.columns) | columns, dict(data.metadata) | {"after": label})


def drag_baseline(train: ResidualDataset, **options: Any) -> LinearDrag:
    """Linear drag of the train rows, the baseline of every comparison; options go to `fit_linear_drag`."""
    options = {"thrust": not has_thrust_scale(train), "intervals": False} | options
    return fit_linear_drag(with_common_scale(train).dataset, **options)


def score(target: np.ndarray, mean: np.ndarray, std: np.ndarray) -> Row:
    """rmse, nlpd, inside_1, inside_2, n of predictions (k,) with standard deviations (k,) for targets (k,)."""
    error, std = target - mean, np.maximum(std, 1e-12)
    scaled = error / std
    return {
        "rmse": float(np.sqrt(np.mean(error**2))),
        "nlpd": float(np.mean(0.5 * scaled**2 + np.log(std) + 0.5 * np.log(2 * np.pi))),
        "inside_1": float(np.mean(np.abs(scaled) < 1)),
        "inside_2": float(np.mean(np.abs(scaled) < 2)),
        "n": len(target),
    }


def _scaled(callback: Callback | None, low: float, high: float) -> Callback | None:
    if callback is None:
        return None
    return lambda message, done: callback(message, low + (high - low) * done)
