"""What a controller must do: hover at the reference, push the right way, come back, track, and say when it fails."""

from pathlib import Path

import numpy as np
import pytest

import quadexp as qx

HERE = Path(__file__).parent
POSITION = slice(0, 3)


@pytest.fixture
def loop():
    """Hovering at a point, without air and noise."""
    return qx.controller("controller=geometric", "plant=ideal", "trajectory=hover", conf=HERE)


def wrench(loop, thrusts):
    """Collective thrust (N) and body torques (N m) of the rotors."""
    return loop.vehicle.allocation @ thrusts


def test_at_the_reference_it_hovers(loop):
    thrusts = loop.step(loop.start, 0.0)
    np.testing.assert_allclose(thrusts, loop.vehicle.hover_thrust, rtol=1e-3)


def test_it_pushes_towards_the_reference(loop):
    """Too low: more thrust. Too far forward (x): the nose goes up, a negative torque about y. Too far left: right."""
    low, ahead, left = (loop.start + 0.1 * np.eye(13)[i] * sign for i, sign in ((2, -1), (0, 1), (1, 1)))
    weight = loop.vehicle.mass * loop.vehicle.gravity
    assert wrench(loop, loop.step(low, 0.0))[0] > 1.02 * weight
    loop.reset()
    assert wrench(loop, loop.step(ahead, 0.0))[2] < 0
    loop.reset()
    assert wrench(loop, loop.step(left, 0.0))[1] > 0


def test_it_comes_back_within_the_limits(loop):
    state, rng = loop.start + 0.5 * np.eye(13)[0], np.random.default_rng(0)
    for k in range(round(3.0 / loop.period)):
        thrusts = loop.step(state, k * loop.period)
        assert not loop.failed and (thrusts >= loop.vehicle.thrust_min).all()
        assert (thrusts <= loop.vehicle.thrust_max).all()
        state, _ = loop.plant.advance(state, thrusts, loop.period, rng)
    assert np.linalg.norm((state - loop.start)[POSITION]) < 0.02  # m


def test_it_tracks_a_circle_without_air_and_stays_on_it_with_drag():
    """How much of the drag a controller leaves is its own affair: one that knows the air leaves nothing."""
    ideal, drag = (
        qx.simulate("controller=geometric", "trajectory=circle", f"plant={plant}", speed=3, conf=HERE)
        for plant in ("ideal", "simplified")
    )
    assert ideal.outcome == "ok" and ideal.metrics["mean_error"] < 0.01  # m
    assert drag.outcome == "ok" and drag.metrics["mean_error"] < 0.5  # m
