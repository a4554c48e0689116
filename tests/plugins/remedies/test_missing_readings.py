"""A missing reading of the accelerometer is a prediction without an update: observers, and a state over its age."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.wider_draws import missing_readings
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.report.metrics import position_error

pytestmark = pytest.mark.usefixtures("unmeasured")
PATH = ("trajectory=ellipse", "trajectory.speed=6", "trajectory.acceleration=8", "trajectory.duration=5", "seed=5")
WIND = ("world=only_wind", "controller.allow_unstable=true")


def error(share, *words):
    """Mean, after a second (mm)."""
    with missing_readings(share):
        flight = fly_one(compose([*PATH, *WIND, *words]))
    assert flight.outcome == "ok"
    return 1e3 * position_error(flight)[flight.t > 1].mean()


@pytest.mark.parametrize(
    ("words", "most"),
    [
        (("controller=perfect_mpc", "observer=wind"), 1.3),  # 5 times, where it forgot what it assumed
        (("controller=nominal_mpc", "observer=disturbance"), 1.2),
        (("controller=nominal_mpc", "observer=disturbance", "observer.scale_walk=0.005"), 1.2),
        (("controller=geometric", "observer=disturbance"), 1.2),
        (("controller=geometric", "delay=strapdown", "estimator=late"), 1.2),
        (("controller=dfbc", "observer=disturbance", "delay=strapdown", "estimator=late"), 1.2),
    ],
)
def test_a_share_of_missing_readings_costs_little(words, most):
    assert error(0.3, *words) < most * error(0.0, *words)


def test_a_force_is_found_from_the_velocity_alone_where_there_is_no_accelerometer():
    """No reading ever came, so that nothing was ever estimated."""
    words = "controller=nominal_mpc", "observer=disturbance", "observer.source=velocity"
    assert error(1.0, *words) == pytest.approx(error(0.0, *words), rel=0.01)
    assert error(1.0, *words) < 0.2 * error(1.0, "controller=nominal_mpc")


def test_a_torque_goes_on_without_the_accelerometer():
    """Its filter missed a period of known torque at every missing reading, and took it for an unknown one."""
    torques = []
    for share in (0.0, 0.3):
        with missing_readings(share):
            flight = fly_one(compose([*PATH, *WIND, "controller=nominal_mpc", "observer=disturbance"]))
        torques.append(np.abs(flight.stack([f"observer_torque_{axis}" for axis in "xyz"])).max())
    assert torques[1] < 1.2 * torques[0] + 1e-6
