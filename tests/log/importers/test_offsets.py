"""Time offsets between sensors of a log: what is called certain is right, whatever drag and noise do."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.log.signal import Stream
from quadexp.log.signal.offset import find_offsets
from tests.log.importers import logs


@pytest.fixture(scope="module")
def truth():
    return logs.truth(40.0, 100.0, seed=1)


def log_of(f: logs.Truth, delay: float, noise: float, rng: np.random.Generator) -> dict[str, Stream]:
    """Gyro and accelerometer late by `delay`; noise 1: of a hobby IMU and of a filtered motion capture."""

    def late(values: np.ndarray, size: float) -> np.ndarray:
        moved = np.stack([np.interp(f.t - delay, f.t, column) for column in values.T], axis=1)
        return moved + noise * rng.normal(0, size, values.shape)

    streams = {
        "attitude": f.q, "velocity": f.v + noise * rng.normal(0, 0.01, f.v.shape),
        "rate": late(f.w, 0.05), "acceleration": late(f.acc, 0.5),
    }  # fmt: skip
    return {name: Stream(f.t, values) for name, values in streams.items()}


@pytest.mark.parametrize("noise", [0.0, 1.0])
@pytest.mark.parametrize("delay", [0.0, 0.005, -0.005, 0.02, -0.02, 0.05, -0.05])
def test_known_delays_of_a_flight_with_drag(truth, rng, delay, noise):
    found = find_offsets(log_of(truth, delay, noise, rng))
    assert found["rate", "attitude"].certain
    for pair, one in found.items():
        if one.certain:
            assert abs(one.seconds - delay) < 4 * one.error + 0.1 * abs(delay) + 5e-4, pair
    if not noise:
        assert found["acceleration", "velocity"].certain


def test_drift_is_no_motion(rng):
    """Standing still: the attitude drifts, the gyro's bias too; nothing is certain."""
    t = np.arange(0, 30, 0.01)
    drift = 1e-3 * np.cumsum(rng.normal(0, 0.1, len(t)))
    q = np.stack([np.cos(drift / 2), 0 * t, 0 * t, np.sin(drift / 2)], axis=1)
    w = np.stack([rng.normal(0, 2e-3, len(t)) for _ in "xyz"], axis=1) + 1e-3 * np.sin(0.1 * t)[:, None]
    streams = {"attitude": q, "rate": w, "acceleration": [0, 0, 9.81] + rng.normal(0, 0.05, (len(t), 3))}
    log = {name: Stream(t, values) for name, values in streams.items()}
    assert not any(one.certain for one in find_offsets(log).values())
