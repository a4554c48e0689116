"""Whether a fit predicts better than linear drag and identified terms on held-out flights, and how far from the noise.

Per axis and held-out flight f let g_f and d_f be the RMSEs of the fit and of linear drag (fitted to the same rows).
Flights, not rows, are independent, so the comparison is paired over flights:

    ratio = exp(mean_f log(g_f / d_f)),     95 % interval by Student's t over the flights

better: the whole interval is below 1. worse: it is above 1. open: neither, or one held-out flight only.

The noise of the data is estimated as half the variogram of a flight's residual r at LAG rows,

    noise^2 = mean (r_k - r_{k + LAG})^2 / 2,       unexplained^2 = rmse^2 - noise^2

taking the least over the predictors. LAG = 2, because targets from differences of a noisy velocity are anticorrelated
between neighbours. Noise that a filter spreads over more rows counts as unexplained; an effect shorter than LAG rows
counts as noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.models.base import AXIS, rms
from quadexp.models.dataset import DT_RANGE, ResidualDataset
from quadexp.models.evaluation import drag_baseline, split_by_flight
from quadexp.models.gaussian_process import GPModel, GPSettings
from quadexp.models.terms import MEANS, fit_term_mean
from quadexp.models.thrust_scale import has_thrust_scale, with_common_scale

LAG = 2
CONFIDENCE = 0.95
TRIAL_ROWS = 3000  # of the short fits that try other features
TRIAL_ITERATIONS = 40
WORDS = {"better": "BETTER than linear drag", "worse": "WORSE than linear drag", "open": "NOT SHOWN TO BE BETTER"}


class Ratio(NamedTuple):
    """Ratio of two RMSEs paired over flights, with its 95 % interval (NaN with one flight)."""

    value: float
    low: float
    high: float
    flights: int

    @property
    def verdict(self) -> str:
        return "better" if self.high < 1 else "worse" if self.low > 1 else "open"

    def __str__(self) -> str:
        if np.isnan(self.low):
            return f"{self.value:.3g} (one held-out flight: no interval)"
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


def paired_ratio(error: np.ndarray, other: np.ndarray, flight: np.ndarray) -> Ratio:
    """Ratio of the RMSEs of two predictors' errors, (k,) or (k, 3) each, paired over flights (k,)."""
    from scipy.stats import t as student_t

    logs = []
    for index in np.unique(flight):
        mean, base = (max(float(np.mean(values[flight == index] ** 2)), 1e-24) for values in (error, other))
        logs.append(0.5 * np.log(mean / base))
    n, middle = len(logs), float(np.mean(logs))
    if n < 2:
        return Ratio(float(np.exp(middle)), np.nan, np.nan, n)
    half = student_t.ppf(0.5 + CONFIDENCE / 2, n - 1) * float(np.std(logs, ddof=1)) / np.sqrt(n)
    return Ratio(float(np.exp(middle)), float(np.exp(middle - half)), float(np.exp(middle + half)), n)


def noise_floor(residuals: Sequence[np.ndarray], dataset: ResidualDataset) -> float:
    """Noise of an output (see the module), the least over the residuals (k,) of several predictors; NaN if unknown."""
    t, flight = np.asarray(dataset.columns["t"], float), np.asarray(dataset.columns["flight"])
    step = float(np.median(np.asarray(dataset.columns["dt"], float)))
    gap = t[LAG:] - t[:-LAG]
    together = (flight[LAG:] == flight[:-LAG]) & (gap > 0) & (gap < DT_RANGE[1] * LAG * step)
    if not together.any():
        return float("nan")
    return min(float(np.sqrt(np.mean((r[LAG:] - r[:-LAG])[together] ** 2) / 2)) for r in residuals)


def verdict(
    model: GPModel, train: ResidualDataset, test: ResidualDataset, settings: GPSettings, *, search: bool = True
) -> dict[str, Any]:
    """Comparison that `fit-gp` reports, JSON-able: outputs {a_x: {...}} and, for recorded flights, identified [...].

    model: fitted to train. search: where the fit is not better, try other features.
    """
    flight = np.asarray(test.columns["flight"])
    errors = test.matrix(list(AXIS)) - drag_baseline(train).acceleration(test)
    predictions, of_gp = model.predict(test), errors.copy()
    outputs: dict[str, Any] = {}
    for output, axis in ((name, axis) for name, axis in AXIS.items() if name in predictions):
        of_gp[:, axis] = test.matrix([output])[:, 0] - predictions[output].mean
        error, of_drag = of_gp[:, axis], errors[:, axis]
        ratio, rmse, floor = paired_ratio(error, of_drag, flight), rms(error), noise_floor([error, of_drag], test)
        outputs[output] = _record(ratio) | {
            "rmse": rmse, "drag_rmse": rms(of_drag), "noise": floor,
            "unexplained": float(np.sqrt(max(rmse**2 - floor**2, 0.0))), "features": list(settings.features[output]),
        }  # fmt: skip
        if search and ratio.verdict != "better":
            outputs[output]["instead"] = better_features(output, train, test, settings)
    report: dict[str, Any] = {"outputs": outputs, "flights": len(np.unique(flight))}
    if has_thrust_scale(train):
        report["identified"] = _identified(train, test, of_gp, flight)
    return report


def _record(ratio: Ratio) -> dict[str, Any]:
    ends = (None, None) if np.isnan(ratio.low) else (ratio.low, ratio.high)
    return {"verdict": ratio.verdict, "ratio": ratio.value, "low": ends[0], "high": ends[1], "text": str(ratio)}


def candidates(output: str, asked: Sequence[str], *, recorded: bool) -> list[tuple[str, ...]]:
    """Feature sets to try besides those asked for; with thrust only for simulated flights, which share its scale."""
    own = f"v_{output[-1]}"
    thrust = () if recorded else ("thrust",)
    sets = [(own,), ("v_x", "v_y", "v_z"), (own, *thrust), ("v_x", "v_y", "v_z", *thrust)]
    return [names for names in dict.fromkeys(sets) if set(names) != set(asked)]


def better_features(
    output: str, train: ResidualDataset, test: ResidualDataset, settings: GPSettings
) -> dict[str, Any] | None:
    """The features of `candidates` with the least error on part of the train flights, and their ratio on the test ones.

    The choice uses short fits and no test flights. None where there are too few flights, or none can be fitted.
    """
    if len(train.flights) < 2:
        return None
    fitted, judge = split_by_flight(train, 0.3, settings.seed)
    scores: dict[tuple[str, ...], float] = {}
    for names in candidates(output, settings.features[output], recorded=has_thrust_scale(train)):
        try:
            error = _trial_errors(output, names, fitted, judge, settings)
        except DataError:
            continue
        scores[names] = rms(error)
    if not scores:
        return None
    best = min(scores, key=scores.__getitem__)
    axis = AXIS[output]
    drag = test.matrix([output])[:, 0] - drag_baseline(train).acceleration(test)[:, axis]
    ratio = paired_ratio(_trial_errors(output, best, train, test, settings), drag, np.asarray(test.columns["flight"]))
    return {"features": list(best), **_record(ratio)}


def _trial_errors(
    output: str, features: tuple[str, ...], train: ResidualDataset, test: ResidualDataset, settings: GPSettings
) -> np.ndarray:
    """Errors (k,) on the test rows, of a short fit to some of the train rows."""
    few = replace(
        settings, features={output: features}, method="sgpr", max_rows=TRIAL_ROWS, max_iterations=TRIAL_ITERATIONS,
        inducing=min(settings.inducing, 30),
    )  # fmt: skip
    return test.matrix([output])[:, 0] - GPModel.fit(train, few, intervals=False).predict(test)[output].mean


def _identified(
    train: ResidualDataset, test: ResidualDataset, of_gp: np.ndarray, flight: np.ndarray
) -> list[dict[str, Any]]:
    """Terms of `quadexp identify` fitted to the same rows: RMS of their error vectors, and the fit's ratio to it."""
    rows = with_common_scale(train).dataset
    target = test.matrix(["a_x", "a_y", "a_z"])
    errors = {"this fit": of_gp, "linear drag": target - drag_baseline(train).acceleration(test)}
    for kind in MEANS:
        with suppress(DataError):
            errors[kind.replace("_", " ")] = target - fit_term_mean(rows, kind).acceleration(test)
    records: list[dict[str, Any]] = [
        {"model": name, "rms": rms(e), "share": rms(e) / rms(target)} for name, e in errors.items()
    ]
    for record in records[1:]:
        record |= _record(paired_ratio(of_gp, errors[record["model"]], flight))
    return records


def verdict_lines(report: dict[str, Any]) -> list[str]:
    """The comparison as text."""
    flights = "1 held-out flight" if report["flights"] == 1 else f"{report['flights']} held-out flights"
    lines = [
        f"verdict on {flights}: RMSE relative to linear drag's, paired over flights, 95 % interval",
        "  (noise: from the variogram of the residual at a lag of two rows, an upper bound)",
    ]
    for output, one in report["outputs"].items():
        lines.append(f"  {output}  {WORDS[one['verdict']]}: {one['text']}")
        lines.append(
            f"       RMSE {one['rmse']:.3g} m/s^2 (linear drag {one['drag_rmse']:.3g}): noise of the data at most"
            f" {one['noise']:.3g}, unexplained at least {one['unexplained']:.3g}"
        )
        if one["verdict"] == "better":
            continue
        other = one.get("instead")
        if other and other["verdict"] == "better":
            names = ",".join(other["features"])
            lines.append(f"       features that are better: {names} ({other['text']}): gp.features.{output}=[{names}]")
        elif other:
            tried = f"the best, {', '.join(other['features'])}, has {other['text']}"
            lines.append(f"       no other features are shown to be better either ({tried}): linear drag suffices here")
        else:
            lines.append(
                "       other features were not tried: that needs two flights for the fit and one for the comparison"
            )
    if report.get("identified"):
        lines += _identified_lines(report["identified"])
    return lines


def _identified_lines(records: Sequence[dict[str, Any]]) -> list[str]:
    fit, *others = records
    best = min(others, key=lambda one: one["rms"])
    text = ", ".join(f"{one['model']} {100 * one['share']:.1f} %" for one in records)
    lines = [f"  error on the held-out flights relative to the thrust curve alone: {text}"]
    if best["rms"] < fit["rms"]:
        lines.append(
            f"  USE {best['model'].upper()} of `quadexp identify`, not this fit: its error is"
            f" {100 * best['share']:.1f} %, that of this fit {100 * fit['share']:.1f} %"
        )
    elif best["verdict"] == "better":
        lines.append(
            f"  this fit has a smaller error than every model of `quadexp identify` ({best['text']} of {best['model']})"
        )
    else:
        lines.append(
            f"  not shown to be better than {best['model']} of `quadexp identify` ({best['text']}), the simpler model"
        )
    return lines
