"""Gain, lag and offset of the torque are found where they are known, refused where nothing is to be found; rates held
is what they must beat."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight
from quadexp.models.checkpoint import load_model, save_model
from quadexp.models.samples import gather, read_rows
from quadexp.models.thrust_curve import ThrustCurve
from quadexp.models.torque import explained, fit_torque, torque_lines
from quadexp.models.validation import Track, full_rollout, predictors, rollout_errors
from quadexp.models.vehicle_model import FitSettings, fit_vehicle_model
from tests.log.imitated import imitated, vehicle_named

CASES = {
    "blackbird": ((0.2, 0.3, 0.6), 0.008, (0.8, -0.5, 0.2)),
    "crazyflie": ((0.5, 0.25, 0.8), 0.03, (-1.5, 0.4, 0.1)),
    "lei_li": ((0.9, 0.7, 1.1), 0.0, (0.0, 0.0, 0.0)),
}


def thrust_in_newtons(vehicle) -> ThrustCurve:
    return ThrustCurve("u", np.array([1.0]), np.array([1 / vehicle.mass]), np.zeros(1), rotors=vehicle.n_rotors)


def flights_of(vehicle: str, seeds, **options) -> list[Flight]:
    gain, lag, offset = CASES[vehicle]
    return [imitated(seed, vehicle, signal="u", gain=gain, lag=lag, offset=offset, **options) for seed in seeds]


@pytest.mark.parametrize("vehicle", CASES)
def test_the_truth_is_found(vehicle):
    gain, lag, offset = CASES[vehicle]
    body = vehicle_named(vehicle)
    curve = thrust_in_newtons(body)
    model = fit_torque(gather(flights_of(vehicle, (100, 101, 102)), "u"), body, curve)
    assert model.gain == pytest.approx(gain, rel=0.06)
    assert model.lag == pytest.approx([lag] * 3, abs=0.003)
    assert model.offset == pytest.approx(offset, abs=0.12)
    assert model.used.all() and (model.share > 0.8).all()
    assert (explained(model, gather(flights_of(vehicle, (103,)), "u"), body, curve) > 0.8).all()


def test_intervals_hold_the_truth():
    """Gain and lag of roll and pitch, offset of yaw, over twelve repetitions with noisy commands and gyros."""
    body = vehicle_named("blackbird")
    gain, lag, offset = CASES["blackbird"]
    held = []
    for k in range(12):
        flights = flights_of("blackbird", (110 + 2 * k, 111 + 2 * k), duration=15, noise=5.0)
        model = fit_torque(gather(flights, "u"), body, thrust_in_newtons(body))
        for i in (0, 1):
            held.append(model.gain_low[i] - 0.01 <= gain[i] <= model.gain_high[i] + 0.01)
            held.append(model.lag_low[i] - 5e-4 <= lag <= model.lag_high[i] + 5e-4)
        held.append(model.offset_low[2] - 0.02 <= offset[2] <= model.offset_high[2] + 0.02)
    assert np.mean(held) >= 0.85


def test_axes_without_information_are_rejected_by_name():
    """Commands of another flight: nothing to learn, and the rates are held."""
    body = vehicle_named("blackbird")
    flights = flights_of("blackbird", (120, 121, 122))
    swapped = [
        Flight({**flight.columns, **{f"u_{i}": other[f"u_{i}"] for i in range(4)}}, flight.metadata)
        for flight, other in zip(flights, [*flights[1:], flights[0]], strict=True)
    ]
    model = fit_torque(gather(swapped, "u"), body, thrust_in_newtons(body))
    assert not model.used.any()
    assert all(
        "rejected" in line and axis in line
        for line, axis in zip(torque_lines(model), ("roll", "pitch", "yaw"), strict=True)
    )


@pytest.fixture(scope="module")
def fitted():
    body = vehicle_named("blackbird")
    training = flights_of("blackbird", (130, 131))
    settings = FitSettings(signal="u", powers=(1,), kinds=("linear",))
    return body, fit_vehicle_model(training, body, settings, names=["a", "b"])


def test_the_checkpoint_keeps_it(fitted, tmp_path):
    _, model = fitted
    save_model(tmp_path / "m", model)
    again = load_model(tmp_path / "m").torque
    assert all((getattr(again, name) == getattr(model.torque, name)).all() for name in ("gain", "lag_low", "share"))


def test_fitted_beats_held_and_held_beats_geometric(fitted):
    """On a vehicle with a third of the geometric torque, late by 8 ms."""
    body, model = fitted
    one = read_rows(flights_of("blackbird", (132,))[0], "c", "u")
    predictor = next(p for p in predictors(model, "m", body, None) if p.name == "linear drag")
    track = Track(one, predictor)
    error = {}
    for mode in ("held", "torque", "full"):
        (row,) = rollout_errors([track], [0.5], tracked=True, vehicle=body, mode=mode)
        assert row["mode"] == mode
        error[mode] = (row["position"], row["attitude"])
    assert error["torque"][1] < 0.5 * error["held"][1] < 0.5 * error["full"][1]
    assert error["torque"][0] < error["held"][0] < error["full"][0]


def test_rates_held_turn_by_their_start(fitted):
    """The attitude is that of a constant rate, to rounding: an independent rotation vector."""
    body, model = fitted
    one = read_rows(flights_of("blackbird", (133,))[0], "c", "u")
    predictor = predictors(model, "m", body, None)[0]
    track = Track(one, predictor)
    starts, steps = np.array([50, 400, 900]), 30
    last = full_rollout(track, starts, steps, body, tracked=True, mode="held")
    assert np.allclose(last[:, 10:13], track.rate[starts])
    seconds = (track.time[starts + steps] - track.time[starts])[:, None]
    expected = track.rotation[starts] * Rotation.from_rotvec(seconds * track.rate[starts])
    found = Rotation.from_quat(last[:, 3:7], scalar_first=True)
    assert (found.inv() * expected).magnitude().max() < 1e-6


def test_without_gyro_or_rotors_there_is_no_torque(fitted):
    body, model = fitted
    flight = flights_of("blackbird", (134,))[0]
    no_gyro = Flight({k: x for k, x in flight.columns.items() if not k.startswith("w_")}, flight.metadata)
    assert fit_torque(gather([no_gyro], "u"), body, model.thrust) is None
    collective = Flight(flight.columns | {"thrust_acceleration": flight["acc_z"]}, flight.metadata)
    curve = ThrustCurve("thrust_acceleration", np.array([1.0]), np.array([1.0]), np.zeros(1), rotors=4)
    assert fit_torque(gather([collective], "thrust_acceleration"), body, curve) is None
