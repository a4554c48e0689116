"""What a compensation must do: nothing where there is nothing to mend, its work where there is, and the same in C."""

from pathlib import Path

import numpy as np
import pytest

import quadexp as qx

HERE = Path(__file__).parent
GIVEN = ("adaptive=height_integral", "plant=ideal", "trajectory=hover", "trajectory.duration=25")


def flown(*settings):
    return qx.simulate(*GIVEN, *settings, conf=HERE)


@pytest.mark.parametrize("controller", ["nominal_mpc", "geometric"])
def test_where_the_model_is_right_it_does_nothing(controller):
    flight = flown(f"controller={controller}")
    assert flight.outcome == "ok" and np.abs(flight["height_integral"]).max() < 1e-3  # m s


@pytest.mark.parametrize("controller", ["nominal_mpc", "geometric", "dfbc"])
def test_it_takes_away_what_a_wrong_mass_costs(controller):
    without = flown(f"controller={controller}", "truth.mass=1.2", "adaptive.gain=0")
    with_it = flown(f"controller={controller}", "truth.mass=1.2")
    low, left = (abs(flight["p_z"].iloc[-1] - 1.0) for flight in (without, with_it))  # m, from the height of hover
    assert left < 0.1 * low


def test_it_stays_within_its_limit():
    flight = flown("controller=nominal_mpc", "truth.mass=1.2", "adaptive.limit=0.01")
    assert np.abs(flight["height_integral"]).max() <= 0.01


def test_c_and_python_fly_alike():
    one, other = (
        flown("controller=nominal_mpc", "truth.mass=1.2", f"controller.backend={backend}")
        for backend in ("interpreted", "auto")
    )
    np.testing.assert_allclose(one["p_z"], other["p_z"], atol=1e-9)
