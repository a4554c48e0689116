"""Model selection by cross-validation over flights: root mean square errors in sample and on held-out flights.

Samples of one flight share battery, constant offsets and path, so a split by sample would favour models with many
coefficients. Every model is fitted completely in each fold, its thrust curve included.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.models.base import rms
from quadexp.models.residual import AXES
from quadexp.models.samples import Samples
from quadexp.models.thrust_curve import ThrustCurve, fit_thrust_samples, thrust_columns
from quadexp.models.vehicle_model import KINDS, LEVEL_NAMES, LEVELS, FitSettings, fit_level

MOST_FOLDS = 10
HOVER_INFLOW = "blade_element_still"  # key of the blade-element model whose induced velocity is that of hover
MOST_SAMPLES = 20_000  # of the comparisons of models and of curves; more are thinned evenly
CURVES = ((1, 2), (1,), (2,))  # powers of motor_command that are compared


def rmse(residual: np.ndarray) -> dict[str, float]:
    """Root mean square per axis, and of the vector (m/s^2)."""
    square = np.mean(residual**2, axis=0)
    return {**dict(zip(AXES, np.sqrt(square).tolist(), strict=True)), "norm": float(np.sqrt(square.sum()))}


def selection(samples: Samples, settings: FitSettings, momentum: float = 0.0) -> list[dict[str, Any]]:
    """RMSE of every model in sample and on held-out flights.

    Returns per model {level, name, in_sample {x, y, z, norm}, held_out the same, trimmed the same, per_flight
    {name: norm}, note}. trimmed: held-out error after subtracting each flight's mean residual, which integral action in
    a controller would remove. With one flight held_out and trimmed are None. If the rotors' radius is known there are
    two blade-element models, with induced velocity and without (HOVER_INFLOW). With two flights, a fitted voltage
    exponent is taken from both: one flight does not determine it.
    """
    samples = samples.thinned(MOST_SAMPLES)
    if settings.voltage_exponent is None and len(samples.names) == 2:
        curve, _ = _curve_residual(samples, samples, settings)
        settings = replace(settings, voltage_exponent=curve.voltage_exponent)
    chosen = [level for level in LEVELS if level not in KINDS or level in ("linear", *settings.kinds)]
    rungs = [(level, level, LEVEL_NAMES[level], momentum) for level in chosen]
    if momentum and "blade_element" in chosen:
        rungs[-1] = ("blade_element", "blade_element", "blade element, with V_I", momentum)
        rungs.append((HOVER_INFLOW, "blade_element", "blade element, no V_I", 0.0))
    rows: list[dict[str, Any]] = []
    for rung, level, name, momentum in rungs:
        row: dict[str, Any] = {"level": rung, "name": name, "in_sample": None, "held_out": None}
        row |= {"trimmed": None, "per_flight": {}, "note": ""}
        rows.append(row)
        try:
            row["in_sample"] = rmse(fit_level(level, samples, settings, momentum, intervals=False).residual(samples))
            left = left_out(level, samples, settings, momentum)
        except DataError as error:
            row["note"] = str(error)
            continue
        if left:
            row["per_flight"] = {name: rmse(residual)["norm"] for name, residual in left.items()}
            row["held_out"] = rmse(np.concatenate(list(left.values())))
            row["trimmed"] = rmse(np.concatenate([residual - residual.mean(axis=0) for residual in left.values()]))
    return rows


def left_out(level: str, samples: Samples, settings: FitSettings, momentum: float = 0.0) -> dict[str, np.ndarray]:
    """Residual of every flight, (k, 3) (m/s^2), under the fit to the others; {} with one flight.

    Up to MOST_FOLDS flights are held out one by one; of more, every MOST_FOLDS-th together.
    """
    count = len(samples.names)
    folds = min(count, MOST_FOLDS) if count > 1 else 0
    residuals: dict[int, np.ndarray] = {}
    for fold in range(folds):
        out = samples.flight % folds == fold
        rest, left = samples.rows(~out), samples.rows(out)
        residual = fit_level(level, rest, settings, momentum, intervals=False).residual(left)
        residuals |= {index: residual[left.flight == index] for index in range(fold, count, folds)}
    return {name: residuals[index] for index, name in enumerate(samples.names) if index in residuals}


def compare_curves(samples: Samples, settings: FitSettings) -> list[dict[str, Any]]:
    """RMSE along z, in sample and held out, of thrust curves on motor commands; [] for other signals.

    Records {powers, voltage ("unused", "V" or "V^g"), exponent, in_sample, held_out, halves_out (or None), note}.
    held_out: on held-out flights. halves_out: with two flights, on held-out half flights, because the effect of the
    battery voltage cannot be learned from one flight alone.
    """
    samples = samples.thinned(MOST_SAMPLES)
    count = len(samples.names)
    by_flight = samples.flight % min(count, MOST_FOLDS) if count > 1 else None
    by_half = 2 * samples.flight + _second_half(samples.flight) if count == 2 else None
    if samples.kind != "motor_command":
        return []
    rows = []
    for powers in CURVES:
        for voltage in ("unused", "V", "V^g") if samples.voltage is not None else ("unused",):
            exponent = None if voltage == "V^g" else 1.0
            own = replace(settings, powers=powers, voltage_exponent=exponent, kinds=("linear",))
            own = replace(own, reference_voltage=0.0) if voltage == "unused" else own
            row: dict[str, Any] = {"powers": list(powers), "voltage": voltage, "in_sample": None, "held_out": None}
            rows.append(row | {"halves_out": None, "exponent": None, "note": ""})
            try:
                curve, residual = _curve_residual(samples, samples, own)
                rows[-1] |= {"in_sample": rms(residual), "exponent": curve.voltage_exponent}
                for key, fold in (("held_out", by_flight), ("halves_out", by_half)):
                    rows[-1][key] = None if fold is None else _curve_left_out(samples, own, fold)
            except DataError as error:
                rows[-1]["note"] = str(error)
    return rows


def _second_half(flight: np.ndarray) -> np.ndarray:
    """1 in the second half of each flight's rows, (k,), 0 in the first."""
    sizes = np.bincount(flight)
    return (2 * (np.arange(len(flight)) - (np.cumsum(sizes) - sizes)[flight]) >= sizes[flight]).astype(int)


def _curve_residual(train: Samples, test: Samples, settings: FitSettings) -> tuple[ThrustCurve, np.ndarray]:
    """A curve fitted together with d_z to some samples, and its residual along z on others, (k,) (m/s^2)."""
    curve, regression = fit_thrust_samples(train, settings, intervals=False)
    return curve, test.force[:, 2] - thrust_columns(curve, test, drag=True) @ regression.coefficients


def _curve_left_out(samples: Samples, settings: FitSettings, fold: np.ndarray) -> float:
    left = [_curve_residual(samples.rows(fold != i), samples.rows(fold == i), settings)[1] for i in np.unique(fold)]
    return rms(np.concatenate(left))


def best_level(rows: Sequence[Mapping[str, Any]], levels: Sequence[str] = (*KINDS, HOVER_INFLOW)) -> str:
    """The model of `levels` with the least held-out error (in sample where nothing was held out); "linear" if none."""
    scored = {}
    for row in rows:
        score = row["held_out"] or (row["in_sample"] if all(r["held_out"] is None for r in rows) else None)
        if row["level"] in levels and score is not None and not row["note"]:
            scored[row["level"]] = score["norm"]
    return min(scored, key=scored.__getitem__) if scored else "linear"


def flight_by_flight(samples: Samples, settings: FitSettings) -> list[dict[str, Any]]:
    """Linear drag fitted to every flight alone: {flight, rows, coefficients, thrust} or {flight, rows, note}."""
    records = []
    for index, name in enumerate(samples.names):
        alone = replace(samples.rows(samples.flight == index), names=(name,))
        record: dict[str, Any] = {"flight": name, "rows": len(alone)}
        try:
            fit = fit_level("linear", alone, settings)
            records.append(record | {"coefficients": fit.terms.records(), "thrust": str(fit.curve)})
        except DataError as error:
            records.append(record | {"note": str(error)})
    return records
