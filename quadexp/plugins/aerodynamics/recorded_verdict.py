"""What the report of a fit to recorded flights says besides: the same verdict for the terms of `quadexp identify`,
fitted to the same rows, and which of these is taken (drag_choice.py)."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.models.base import AXIS, rms
from quadexp.models.common_scale import with_common_scale
from quadexp.models.dataset import ResidualDataset
from quadexp.models.verdict import paired_ratio
from quadexp.plugins.aerodynamics.drag_choice import chosen_drag, compare_drag, drag_line
from quadexp.plugins.aerodynamics.terms import MEANS, fit_term_mean


def compared(
    train: ResidualDataset, test: ResidualDataset, of_model: np.ndarray, of_drag: np.ndarray
) -> dict[str, Any]:
    """{air: records of compare_drag, identified: a record of each model}, JSON-able. of_model, of_drag: errors of the
    fit and of linear drag on the held-out rows, (k, 3), m/s^2."""
    flight, target = np.asarray(test.columns["flight"]), test.matrix(list(AXIS))
    together = {name: np.concatenate([train.columns[name], test.columns[name]]) for name in train.columns}
    order = np.argsort(together["flight"], kind="stable")
    every = ResidualDataset({name: column[order] for name, column in together.items()}, train.metadata)
    errors = {"this fit": of_model, "linear drag": of_drag}
    for kind in MEANS:
        with suppress(DataError):
            terms = fit_term_mean(with_common_scale(train).dataset, kind)
            errors[kind.replace("_", " ")] = target - terms.acceleration(test)
    identified = []
    for name, error in errors.items():
        record: dict[str, Any] = {"model": name, "rms": rms(error), "share": rms(error) / rms(target)}
        if error is not of_model:
            record |= paired_ratio(of_model, error, flight).record()
        identified.append(record)
    return {"air": compare_drag(every), "identified": identified}


def lines(report: Mapping[str, Any]) -> list[str]:
    """The same as text. report: of a fit, with what `compared` has found."""
    fit, *others = report["identified"]
    air = report.get("air", [])  # not in reports of earlier versions
    by_name = {row["model"].removesuffix(" drag").replace(" ", "_"): row for row in others}
    best = by_name.get(chosen_drag(air) or "", min(others, key=lambda row: row["rms"]))
    texts = [f"  {drag_line(air)}"] if air else []
    shares = ", ".join(f"{row['model']} {100 * row['share']:.1f} %" for row in report["identified"])
    texts.append(f"  error on the held-out flights relative to the thrust curve alone: {shares}")
    if best["rms"] < fit["rms"]:
        texts.append(
            f"  USE {best['model'].upper()} of `quadexp identify`, not this fit: its error is"
            f" {100 * best['share']:.1f} %, that of this fit {100 * fit['share']:.1f} %"
        )
    elif best["verdict"] == "better":
        beside = f"every model of `quadexp identify` ({best['text']} of {best['model']})"
        texts.append(f"  this fit has a smaller error than {beside}")
    else:
        name = f"{best['model']} of `quadexp identify` ({best['text']})"
        texts.append(f"  not shown to be better than {name}, the simpler model")
    return texts
