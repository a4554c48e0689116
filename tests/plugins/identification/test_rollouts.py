"""Open loop with all 13 states: rates held turn by their start, and beat a geometric torque that is wrong."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.plugins.identification.predictors import predictors
from quadexp.plugins.identification.validation import Track, full_rollout, rollout_errors
from quadexp.plugins.identification.vehicle_model import FitSettings, fit_vehicle_model
from quadexp.plugins.logs.samples import read_rows
from tests.log.imitated import imitated, vehicle_named


def flown(seed: int):
    """A flight whose torque is a third of the geometric one, late by 8 ms."""
    return imitated(seed, "blackbird", signal="u", gain=(0.2, 0.3, 0.6), lag=0.008, offset=(0.8, -0.5, 0.2))


@pytest.fixture(scope="module")
def fitted():
    body, settings = vehicle_named("blackbird"), FitSettings(signal="u", powers=(1,), kinds=("linear",))
    return body, fit_vehicle_model([flown(130), flown(131)], body, settings, names=["a", "b"])


def test_rates_held_beat_a_wrong_geometric_torque(fitted):
    body, model = fitted
    predictor = next(p for p in predictors(model, "m", body, None) if p.name == "linear drag")
    track = Track(read_rows(flown(132), "c", "u"), predictor)
    held, full = (rollout_errors([track], [0.5], tracked=True, vehicle=body, mode=mode)[0] for mode in ("held", "full"))
    assert held["attitude"] < full["attitude"] and held["position"] < full["position"]


def test_rates_held_turn_by_their_start(fitted):
    """The attitude is that of a constant rate, to rounding: an independent rotation vector."""
    body, model = fitted
    one = read_rows(flown(133), "c", "u")
    predictor = predictors(model, "m", body, None)[0]
    track = Track(one, predictor)
    starts, steps = np.array([50, 400, 900]), 30
    last = full_rollout(track, starts, steps, body, tracked=True, mode="held")
    assert np.allclose(last[:, 10:13], track.rate[starts])
    seconds = (track.time[starts + steps] - track.time[starts])[:, None]
    expected = track.rotation[starts] * Rotation.from_rotvec(seconds * track.rate[starts])
    found = Rotation.from_quat(last[:, 3:7], scalar_first=True)
    assert (found.inv() * expected).magnitude().max() < 1e-6
