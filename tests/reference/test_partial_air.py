"""References that cannot contain a residual whole contain a share of it, and obey the equations of motion with that."""

import casadi as ca
import numpy as np
import pytest

from quadexp.models.residual import symbolic_residual
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.plugins.gaussian_process.posterior import gaussian_process_residual, mean_only
from quadexp.plugins.papers.lei_li.paths import Rectangle
from quadexp.reference.circle import Circle
from quadexp.reference.flatness import flat_reference
from quadexp.reference.hover import Hover
from quadexp.reference.random_polynomial import RandomPolynomial
from quadexp.world import PlantEffects, SimplifiedPlant

H = 1e-4  # s, of the differences in time
SLOW = pytest.mark.slow


def plant_residual(vehicle):
    return SimplifiedPlant(vehicle, PlantEffects(), backend="interpreted").residual()


def drag_process(vehicle):
    """A Gaussian process through quadratic drag along every axis, from points up to 25 m/s."""
    outputs = []
    v = np.linspace(-25, 25, 21)[:, None]
    kernel = np.exp(-((v - v.T) ** 2) / (2 * 6.0**2))
    for axis in "xyz":
        weights = np.linalg.solve(kernel + 1e-6 * np.eye(len(v)), -(0.3 * v + 0.08 * v * abs(v))[:, 0])
        outputs.append(mean_only(f"a_{axis}", (f"v_{axis}",), v, weights, np.array([6.0])))
    return gaussian_process_residual(vehicle, outputs)


AIRS = {"plant": plant_residual, "gaussian process": drag_process}


def scaled(residual, share):
    z = ca.SX.sym("z", residual.function.size1_in(0))
    y, _ = residual.function(z, residual.theta)
    return symbolic_residual("scaled", share * y, z, ca.SX.sym("t", 0), [])


def sampled(path, vehicle, residual, count=150):
    """The reference H before, at and H after `count` times: share, states (k, 3, 13), inputs (k, n), times (k,)."""
    t = np.linspace(0.05, path.duration - 0.05, count)
    reference = flat_reference(path, np.sort(np.concatenate([t - H, t, t + H])), vehicle, residual)
    n = vehicle.n_rotors
    return reference.residual, reference.state.reshape(-1, 3, 13), reference.input.reshape(-1, 3, n)[:, 1], t


@pytest.mark.parametrize("air", AIRS)
@pytest.mark.parametrize(
    ("extent", "seed"),
    [(20.0, 2), pytest.param(20.0, 3, marks=SLOW), (40.0, 1), pytest.param(40.0, 2, marks=SLOW), (40.0, 17)],
)
def test_the_equations_of_motion_hold_under_the_reported_share(vehicle, air, extent, seed):
    """Too fast for the drag: forces, and the derivatives in time of position, velocity, attitude and rate."""
    residual = AIRS[air](vehicle)
    path = RandomPolynomial(speed=60.0, extent=extent, seed=seed, vehicle=vehicle)
    share, x, u, t = sampled(path, vehicle, residual)
    assert 0.03 < share < 1
    part = scaled(residual, share)
    dynamics = corrected_function(vehicle, part)
    pairs = zip(x[:, 1], u, strict=True)
    asked = np.array([np.array(dynamics(state, thrusts, part.theta)).ravel() for state, thrusts in pairs])
    wrong = {
        "acceleration": asked[:, VELOCITY] - path.flat_output(t).position[:, 2],
        "velocity": asked[:, POSITION] - path.flat_output(t).position[:, 1],
        "attitude": asked[:, ATTITUDE] - (x[:, 2, ATTITUDE] - x[:, 0, ATTITUDE]) / (2 * H),
        "rate": asked[:, RATE] - (x[:, 2, RATE] - x[:, 0, RATE]) / (2 * H),
    }
    for name, values in wrong.items():
        size = np.abs(values).max(axis=1)
        assert np.median(size) < 1e-4 and np.percentile(size, 90) < 1e-2, name


def test_what_can_be_contained_whole_is(vehicle):
    for path in (Circle(speed=8.0), Hover(), RandomPolynomial(speed=6.0, vehicle=vehicle)):
        reference = flat_reference(path, np.linspace(0, path.duration, 50), vehicle, plant_residual(vehicle))
        assert reference.residual == 1.0


def test_a_stronger_residual_is_contained_to_the_share_that_a_weaker_one_would_be(vehicle):
    """Twice the air at half the share is the same air: the same reference."""
    path = RandomPolynomial(speed=60.0, extent=20.0, seed=2, vehicle=vehicle)
    t = np.linspace(0.0, path.duration, 200)
    residual = plant_residual(vehicle)
    whole = flat_reference(path, t, vehicle, residual)
    part = flat_reference(path, t, vehicle, scaled(residual, whole.residual))
    assert part.residual == 1.0
    np.testing.assert_allclose(part.state, whole.state, atol=1e-3)
    np.testing.assert_allclose(part.input, whole.input, atol=1e-2)


def test_corners_take_a_share_too(vehicle):
    """On a path whose velocity jumps, at a speed at which no attitude holds against all of the drag."""
    path = Rectangle(speed=40.0, duration=12.0)
    reference = flat_reference(path, np.linspace(0, 12.0, 300), vehicle, plant_residual(vehicle))
    assert (
        0 <= reference.residual <= 1 and np.all(np.isfinite(reference.state)) and np.all(np.isfinite(reference.input))
    )
