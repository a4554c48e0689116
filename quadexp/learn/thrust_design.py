"""The regressors of a thrust curve, from the signal that the rotors were given; see quadexp.learn.thrust_curve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadexp.errors import DataError
from quadexp.learn.samples import Samples


def scaled_signal(
    signal: np.ndarray, voltage: np.ndarray | None, reference_voltage: float, exponent: float = 1.0
) -> np.ndarray:
    """s (V / V_ref)^g, (k, n); without a reference voltage the signal itself."""
    if not reference_voltage:
        return signal
    if voltage is None:
        raise DataError("the thrust curve uses the battery voltage, the flight has no column 'battery_voltage'")
    return signal * ((voltage / reference_voltage) ** exponent)[:, None]


def thrust_design(
    scaled: np.ndarray, powers: Sequence[int], *, intercept: bool, per_rotor: bool
) -> tuple[np.ndarray, list[str]]:
    """Columns of the curve, and their names: sum_i s_i^p, or s_i^p rotor by rotor; then 1 if there is an intercept."""
    if per_rotor:
        columns = [scaled[:, i] ** p for i in range(scaled.shape[1]) for p in powers]
        names = [f"c_{p}[{i}]" for i in range(scaled.shape[1]) for p in powers]
    else:
        columns = [np.sum(scaled**p, axis=1) for p in powers]
        names = [f"c_{p}" for p in powers]
    if intercept:
        columns, names = [*columns, np.ones(len(scaled))], [*names, "b_z"]
    return np.stack(columns, axis=1), names


def default_voltage(samples: Samples) -> float:
    """4 V a cell, the cells counted from the median voltage at 3.0 to 4.35 V each; 0 where no voltage is needed."""
    if samples.kind != "motor_command" or samples.voltage is None:
        return 0.0
    return 4.0 * max(1, round(float(np.median(samples.voltage)) / 3.8))
