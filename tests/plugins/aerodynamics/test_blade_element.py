"""The blade-element equations against the paper computed by hand in its own frame, and against what air must do."""

import casadi as ca
import numpy as np
import pytest

from quadexp.errors import ModelDomainError
from quadexp.plugins.aerodynamics.blade_element import (
    PRINTED,
    aerodynamic_wrench,
    blade_forces,
    motor_coefficients,
    static_coefficients,
)
from quadexp.plugins.aerodynamics.coefficients import BladeCoefficients
from tests import paper
from tests.plugins.aerodynamics.aerodynamic_point import aerodynamic_point

FLIGHTS = {  # paper's FRD: velocity (m/s) and its spread, rotor speed and its spread (rad/s)
    "hover": ([0, 0, 0], 0.0, 527, 60),
    "axial": ([0, 0, 0], [0, 0, 4], 527, 60),
    "climb": ([2, 1, -8], 1.0, 620, 60),
    "descent": ([1, -2, 6], 1.0, 500, 60),
    "deep descent": ([0.5, 0.2, 15], 0.1, 540, 40),
    "fast forward": ([14, -3, -5], 2.0, 600, 100),
    "braking": ([9, 2, 7], 1.0, 350, 150),
    "anything": ([0, 0, 0], 6.0, 500, 200),
}


def assert_close(found, expected, scale: float) -> None:
    """1e-9 relative, and as much of the scale of the largest term in sums that cancel."""
    assert found == pytest.approx(expected, rel=1e-9, abs=1e-9 * scale)


@pytest.mark.parametrize("name", FLIGHTS)
@pytest.mark.parametrize("printed", [False, True], ids=["adopted", "printed"])
def test_point_values(lei_li, blade, rng, name, printed):
    velocity, spread, speed, speed_spread = FLIGHTS[name]
    terms = {"A": 2.0, "B": 2 / 3} if printed else {}
    checked = 0
    for _ in range(12):
        V = np.array(velocity) + np.array(spread) * rng.normal(size=3)
        w = np.clip(speed + speed_spread * rng.normal(size=4), 60, None)
        try:
            found = aerodynamic_point(lei_li, blade, paper.flip(V), w, **({"terms": PRINTED} if printed else {}))
        except ModelDomainError:
            continue
        expected = paper.point(V, w, **terms)
        checked += 1
        assert_close(found.induced_velocity, expected.V_I, 1e-3)
        assert_close(found.thrust, expected.T, np.abs(expected.T).max())
        assert_close(found.hub_force, expected.H, np.abs(expected.H).max())
        assert_close(found.drag_torque, expected.Q, np.abs(expected.Q).max())
        assert_close(paper.flip(found.force), expected.F, np.abs(expected.F).max())
        assert_close(paper.flip(found.torque), expected.Gamma, np.abs(expected.T).max() * paper.D)
    assert checked >= 10


def test_other_coefficients(lei_li, rng):
    for _ in range(10):
        theta = np.array([0.22, 3.32, 0.01, 0.01, 0.02]) * rng.uniform(0.4, 3, 5)
        V, w = rng.normal(0, 5, 3), rng.uniform(300, 800, 4)
        expected = paper.point(V, w, C_la=theta[1], C_d0=theta[0], C_D=theta[2:])
        found = aerodynamic_point(lei_li, BladeCoefficients.from_parameters(theta), paper.flip(V), w)
        assert_close(paper.flip(found.force), expected.F, np.abs(expected.F).max())
        assert_close(paper.flip(found.torque), expected.Gamma, np.abs(expected.T).max() * paper.D)


def test_coefficients_of_table_1(lei_li, blade):
    """(18)-(21): 1.508e-5, 4.772e-5, 3.436e-7 in the paper; the static ones as derived from (14) = (17) at V = 0."""
    motor, static = motor_coefficients(lei_li.rotor, blade), static_coefficients(lei_li.rotor, blade)
    assert motor == pytest.approx((1.50819067e-5, 4.7718e-5, 3.435696e-7), rel=1e-8)
    assert static == pytest.approx((8.66293500e-6, 4.20790148e-7, 0.00891390137), rel=1e-9)
    assert lei_li.rotor.reference_area == pytest.approx(0.1590431281, rel=1e-9)


def test_printed_cross_terms_are_four_times_the_derived_ones(lei_li):
    """(14), (15): at w -> infinity they alone differ, A r th V_h^2 and -B r th u."""
    arguments = (lei_li.rotor, 0.22, 3.32, 500.0, 3.0, 25.0)
    adopted, printed = blade_forces(*arguments), blade_forces(*arguments, PRINTED)
    s = paper.RHO * paper.C * paper.R * paper.TH * 3.32
    assert printed.thrust - adopted.thrust == pytest.approx(1.5 * s * 25.0, rel=1e-12)
    assert printed.hub - adopted.hub == pytest.approx(-0.5 * s * 3.0, rel=1e-12)


def test_dimensionless_form(lei_li, rng):
    """(9)-(13) as printed, in mu and lambda, for any number of blades."""
    r, c, th, rho = paper.R, paper.C, paper.TH, paper.RHO
    for blades in (2, 3):
        rotor = type(lei_li.rotor)(r, c, th, rho, 0.1, blades)
        w, u, V_h, C_la, C_d0 = rng.uniform(300, 700), rng.uniform(-3, 9), rng.uniform(0, 12), 3.1, 0.2
        mu, lam = V_h / (w * r), u / (w * r)
        T = blades / 4 * rho * c * r**3 * C_la * w**2 * (2 / 3 * th * (1 + 1.5 * mu**2) - lam)
        H = blades / 4 * rho * c * r**3 * C_la * w**2 * (C_d0 / C_la * mu - th * lam * mu / 3 + lam**2 * mu)
        Q = blades / 8 * rho * c * r**4 * C_d0 * w**2 * (1 + 3 * mu**2) + (T * lam + H * mu) * r
        found = blade_forces(rotor, C_d0, C_la, w, u, V_h**2)
        assert (found.thrust, found.hub * V_h, found.torque) == pytest.approx((T, H, Q), rel=1e-12)


def test_rotors_of_their_own_lift(lei_li, blade, rng):
    """A factor on a rotor's lift slope: thrust and torques are those of rotors with that slope, one by one."""
    v, w, V_I = [4.0, -2.0, 1.0], rng.uniform(400, 600, 4), rng.uniform(2, 5, 4)
    share = np.array([1.0, 0.7, 1.3, 0.5])
    found = aerodynamic_wrench(lei_li, blade.parameters(), ca.DM(v), ca.DM(w), ca.DM(V_I), lift_scale=ca.DM(share))
    force, torque = (np.array(part).ravel() for part in found)
    rotor, squared = lei_li.rotor, v[0] ** 2 + v[1] ** 2
    forces = [
        blade_forces(rotor, blade.profile_drag, f * blade.lift_slope, w_i, V_i + v[2], squared)
        for f, w_i, V_i in zip(share, w, V_I, strict=True)
    ]
    thrust, hub, drag = np.array(forces, float).T
    body = -paper.RHO * paper.S / 2 * np.linalg.norm(v) * np.array(paper.C_D) * v
    assert force[2] == pytest.approx(thrust.sum() + body[2], rel=1e-12)
    assert force[0] == pytest.approx(-hub.sum() * v[0] + body[0], rel=1e-12)
    roll, pitch = paper.D * (thrust[3] - thrust[1]), paper.D * (thrust[2] - thrust[0])
    assert torque == pytest.approx([roll, pitch, drag @ [1, -1, 1, -1]], rel=1e-12)


class TestWhereItIsNotDefined:
    def test_stopped_rotor_in_moving_air(self, lei_li, blade):
        with pytest.raises(ModelDomainError, match="rotor 2: it is stopped in moving air"):
            aerodynamic_point(lei_li, blade, [3.0, 0, 0], [500, 500, 0, 500])

    def test_stopped_rotor_in_still_air(self, lei_li, blade):
        point = aerodynamic_point(lei_li, blade, np.zeros(3), [500, 500, 0, 500])
        assert point.thrust[2] == pytest.approx(0, abs=1e-15)
        assert point.force[2] == pytest.approx(3 * 8.66293500e-6 * 500**2, rel=1e-9)

    def test_own_wake(self, lei_li, blade):
        """A steep descent where three induced velocities solve (14) = (17), all below V_z (counted here on a grid)."""
        V_h, V_z, w = 3.2350675658648784, 16.29553718864495, 586.4380536131179
        V_I = np.linspace(-1, 40, 400001)
        g = 2 * paper.RHO * np.pi * paper.R**2 * V_I * np.hypot(V_h, V_I - V_z) - paper.thrust(w, V_h, V_z, V_I)
        roots = V_I[np.flatnonzero(np.diff(np.sign(g)))]
        assert len(roots) == 3 and roots.max() < V_z
        with pytest.raises(ModelDomainError, match="more than one induced velocity"):
            aerodynamic_point(lei_li, blade, [V_h, 0, -V_z], np.full(4, w))

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_not_finite(self, lei_li, blade, bad):
        with pytest.raises(ModelDomainError, match="not a finite number"):
            aerodynamic_point(lei_li, blade, [bad, 0, 0], np.full(4, 500))
