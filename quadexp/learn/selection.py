"""Which model a flight that was not seen speaks for: root mean squares in the fit, and flight by flight left out.

Samples of one flight are alike (trim, battery, the path flown), so a split by sample would flatter every model that has
enough coefficients. Each rung of the ladder is fitted whole, its own thrust curve with it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.learn.samples import Samples
from quadexp.learn.terms import AXES
from quadexp.learn.thrust_curve import ThrustCurve, fit_thrust_samples, thrust_columns
from quadexp.learn.vehicle_fit import LEVEL_NAMES, LEVELS, FitSettings, fit_level
from quadexp.learn.vehicle_model import KINDS

MOST_FOLDS = 10
STILL = "blade_element_still"  # the rung of the blade element whose induced velocity is taken as it is in hover
MOST_ROWS = 20_000  # of the ladder and of the comparison of curves, where more flights' rows are thinned evenly
CURVES = ((1, 2), (1,), (2,))  # powers of motor_command that are compared


def rmse(residual: np.ndarray) -> dict[str, float]:
    """Root mean square per axis, and of the vector (m/s^2)."""
    square = np.mean(residual**2, axis=0)
    return {**dict(zip(AXES, np.sqrt(square).tolist(), strict=True)), "norm": float(np.sqrt(square.sum()))}


def selection(samples: Samples, settings: FitSettings, momentum: float = 0.0) -> list[dict[str, Any]]:
    """The ladder: RMSE of every level on its own flights, and on flights left out in turn.

    Returns per level {level, name, in_sample {x, y, z, norm}, held_out the same, trimmed the same, per_flight
    {name: norm}, note}. trimmed: of the flights left out with each one's own mean residual taken away, what is left to
    a controller with integral action. With one flight nothing can be left out: held_out and trimmed are None.
    With the rotors' radius known there are two rungs of the blade element, with induced velocity and without (STILL).
    Of two flights, a voltage exponent that is fitted is that of both: one alone does not tell it.
    """
    samples = samples.thinned(MOST_ROWS)
    if settings.voltage_exponent is None and len(samples.names) == 2:
        curve, _ = _curve_residual(samples, samples, settings)
        settings = replace(settings, voltage_exponent=curve.voltage_exponent)
    chosen = [level for level in LEVELS if level not in KINDS or level in ("linear", *settings.kinds)]
    rungs = [(level, level, LEVEL_NAMES[level], momentum) for level in chosen]
    if momentum and "blade_element" in chosen:
        rungs[-1] = (*rungs[-1][:2], "blade element, with V_I", momentum)
        rungs.append((STILL, "blade_element", "blade element, no V_I", 0.0))
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
    """Residual of every flight, (k, 3) (m/s^2), to the fit without it; {} with one flight.

    Up to MOST_FOLDS flights are left out one by one; of more, every MOST_FOLDS-th together.
    """
    count = len(samples.names)
    folds = min(count, MOST_FOLDS) if count > 1 else 0
    found: dict[int, np.ndarray] = {}
    for fold in range(folds):
        out = samples.flight % folds == fold
        rest, left = samples.rows(~out), samples.rows(out)
        residual = fit_level(level, rest, settings, momentum, intervals=False).residual(left)
        found |= {index: residual[left.flight == index] for index in range(fold, count, folds)}
    return {name: found[index] for index, name in enumerate(samples.names) if index in found}


def compare_curves(samples: Samples, settings: FitSettings) -> list[dict[str, Any]]:
    """RMSE along z, in sample and left out, of other thrust curves on motor commands; [] for other signals.

    Rows {powers, voltage ("unused", "V" or "V^g"), exponent, in_sample, held_out, halves_out (or None), note}.
    held_out: on flights left out. halves_out: with two flights, on half a flight left out in turn; what the voltage
    does from battery to battery takes two flights to see, and a fit to one cannot be blamed for not knowing it.
    """
    samples = samples.thinned(MOST_ROWS)
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


def _curve_residual(rest: Samples, seen: Samples, settings: FitSettings) -> tuple[ThrustCurve, np.ndarray]:
    """A curve with d_z beside it fitted to some rows, and what it leaves along z of others, (k,) (m/s^2)."""
    curve, found = fit_thrust_samples(
        rest, reference_voltage=settings.reference_voltage, voltage_exponent=settings.voltage_exponent,
        powers=settings.powers, intercept=settings.thrust_intercept, per_rotor=settings.per_rotor,
        loss=settings.loss, intervals=False,
    )  # fmt: skip
    return curve, seen.force[:, 2] - thrust_columns(curve, seen, drag=True) @ found.coefficients


def _curve_left_out(samples: Samples, settings: FitSettings, fold: np.ndarray) -> float:
    left = [_curve_residual(samples.rows(fold != i), samples.rows(fold == i), settings)[1] for i in np.unique(fold)]
    return rms(np.concatenate(left))


def rms(values: np.ndarray) -> float:
    """Root mean square of (k,)."""
    return float(np.sqrt(np.mean(values**2)))


def best_level(rows: Sequence[Mapping[str, Any]], levels: Sequence[str] = (*KINDS, STILL)) -> str:
    """The rung of `levels` with the least held-out error (in-sample where nothing was held out), linear at least."""
    scored = {}
    for row in rows:
        score = row["held_out"] or (row["in_sample"] if all(r["held_out"] is None for r in rows) else None)
        if row["level"] in levels and score is not None and not row["note"]:
            scored[row["level"]] = score["norm"]
    return min(scored, key=scored.__getitem__) if scored else "linear"


def flight_by_flight(samples: Samples, settings: FitSettings) -> list[dict[str, Any]]:
    """Linear drag of every flight alone: {flight, rows, coefficients} or {flight, note}; what differs between them."""
    found = []
    for index, name in enumerate(samples.names):
        own = samples.rows(samples.flight == index)
        try:
            fit = fit_level("linear", replace(own, names=(name,)), settings)
            found.append({"flight": name, "rows": len(own), "coefficients": fit.terms.rows(), "thrust": str(fit.curve)})
        except DataError as error:
            found.append({"flight": name, "rows": len(own), "note": str(error)})
    return found
