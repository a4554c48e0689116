"""trajectory=random as it stands: flown cleanly, on every seed, by who knows the air and who does not."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.compose import compose
from quadexp.experiment.build import build_trajectory, build_vehicle
from quadexp.experiment.evaluate import fly_one

# Without a model of drag the MPC leans on its feedback, some of whose thrusts meet a limit that the reference keeps.
SATURATED = {"nominal_mpc": 0.05, "perfect_mpc": 0.01}
PERFECT_ERROR = 0.05  # m


def fly(seed, controller, *overrides):
    return fly_one(compose(["trajectory=random", f"seed={seed}", f"controller={controller}", *overrides]))


def clean(flight, controller):
    row = flight.metadata["row"]
    assert flight.outcome == "ok" and row["saturated_share"] < SATURATED[controller]
    assert row["peak_speed"] < 8.5
    if controller == "perfect_mpc":
        assert row["max_error"] < PERFECT_ERROR
    reference = flight.stack([f"ref_u_{i}" for i in range(4)])
    if controller == "nominal_mpc":
        assert reference.min() > 0.5 and reference.max() < 16.0


@pytest.mark.parametrize("controller", SATURATED)
@pytest.mark.parametrize("seed", [0, 1, 7, 23])
def test_the_default_is_clean(controller, seed):
    clean(fly(seed, controller), controller)


@pytest.mark.slow
@pytest.mark.parametrize("controller", SATURATED)
def test_the_default_is_clean_on_a_hundred_seeds(controller):
    for seed in range(100):
        clean(fly(seed, controller), controller)


@pytest.mark.parametrize("vehicle", ["vehicle=lei_li", "vehicle=crazyflie", "vehicle=blackbird"])
def test_other_vehicles_too(vehicle):
    flight = fly(3, "nominal_mpc", vehicle, "plant=ideal")
    row = flight.metadata["row"]
    assert flight.outcome == "ok" and row["saturated_share"] == 0 and row["max_error"] < 0.2


def test_limits_are_left_alone_where_that_is_allowed():
    allowed = compose(["trajectory=random", "trajectory.speed=16", "trajectory.allow_infeasible=true"])
    path = build_trajectory(allowed.trajectory, build_vehicle(allowed.vehicle))
    assert path.peak_speed == pytest.approx(16.0, rel=1e-9) and path.note == ""


def test_the_note_says_where_a_limit_comes_before_the_speed():
    flight = fly(1, "nominal_mpc", "trajectory.speed=20")
    assert "of the 20 m/s asked: more would take rotor" in flight.metadata["reference_note"]
    slow = fly(1, "nominal_mpc", "trajectory.speed=3")
    assert slow.metadata["reference_note"] == ""
    speeds = np.linalg.norm(slow.stack(["ref_v_x", "ref_v_y", "ref_v_z"]), axis=1)
    assert speeds.max() == pytest.approx(3.0, abs=2e-3)
