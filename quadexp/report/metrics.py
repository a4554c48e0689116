"""How well a flight followed its reference.

With e the position error (m), phi the angle of the rotation between attitude and reference (rad):

    rmse = sqrt(mean ||e||^2)    mean_error = mean ||e||    max_error = max ||e||    attitude_rmse = sqrt(mean phi^2)
    heading_rmse = sqrt(mean psi^2), psi the difference of the azimuths of y_body, which a prescribed yaw commands

Torrente et al. 2021 print mean ||e|| under the name RMSE. All samples of the flight count, ramps included.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.log.schema import Flight
from quadexp.physics.state import ATTITUDE, POSITION, VELOCITY

SATURATION_MARGIN = 1e-6  # share of the thrust range within which a rotor counts as at its limit

# Columns of a result row that are errors, with the factor and unit in which they are printed.
SHOWN = {"rmse": (1e3, "mm"), "mean_error": (1e3, "mm"), "max_error": (1e3, "mm")}


def position_error(flight: Flight) -> np.ndarray:
    """Distance to the reference, (k,) (m)."""
    return np.linalg.norm(flight.state[:, POSITION] - flight.reference_state[:, POSITION], axis=1)


def attitude_error(flight: Flight) -> np.ndarray:
    """Angle of the rotation between attitude and reference, (k,) (rad), in [0, pi].

    4 atan2(|a - b|, |a + b|) of the unit quaternions a and b, the sign of b such that |a - b| is the smaller one.
    """
    a, b = (
        q / np.linalg.norm(q, axis=1, keepdims=True)
        for q in (flight.state[:, ATTITUDE], flight.reference_state[:, ATTITUDE])
    )
    apart, together = np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1)
    return 4 * np.arctan2(np.minimum(apart, together), np.maximum(apart, together))


def heading_error(flight: Flight) -> np.ndarray:
    """Azimuth of y_body minus that of the reference, (k,) (rad), in [-pi, pi]."""
    found, wanted = (_azimuth(q) for q in (flight.state[:, ATTITUDE], flight.reference_state[:, ATTITUDE]))
    return np.remainder(found - wanted + np.pi, 2 * np.pi) - np.pi


def _azimuth(q: np.ndarray) -> np.ndarray:
    """atan2(-R_01, R_11), (k,) (rad), of quaternions (k, 4)."""
    w, x, y, z = q.T
    return np.arctan2(-2 * (x * y - w * z), w * w - x * x + y * y - z * z)


def saturated_share(flight: Flight, thrust_min: float, thrust_max: float) -> float:
    """Share of the samples in which at least one rotor is commanded to a limit."""
    margin = SATURATION_MARGIN * (thrust_max - thrust_min)
    at_limit = (flight.input <= thrust_min + margin) | (flight.input >= thrust_max - margin)
    return float(at_limit.any(axis=1).mean())


def flight_metrics(flight: Flight, thrust_min: float, thrust_max: float) -> dict[str, Any]:
    """The numbers of a result row that come from the flight itself; NaN for a flight without samples."""
    if len(flight) == 0:
        return dict.fromkeys(METRICS, float("nan")) | {"unconverged_count": 0, "duration": 0.0}
    error, angle, solve_time = position_error(flight), attitude_error(flight), flight["solve_time"]
    t = flight.t
    return {
        "rmse": float(np.sqrt(np.mean(error**2))),
        "mean_error": float(np.mean(error)),
        "max_error": float(np.max(error)),
        "attitude_rmse": float(np.sqrt(np.mean(angle**2))),
        "heading_rmse": float(np.sqrt(np.mean(heading_error(flight) ** 2))),
        "saturated_share": saturated_share(flight, thrust_min, thrust_max),
        "peak_speed": float(np.linalg.norm(flight.state[:, VELOCITY], axis=1).max()),
        "duration": float(t[-1] - t[0]),
        "unconverged_count": int(np.sum(flight.columns.get("unconverged", 0))),
        "solve_time_median": float(np.median(solve_time)),
        "solve_time_p99": float(np.percentile(solve_time, 99)),
        "solve_time_max": float(np.max(solve_time)),
    }


METRICS = (
    "rmse", "mean_error", "max_error", "attitude_rmse", "heading_rmse", "saturated_share", "peak_speed", "duration",
    "unconverged_count", "solve_time_median", "solve_time_p99", "solve_time_max",
)  # fmt: skip
