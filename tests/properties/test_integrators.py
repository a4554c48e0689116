"""Every integrator keeps its order on real dynamics: rigid bodies with drag, and both plants."""

import inspect
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given

from quadexp.physics import integrator
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.sensitivity import rk4_sensitivity_function
from quadexp.plugins.papers.lei_li.plant import BladeElementPlant
from quadexp.world import SimplifiedPlant
from quadexp.world.integrator import METHODS
from tests.properties.strategies import (
    few,
    generators,
    make_blade,
    make_effects,
    make_residual,
    make_upright_state,
    vehicles,
)

ORDER = {"euler_step": 1, "rk4_step": 4}
SMALL = {1: 1.0, 4: 1e-5}  # by order: a difference of two solutions within which its leading term shows
ROUNDING = 1e-10  # a difference of two solutions that halving the steps again would bring near that of rounding
DURATION = 0.16  # s


def gentle_thrusts(rng, vehicle) -> np.ndarray:
    """Hover, give or take two percent: light vehicles with uneven thrusts turn too fast for coarse steps."""
    return vehicle.hover_thrust * rng.uniform(0.98, 1.02, vehicle.n_rotors)


def observed_order(flown, steps: int, small: float) -> float:
    """log2 of the ratio of successive differences under halved steps: the order, without an exact solution.

    The steps are halved until two solutions differ by less than `small` and two orders in a row agree to 0.3, or until
    rounding would show: a light vehicle may reach 50 rad/s in this time, and steps that are long for it do not show the
    leading term of the error.
    """
    one, two, before = flown(steps), flown(2 * steps), np.inf
    while True:
        steps *= 2
        next_one = flown(2 * steps)
        coarse, fine = np.linalg.norm(one - two), np.linalg.norm(two - next_one)
        order = float(np.log2(coarse / fine))
        if coarse <= small and (abs(order - before) < 0.3 or fine < ROUNDING):
            return order
        one, two, before = two, next_one, order


def test_no_integrator_is_missing_here():
    found = {name for name, _ in inspect.getmembers(integrator, inspect.isfunction) if name.endswith("_step")}
    assert found == set(ORDER)
    assert {step.__name__ for step in METHODS.values()} == set(ORDER)


@pytest.mark.parametrize("name", ORDER)
@given(vehicles(), generators)
def test_order_on_a_rigid_body_with_drag(name, vehicle, rng):
    residual = make_residual("linear_drag", vehicle, rng)
    f, x0, u = corrected_function(vehicle, residual), make_upright_state(rng), gentle_thrusts(rng, vehicle)
    x, h = ca.MX.sym("x", 13), ca.MX.sym("h")
    step = getattr(integrator, name)
    one = ca.Function("one", [x, h], [step(lambda s: f(s, u, residual.theta), x, h)])

    def flown(steps):
        return np.array(one.mapaccum(steps)(x0, DURATION / steps))[:, -1]

    order = ORDER[name]
    assert observed_order(flown, 8 if order == 4 else 64, SMALL[order]) == pytest.approx(order, abs=0.3)


@few
@given(vehicles(flat=True), generators)
def test_order_of_the_plants(vehicle, rng):
    """Without noise the simplified plant is of order 4; the blade-element plant of the order of its method.

    Drag that is quadratic per axis, v |v|, is left out: its second derivative jumps where v crosses zero, and no method
    keeps its order across a jump.
    """
    x0, u, blade = make_upright_state(rng), gentle_thrusts(rng, vehicle), make_blade(rng)
    effects = replace(make_effects(rng), quadratic_drag=(0.0, 0.0, 0.0))

    def simplified(steps):
        plant = SimplifiedPlant(vehicle, effects, step=DURATION / steps, backend="interpreted")
        return plant.advance(x0, u, DURATION, rng)[0]

    assert observed_order(simplified, 4, SMALL[4]) == pytest.approx(4, abs=0.6)
    for method, order, coarse in (("euler", 1, 32), ("rk4", 4, 4)):

        def blade_element(steps, method=method):
            plant = BladeElementPlant(vehicle, blade, step=DURATION / steps, method=method, backend="interpreted")
            return plant.advance(x0, u, DURATION)[0]

        assert observed_order(blade_element, coarse, SMALL[order]) == pytest.approx(order, abs=0.6)


@few
@given(vehicles(), generators)
def test_the_sensitivity_s_step_is_rk4_of_order_four(vehicle, rng):
    """x_next of the linearised node converges as RK4 does, and its A has the order of x_next: both from one tableau."""
    residual = make_residual("gaussian_process", vehicle, rng)
    node = rk4_sensitivity_function(vehicle, residual, scalar=False)
    x0, u = make_upright_state(rng), gentle_thrusts(rng, vehicle)

    def flown(steps):
        x, chain = x0, np.eye(13)
        for _ in range(steps):
            x, A, _ = (np.array(part) for part in node(x, u, residual.theta, DURATION / steps))
            chain = A @ chain
        return np.r_[x.reshape(-1), chain.reshape(-1)]

    assert observed_order(lambda n: flown(n)[:13], 12, SMALL[4]) == pytest.approx(4, abs=0.6)
    assert observed_order(lambda n: flown(n)[13:], 12, 1e-4) == pytest.approx(4, abs=0.6)
