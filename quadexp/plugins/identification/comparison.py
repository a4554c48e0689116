"""Models of a vehicle, and thrust curves, compared by cross-validation over flights.

Samples of one flight share battery, constant offsets and path, so a split by sample would favour models with many
coefficients. Every model is fitted completely in each fold, its thrust curve included.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.models.base import rms
from quadexp.models.residual import AXES
from quadexp.names import named
from quadexp.plugins.identification.thrust_curve import ThrustCurve, fit_thrust_samples, thrust_columns
from quadexp.plugins.identification.vehicle_model import (
    HOVER_INFLOW,
    KINDS,
    LEVEL_NAMES,
    LEVELS,
    FitSettings,
    fit_level,
)
from quadexp.plugins.logs.samples import Samples

MOST_FOLDS = 10  # flights that are held out one by one; each costs a fit
MOST_SAMPLES = 20_000  # of the comparisons of models and of curves; more are thinned evenly
CURVES = ((1, 2), (1,), (2,))  # powers of motor_command that are compared
LEAST_IMPROVEMENT = 0.02  # relative, of the held-out error along z: another thrust curve replaces c_1, c_2 from here on
EXPONENT_IMPROVEMENT = 0.1  # the same, for a fitted voltage exponent to replace 1
EXPONENTS = (0.5, 1.5)  # plausible voltage exponents of a motor; outside, flights differ in something else


def rmse(residual: np.ndarray) -> dict[str, float]:
    """Root mean square per axis, and of the vector (m/s^2)."""
    square = np.mean(residual**2, axis=0)
    return {**named(AXES, np.sqrt(square).tolist()), "norm": float(np.sqrt(square.sum()))}


def selection(samples: Samples, settings: FitSettings, momentum: float = 0.0) -> list[dict[str, Any]]:
    """RMSE of every model in sample and on held-out flights.

    Returns per model {level, name, in_sample {x, y, z, norm}, held_out the same, note}. With one flight held_out is
    None. If the rotors' radius is known there are two blade-element models, with induced velocity and without
    (HOVER_INFLOW). With two flights, a fitted voltage exponent is taken from both: one flight does not determine it.
    """
    samples = samples.thinned(MOST_SAMPLES)
    if settings.voltage_exponent is None and len(samples.names) == 2:
        curve, _ = _curve_residual(samples, samples, settings)
        settings = replace(settings, voltage_exponent=curve.voltage_exponent)
    rows = []
    for level in LEVELS:
        if level in KINDS and level not in ("linear", *settings.kinds):
            continue
        if level == "blade_element" and momentum:
            rows.append(_selection_row(level, level, "blade element, with V_I", samples, settings, momentum))
            rows.append(_selection_row(HOVER_INFLOW, level, "blade element, no V_I", samples, settings))
        else:
            rows.append(_selection_row(level, level, LEVEL_NAMES[level], samples, settings))
    return rows


def _selection_row(
    key: str, level: str, name: str, samples: Samples, settings: FitSettings, momentum: float = 0.0
) -> dict[str, Any]:
    """See `selection`. key: the level in the table."""
    row: dict[str, Any] = {"level": key, "name": name, "in_sample": None, "held_out": None, "note": ""}
    try:
        fit = fit_level(level, samples, settings, momentum, intervals=False)
        row["in_sample"] = rmse(fit.residual(samples))
        held_out = left_out(level, samples, settings, momentum)
        if held_out:
            row["held_out"] = rmse(np.concatenate(list(held_out.values())))
    except DataError as error:
        row["note"] = str(error)
    return row


def left_out(level: str, samples: Samples, settings: FitSettings, momentum: float = 0.0) -> dict[str, np.ndarray]:
    """Residual of every flight, (k, 3) (m/s^2), under the fit to the others; {} with one flight.

    Up to MOST_FOLDS flights are held out one by one; of more, every MOST_FOLDS-th together.
    """
    residuals = {}
    for fitted, tested in _folds(samples, by_flight(samples)):
        residual = fit_level(level, fitted, settings, momentum, intervals=False).residual(tested)
        for index in np.unique(tested.flight):
            residuals[samples.names[index]] = residual[tested.flight == index]
    return residuals


def by_flight(samples: Samples) -> np.ndarray | None:
    """Fold of every sample, (k,), None for one flight."""
    count = len(samples.names)
    if count < 2:
        return None
    return samples.flight % min(count, MOST_FOLDS)


def _folds(samples: Samples, fold: np.ndarray | None) -> list[tuple[Samples, Samples]]:
    """What is fitted and what is tested, for every fold."""
    if fold is None:
        return []
    return [(samples.rows(fold != number), samples.rows(fold == number)) for number in np.unique(fold)]


def compare_curves(samples: Samples, settings: FitSettings) -> list[dict[str, Any]]:
    """RMSE along z, in sample and held out, of thrust curves on motor commands; [] for other signals.

    Records {powers, voltage ("unused", "V" or "V^g"), exponent, in_sample, held_out, halves_out (or None), note}.
    held_out: on held-out flights. halves_out: with two flights, on held-out half flights, because the effect of the
    battery voltage cannot be learned from one flight alone.
    """
    if samples.kind != "motor_command":
        return []
    samples = samples.thinned(MOST_SAMPLES)
    flight = samples.flight
    halves = None
    if len(samples.names) == 2:
        sizes = np.bincount(flight)
        first = np.cumsum(sizes) - sizes
        place = np.arange(len(flight)) - first[flight]  # in its flight
        halves = 2 * flight + (2 * place >= sizes[flight])
    folds = {"held_out": _folds(samples, by_flight(samples)), "halves_out": _folds(samples, halves)}
    voltages = ("unused",) if samples.voltage is None else ("unused", "V", "V^g")
    rows = []
    for powers, voltage in product(CURVES, voltages):
        of_curve = replace(
            settings,
            powers=powers,
            voltage_exponent=None if voltage == "V^g" else 1.0,
            reference_voltage=0.0 if voltage == "unused" else settings.reference_voltage,
        )
        row: dict[str, Any] = {"powers": list(powers), "voltage": voltage, "exponent": None, "note": ""}
        row |= {"in_sample": None, "held_out": None, "halves_out": None}
        rows.append(row)
        try:
            curve, residual = _curve_residual(samples, samples, of_curve)
            row["in_sample"] = rms(residual)
            row["exponent"] = curve.voltage_exponent
            for key, parts in folds.items():
                residuals = [_curve_residual(*part, of_curve)[1] for part in parts]
                if residuals:
                    row[key] = rms(np.concatenate(residuals))
        except DataError as error:
            row["note"] = str(error)
    return rows


def _curve_residual(train: Samples, test: Samples, settings: FitSettings) -> tuple[ThrustCurve, np.ndarray]:
    """A curve fitted together with d_z to some samples, and its residual along z on others, (k,) (m/s^2)."""
    curve, regression = fit_thrust_samples(train, settings, intervals=False)
    return curve, test.force[:, 2] - thrust_columns(curve, test) @ regression.coefficients


def best_level(rows: Sequence[Mapping[str, Any]], levels: Sequence[str] = (*KINDS, HOVER_INFLOW)) -> str:
    """The model of `levels` with the least held-out error (in sample where nothing was held out); "linear" if none."""
    key = "held_out" if any(row["held_out"] for row in rows) else "in_sample"
    scored = {}
    for row in rows:
        if row["level"] in levels and row[key] and not row["note"]:
            scored[row["level"]] = row[key]["norm"]
    return min(scored, key=scored.__getitem__, default="linear")


def chosen_curve(curves: Sequence[Mapping[str, Any]], settings: FitSettings) -> FitSettings:
    """The settings with the curve of `compare_curves` of least held-out error (by half flights where there are such).

    The default, c_1 s + c_2 s^2 of s V/V_ref, stays unless another is better by LEAST_IMPROVEMENT. V^g is fitted where
    that is better by EXPONENT_IMPROVEMENT, with g within EXPONENTS, on two flights or more.
    """
    key = "halves_out" if any(row["halves_out"] is not None for row in curves) else "held_out"
    scored = [row for row in curves if row[key] is not None]

    def best(rows: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
        return min(rows, key=lambda row: row[key], default=None)

    with_voltage = [row for row in scored if row["voltage"] == "V"]
    plain = with_voltage or [row for row in scored if row["voltage"] == "unused"]
    least = best(plain)
    if least is None:
        return settings
    usual = best([row for row in plain if tuple(row["powers"]) == (1, 2)])
    if least is not usual and (usual is None or least[key] < (1 - LEAST_IMPROVEMENT) * usual[key]):
        settings = replace(settings, powers=tuple(least["powers"]))
    low, high = EXPONENTS
    fitted = best([row for row in scored if row["voltage"] == "V^g" and low <= row["exponent"] <= high])
    if fitted is not None and fitted[key] < (1 - EXPONENT_IMPROVEMENT) * least[key]:
        settings = replace(settings, powers=tuple(fitted["powers"]), voltage_exponent=None)
    return settings
