"""The air of a reference: Newton's convergence, sharp corners, and an end soon where there is no agreement."""

import casadi as ca
import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.models.residual import symbolic_residual
from quadexp.parts.compose import compose
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import RATE, VELOCITY
from quadexp.plugins.aerodynamics.coefficients import BladeCoefficients
from quadexp.plugins.papers.lei_li.blade_element import blade_element_residual
from quadexp.plugins.papers.lei_li.paths import Rectangle
from quadexp.reference.air_step import AirModel
from quadexp.reference.base import FlatOutput
from quadexp.reference.circle import Circle
from quadexp.reference.fixed_point import Settings, consistent_air
from quadexp.reference.flat_map import untwisted
from quadexp.reference.flatness import flat_reference
from quadexp.reference.lemniscate import Lemniscate
from quadexp.reference.motion import Constant, Demand
from quadexp.reference.time_grid import SPACING, TimeGrid
from tests.reference.test_flatness import rich_residual

BLADE = BladeCoefficients.from_parameters(np.array([0.22, 3.32, 0.01, 0.006, 0.02]))


class Counted(AirModel):
    """A model that keeps what it was asked for and how it answered."""

    def __init__(self, residual):
        super().__init__(residual)
        self.answers = []

    def __call__(self, z):
        response = super().__call__(z)
        self.answers.append(response.outputs.copy())
        return response


class Steady:
    """Constant accelerations (3, k) at velocities (3, k): k motions without rates, heading free."""

    duration, peak_speed = 1.0, 1.0

    def __init__(self, velocity, acceleration):
        self.velocity, self.acceleration = velocity, acceleration

    def flat_output(self, t):
        position = np.zeros((len(t), 5, 3))
        position[:, 1], position[:, 2] = self.velocity.T, self.acceleration.T
        return FlatOutput(position, None)


@pytest.fixture(scope="module")
def lei_li():
    return build_vehicle(compose(["vehicle=lei_li"]).vehicle)


@pytest.fixture(scope="module")
def blade_element(lei_li):
    return blade_element_residual(lei_li, BLADE)


@pytest.mark.parametrize("air", ["rich", "blade_element", "six rotors"])
def test_newton_steps_converge_quadratically(air, vehicle, odd_vehicle, lei_li, blade_element):
    """Without rates every derivative is in the step: the error is squared, e_n+1 < 4 e_n^2, and 1e-12 in six steps."""
    vehicle, residual = {
        "rich": (vehicle, rich_residual(4)),
        "blade_element": (lei_li, blade_element),
        "six rotors": (odd_vehicle, rich_residual(6)),
    }[air]
    rng, k = np.random.default_rng(3), 40
    path = Steady(rng.uniform(-6, 6, (3, k)) * [[1], [1], [0.3]], rng.uniform(-3, 3, (3, k)))
    demand = Demand.of(path, np.full(k, 0.5), vehicle.gravity)
    model, calculus = Counted(residual), Constant(rng.uniform(-3, 3, k))
    found, motion = consistent_air(demand, vehicle, model, calculus, Settings(1e-13, 6))
    errors = []
    for y in model.answers:
        asked = np.concatenate([untwisted(y[:2], motion.chi), y[2:]])
        errors.append(np.abs(asked - found.outputs).max(axis=0))
    assert errors[0].max() > 0.5, "the air matters here"
    assert errors[-1].max() < 1e-12
    for before, after in zip(errors[:-1], errors[1:], strict=True):
        assert np.all(after < np.maximum(4 * before**2, 1e-12))


@pytest.mark.parametrize("speed", [5.0, 15.0])
def test_corners_take_few_iterations_and_leave_the_legs_steady(lei_li, blade_element, speed):
    path, model = Rectangle(speed=speed, duration=12.0), Counted(blade_element)
    grid = TimeGrid.over(0.0, path.duration, SPACING)
    consistent_air(Demand.of(path, grid.times, lei_li.gravity), lei_li, model, grid, Settings(1e-9, 100))
    assert len(model.answers) < 25

    reference = flat_reference(path, np.array([1.4, 4.6, 7.5, 10.0]), lei_li, blade_element)
    dynamics = corrected_function(lei_li, blade_element)
    for x, u in zip(reference.state, reference.input, strict=True):
        derivative = np.array(dynamics(x, u, blade_element.theta)).ravel()
        assert np.abs(derivative[VELOCITY]).max() < 1e-8
        assert np.abs(derivative[RATE]).max() < 1e-7
        assert np.all(x[RATE] == pytest.approx(0, abs=1e-9))


@pytest.mark.parametrize("speed", [pytest.param(12.0, marks=pytest.mark.slow), 13.0])
def test_references_past_the_rotors_limits_are_still_found(lei_li, blade_element, speed):
    """Near its crossing the lemniscate asks one rotor to push by 13 and 20 N. Lengths of steps must not go round in
    circles there; most of the path obeys the equations to a millimetre per second squared."""
    path = Lemniscate(speed=speed)
    t = np.linspace(0.2, path.duration - 0.2, 300)
    reference = flat_reference(path, t, lei_li, blade_element)
    assert reference.input.min() < lei_li.thrust_min
    dynamics = corrected_function(lei_li, blade_element)
    acceleration = path.flat_output(t).position[:, 2]
    wrong = [
        np.abs(np.array(dynamics(x, u, blade_element.theta)).ravel()[VELOCITY] - a).max()
        for x, u, a in zip(reference.state, reference.input, acceleration, strict=True)
    ]
    assert np.median(wrong) < 1e-3


def test_where_there_is_no_agreement_the_end_comes_soon(vehicle):
    """Air that jumps with the attitude, by more than a turn of it can follow."""
    z = ca.SX.sym("z", 10)
    rough = symbolic_residual("rough", ca.vertcat(8 * ca.sin(5e4 * z[0]), 0, 0, 0, 0, 0), z, ca.SX.sym("t", 0), [])
    path, model = Circle(speed=4.0), Counted(rough)
    grid = TimeGrid.over(2.0, 6.0, SPACING)
    demand = Demand.of(path, grid.times, vehicle.gravity)
    with pytest.raises(UsageError, match=r"does not converge: stalled after \d+ iterations, last change .* at t ="):
        consistent_air(demand, vehicle, model, grid, Settings(1e-9, 100))
    assert len(model.answers) < 40
