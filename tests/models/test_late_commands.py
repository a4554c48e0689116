"""Commands in regressions: late ones are found, and one that is held acts over its interval, not at its end."""

from __future__ import annotations

import pytest

from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import fly_one
from quadexp.models.samples import read_rows
from quadexp.models.validation import Track, predictors, rollout_errors
from quadexp.models.vehicle_model import FitSettings, fit_vehicle_model
from quadexp.parts.compose import compose

CLEAN = [f"plant.{name}_noise_density=0" for name in ("force", "motor", "torque")]


def flown(latency: float, rate: int, seeds=(0, 1), settings=()):
    path = ["trajectory=random", "trajectory.speed=8", f"controller.rate={rate}", *settings]
    world = ["link=latency", f"link.latency={latency}"] if latency else []
    return [fly_one(compose([*path, *world, f"seed={seed}"])) for seed in seeds]


@pytest.mark.parametrize(("latency", "rate", "found"), [(0.0, 50, 0.0), (0.04, 50, 0.04), (0.025, 60, 1 / 60)])
def test_a_latency_is_no_drag(latency, rate, found):
    """The drag along z is quadratic, not linear. A delay is found in whole periods, the rest as the torque's lag (up to
    1.4 ms where there is none: the controller answers to the noise)."""
    vehicle = build_vehicle(compose([]).vehicle)
    model = fit_vehicle_model(flown(latency, rate), vehicle, FitSettings(kinds=("quadratic",)))
    assert model.thrust.delay == pytest.approx(found)
    rows = {row["term"]: row for row in model.models["quadratic"].records() if row["axis"] == "z"}
    assert rows["linear"]["low"] < 0.0 < rows["linear"]["high"] < rows["linear"]["low"] + 0.1
    assert rows["quadratic"]["low"] < 0.08 < rows["quadratic"]["high"] < rows["quadratic"]["low"] + 0.03
    assert model.torque.lag == pytest.approx([latency - found] * 3, abs=2e-3)


@pytest.mark.parametrize("latency", [0.0, 0.04])
def test_open_loop_flies_the_command_of_each_interval(latency):
    """Half a second without noise: 26 and 48 mm with the commands of the interval before."""
    vehicle = build_vehicle(compose([]).vehicle)
    model = fit_vehicle_model(flown(latency, 50, settings=CLEAN), vehicle, FitSettings(kinds=("quadratic",)))
    assert model.torque.lag == pytest.approx([0.0] * 3, abs=3e-4)
    one = next(one for one in predictors(model, "m", vehicle, None) if one.name == "quadratic drag")
    (test,) = flown(latency, 50, (2,), CLEAN)
    track = Track(read_rows(test, "test", one.curve.signal, one.curve.delay), one)
    modes = {"full": vehicle, "torque": vehicle, "attitude": None}
    errors = {
        mode: rollout_errors([track], [0.5], tracked=False, vehicle=of, mode=mode)[0]["position"]
        for mode, of in modes.items()
    }
    assert errors["attitude"] < 5e-3 and max(errors.values()) < 0.012
