"""Newton's method for the induced velocity: the right root from anywhere, and how fast."""

import casadi as ca
import numpy as np
import pytest

from quadexp.plugins.aerodynamics.induced_velocity import (
    Defined,
    balance,
    newton,
    safe_newton,
    solution_function,
    starting_point,
)
from tests import paper

K = 2 * paper.RHO * np.pi * paper.R**2


@pytest.fixture(scope="module")
def solve(lei_li):
    function = solution_function(lei_li.rotor)

    def solve(w, V_h, V_z):
        found = function(3.32, np.atleast_2d(w), np.atleast_2d(V_h) ** 2, np.atleast_2d(V_z))
        return tuple(np.array(part)[0] for part in found)

    return solve


def g(V_I, w, V_h, V_z):
    """(17) less (14), by hand."""
    return K * V_I * np.hypot(V_h, V_I - V_z) - paper.thrust(w, V_h, V_z, V_I)


def air(rng: np.random.Generator, count: int):
    """Rotor speed from idling to full, any direction of flight up to about 30 m/s."""
    return rng.uniform(50, 1000, count), np.abs(rng.normal(0, 10, count)), rng.normal(0, 9, count)


def test_solves_the_equation_everywhere(solve, rng):
    w, V_h, V_z = air(rng, 20000)
    V_I, status = solve(w, V_h, V_z)
    assert np.abs(g(V_I, w, V_h, V_z)).max() < 1e-12
    assert (status != Defined.OK).mean() < 1e-3


def test_it_is_the_largest_root_and_alone(solve, rng):
    """On a grid above it no sign changes; where V_I < V_z there is none below it either, unless the status says so."""
    w, V_h, V_z = air(rng, 1500)
    V_I, status = solve(w, V_h, V_z)
    share = np.linspace(0, 1, 3000)
    for i in range(len(w)):
        above = V_I[i] + 1e-7 + 60 * share
        assert np.all(g(above, w[i], V_h[i], V_z[i]) > 0)
        below = V_I[i] - 1e-6 - (V_I[i] + 1 - min(V_z[i], 0)) * share
        single = bool(np.all(g(below, w[i], V_h[i], V_z[i]) < 0))
        if V_I[i] < V_z[i]:
            assert single == (status[i] == Defined.OK)
        else:
            assert status[i] == Defined.OK


def test_unique_where_the_descent_is_not_steep(solve, rng):
    """V_z < 2 sqrt(2) V_h: g' = K (2 u^2 + V_z u + V_h^2) / sqrt(V_h^2 + u^2) + b > 0."""
    w, V_h, V_z = air(rng, 5000)
    _, status = solve(w, V_h, np.minimum(V_z, 2.828 * V_h))
    assert np.all(status == Defined.OK)


def test_zero_in_plane_speed(solve):
    """V_h = 0: the quadratic K V_I u = a - b u has the closed form used here, in climb, hover and descent."""
    w, V_z = np.full(61, 520.0), np.linspace(-15, 15, 61)
    a = paper.thrust(520.0, 0, 0, 0)
    b = a - paper.thrust(520.0, 0, 0, 1)
    expected = (K * V_z - b + np.sqrt((K * V_z + b) ** 2 + 4 * K * a)) / (2 * K)
    V_I, status = solve(w, 0 * w, V_z)
    assert pytest.approx(expected, rel=1e-12) == V_I
    assert np.all(V_z < V_I) and np.all(status == Defined.OK)


def test_windmilling_climb(solve):
    """A fast climb at idle: the air turns the rotor, thrust and induced velocity are negative, and that is a root."""
    V_I, status = solve(100.0, 0.5, -12.0)
    assert V_I[0] < 0 and status[0] == Defined.OK
    assert g(V_I[0], 100.0, 0.5, -12.0) == pytest.approx(0, abs=1e-13)


def unrolled(lei_li, start, iterations):
    w, squared, axial = ca.SX.sym("w"), ca.SX.sym("squared"), ca.SX.sym("axial")
    equation = balance(lei_li.rotor, 3.32, w, squared, axial)
    return ca.Function("f", [w, squared, axial], [newton(equation, start(equation), iterations)])


def cruise(rng, count=5000):
    """Flights of 5 to 15 m/s: rotor speeds about hover, level or descending gently, the body tilted forward."""
    return rng.uniform(430, 680, count), rng.uniform(2, 15, count), rng.uniform(-5, 1.5, count)


def worst(lei_li, solve, rng, start):
    w, V_h, V_z = cruise(rng)
    exact, _ = solve(w, V_h, V_z)
    return [
        np.abs(np.array(unrolled(lei_li, start, k)(w[None], V_h[None] ** 2, V_z[None]))[0] - exact).max()
        for k in range(1, 5)
    ]


@pytest.mark.parametrize(
    ("start", "most"),
    [(lambda equation: paper.HOVER, [1.0, 0.06, 3e-4, 1e-8]), (starting_point, [0.06, 2e-4, 5e-9, 1e-13])],
    ids=["from hover", "from where the residual starts, one step better"],
)
def test_errors_of_newton_after_one_to_four_steps(lei_li, solve, rng, start, most):
    errors = worst(lei_li, solve, rng, start)
    assert np.all(np.array(errors) < most)


def test_starting_point_is_exact_in_axial_flight(lei_li, solve):
    V_z = np.linspace(-15, 15, 41)
    found = np.array(unrolled(lei_li, starting_point, 0)(np.full((1, 41), 500.0), np.zeros((1, 41)), V_z[None]))[0]
    exact, _ = solve(np.full(41, 500.0), 0 * V_z, V_z)
    thrusting = exact > 0
    assert found[thrusting] == pytest.approx(exact[thrusting], rel=1e-12)
    assert thrusting.sum() > 30


def test_four_steps_suffice_far_from_cruise(lei_li, solve, rng):
    """Any direction, half a newton to twelve: 99 % within 1e-5 m/s."""
    w, V_h = np.sqrt(rng.uniform(0.5, 12, 20000) / 8.663e-6), np.hypot(*rng.normal(0, 6, (2, 20000)))
    V_z = rng.normal(0, 6, 20000)
    exact, _ = solve(w, V_h, V_z)
    found = np.array(unrolled(lei_li, starting_point, 4)(w[None], V_h[None] ** 2, V_z[None]))[0]
    assert np.quantile(np.abs(found - exact), 0.99) < 1e-5


def test_sixteen_safe_steps_are_as_good_as_sixty(lei_li, solve, rng):
    """What the estimator uses."""
    w, squared, axial = ca.SX.sym("w"), ca.SX.sym("squared"), ca.SX.sym("axial")
    short = ca.Function("f", [w, squared, axial], [safe_newton(balance(lei_li.rotor, 3.32, w, squared, axial), 16)])
    w, V_h, V_z = air(rng, 5000)
    exact, status = solve(w, V_h, V_z)
    error = np.abs(np.array(short(w[None], V_h[None] ** 2, V_z[None]))[0] - exact)[status == Defined.OK]
    assert np.quantile(error, 0.999) < 1e-11 and error.max() < 0.3


def real_roots(w, V_h, V_z, C_la):
    """All V_I with (17) = (14), ascending: real roots of the squared equation, a quartic, that have the right sign."""
    c = paper.thrust(w, V_h, V_z, 0, C_la)  # T = c - b V_I
    b = c - paper.thrust(w, V_h, V_z, 1, C_la)
    quartic = np.polysub(K**2 * np.array([1, -2 * V_z, V_h**2 + V_z**2, 0, 0]), np.polymul([-b, c], [-b, c]))
    roots = np.roots(quartic)
    doubtful = np.any((np.abs(roots.imag) > 0) & (np.abs(roots.imag) < 1e-3))  # nearly two equal ones
    roots = roots.real[roots.imag == 0]
    return np.sort(roots[roots * (c - b * roots) > 0]), doubtful


def near_the_cusp(rng: np.random.Generator):
    """A steep descent in which the three induced velocities, or nearly, lie close together.

    b: about what makes g' zero at the inflection; a: g about zero there, within the width of the cusp, which goes with
    the distance in b to the power of 1.5. Rotor speed and lift slope follow.
    """
    V_h = 10 ** rng.uniform(-1, 0.6)
    V_z = V_h * rng.uniform(3, 12)
    u = -np.sqrt(2) * V_h * np.sinh(np.arcsinh(V_z / np.sqrt(2) / V_h) / 3)
    V_I, speed = V_z + u, np.hypot(V_h, u)
    distance = rng.choice([-1, 1], p=[0.3, 0.7]) * 10 ** rng.uniform(-2, -0.3)
    b = -K * (speed + V_I * u / speed) * (1 - distance)
    a = K * V_I * speed + b * u + 0.3 * rng.normal() * abs(distance) ** 1.5 * b * V_h
    # a = s th r C (r^2 w^2 / 3 + V_h^2 / 2), b = s r^2 C w / 2: a quadratic in w
    r, th, s = paper.R, paper.TH, paper.RHO * paper.C
    w = np.roots([2 * r * th / 3, -a / b, th * V_h**2 / r])
    if np.any(w.imag) or w.max() < 2:
        return None
    return w.real.max(), V_h, V_z, 2 * b / (s * r**2 * w.real.max())


def test_the_largest_of_all_roots_and_whether_it_is_the_only_one(lei_li, rng):
    """In steep descents, where the balance has one root or three: all of them by another method."""
    points = np.array([point for _ in range(2500) if (point := near_the_cusp(rng)) is not None])
    w, V_h, V_z, C_la = points.T
    found = solution_function(lei_li.rotor)(C_la[None], w[None], V_h[None] ** 2, V_z[None])
    V_I, status = (np.array(part)[0] for part in found)
    several, checked = 0, 0
    for i, point in enumerate(points):
        roots, doubtful = real_roots(*point)
        if doubtful or np.any(np.diff(roots) < 1e-4):
            continue
        assert V_I[i] == pytest.approx(roots[-1], rel=1e-6)
        alone = len(roots) == 1 or roots[-1] >= V_z[i]
        assert status[i] == (Defined.OK if alone else Defined.NOT_UNIQUE)
        several, checked = several + (not alone), checked + 1
    assert several > 200 and checked - several > 200


def test_where_there_is_no_model(lei_li):
    """A rotor at rest needs air at rest, from whichever side it comes; numbers that are none are significantly
    different."""
    status = solution_function(lei_li.rotor)
    for squared, axial in ((0.3, 0), (0, 0.3), (0, -0.3)):
        assert status(3.32, 0, squared, axial)[1] == Defined.STOPPED
    assert [float(value) for value in status(3.32, 0, 0, 0)] == [0, Defined.OK]
    for i in range(4):
        for bad in (np.nan, np.inf):
            arguments = [3.32, 500, 9, 1]
            arguments[i] = bad
            assert status(*arguments)[1] == Defined.NOT_FINITE
    assert status(3.32, 500, 9, -np.inf)[1] == Defined.NOT_FINITE
