"""Held-out error over the number of inducing points, for each method of fitting.

sgpr    inducing points and hyperparameters by the variational bound, all rows
subset  exact GP on M rows chosen to cover the features (hyperparameters from the pilot rows)
exact   exact GP on as many rows as are feasible, independent of M
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from quadexp.config.settings import declared
from quadexp.learn.dataset import ResidualDataset
from quadexp.learn.evaluation import Row, score, split_by_flight
from quadexp.learn.gp_fit import Callback, fit_gp
from quadexp.learn.model import GPSettings
from quadexp.learn.predict import predict

SIZES = (5, 10, 20, 50, 100)
MAX_ROWS = 8000  # limits the run time to one or two minutes


def compare(
    dataset: ResidualDataset,
    settings: GPSettings | None = None,
    *,
    sizes: Sequence[int] = SIZES,
    methods: Sequence[str] = declared(GPSettings)["method"].words,
    max_rows: int | None = MAX_ROWS,
    callback: Callback | None = None,
) -> list[Row]:
    """One row per method, number of points and output: rmse, nlpd, inside_1, inside_2, fit_seconds, largest_weight.

    settings: of the fits; holdout (or .2 if 0) is the share of flights for the error. max_rows: limit on the rows of a
    fit; the actual number is in the result.
    """
    settings = settings or GPSettings()
    train, test = split_by_flight(dataset, settings.holdout or 0.2, settings.seed)
    cells = [(method, m) for method in methods for m in (sizes if method != "exact" else (None,))]
    rows: list[Row] = []
    for i, (method, m) in enumerate(cells):
        if callback is not None:
            callback(f"compare {method}" + (f" M={m}" if m else ""), i / len(cells))
        limit = settings.max_exact_rows if method == "exact" else max_rows
        values: dict[str, Any] = {"method": method, "inducing": m or settings.inducing, "max_rows": limit}
        chosen = replace(settings, **values)
        start = time.perf_counter()
        model = fit_gp(train, chosen, drag_intervals=False)
        seconds = time.perf_counter() - start
        for posterior in model.outputs:
            prediction = predict(model, test)[posterior.output]
            target = test.matrix([posterior.output])[:, 0]
            rows.append(
                {"method": method, "inducing": len(posterior.alpha), "rows": posterior.rows}
                | {"output": posterior.output, **score(target, prediction.mean, prediction.std)}
                | {"fit_seconds": seconds, "largest_weight": float(abs(posterior.alpha).max())}
            )
    if callback is not None:
        callback("compare done", 1.0)
    return rows
