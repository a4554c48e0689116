"""What blade-element and momentum theory must become in the limits, for rotors of any shape in air of any density."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadexp.errors import ModelDomainError
from quadexp.physics.drag import linear_drag_force, quadratic_drag_force
from quadexp.physics.motor import thrust_loss
from quadexp.plugins.aerodynamics.blade_element import blade_forces, body_drag, motor_coefficients, static_coefficients
from quadexp.plugins.aerodynamics.induced_velocity import balance, starting_point
from quadexp.plugins.papers.lei_li.blade_element import blade_element_residual
from quadexp.plugins.papers.lei_li.plant import BladeElementPlant
from tests.plugins.aerodynamics.aerodynamic_point import aerodynamic_point
from tests.properties.strategies import few, generators, make_blade, make_thrusts, vehicles

flat_vehicles = vehicles(flat=True)


def rotor_speeds(rng, vehicle, blade) -> np.ndarray:
    """About those of hover, (n,) (rad/s)."""
    k = static_coefficients(vehicle.rotor, blade).thrust
    return np.sqrt(make_thrusts(rng, vehicle) / k)


def strip_integrals(rotor, blade, w, u, V_h, samples=400) -> tuple[float, float, float]:
    """Thrust, hub force and torque by integrating the blades' elements over radius and azimuth.

    An element at radius x and azimuth psi meets U = w x + V_h sin psi in the plane and u through it, at the angle
    th - u / U: lift rho c / 2 U^2 C_la (th - u / U), tilted back by u / U, and drag rho c / 2 U^2 C_d0, per length.
    """
    nodes, weights = np.polynomial.legendre.leggauss(24)
    x, weight = rotor.radius / 2 * (nodes + 1), rotor.radius / 2 * weights
    psi = 2 * np.pi * np.arange(samples) / samples
    U = w * x[:, None] + V_h * np.sin(psi)
    q = rotor.air_density * rotor.chord / 2
    lift = q * blade.lift_slope * (rotor.twist * U**2 - u * U)
    drag = q * (blade.profile_drag * U**2 + blade.lift_slope * (rotor.twist * u * U - u**2))
    mean = rotor.blades * weight / samples
    return (
        float((mean[:, None] * lift).sum()),
        float((mean[:, None] * drag * np.sin(psi)).sum()),
        float((mean[:, None] * drag * x[:, None]).sum()),
    )


@few
@given(flat_vehicles, generators)
def test_hover_is_momentum_theory(vehicle, rng):
    """V = 0: V_I = sqrt(T / (2 rho A)), T = k_T,static w^2, Q = k_Q,static w^2; the power T V_I is the ideal one."""
    blade = make_blade(rng)
    w, static, rotor = rotor_speeds(rng, vehicle, blade), static_coefficients(vehicle.rotor, blade), vehicle.rotor
    point = aerodynamic_point(vehicle, blade, np.zeros(3), w)
    area = np.pi * rotor.radius**2
    assert np.allclose(point.thrust, static.thrust * w**2, rtol=1e-10)
    assert np.allclose(point.induced_velocity, np.sqrt(point.thrust / (2 * rotor.air_density * area)), rtol=1e-10)
    assert np.allclose(point.induced_velocity, static.inflow * w, rtol=1e-10)
    assert np.allclose(point.hub_force, 0, atol=1e-15)
    profile = rotor.blades * rotor.air_density * rotor.chord * blade.profile_drag * rotor.radius**4 * w**2 / 8
    assert np.allclose(point.drag_torque * w, point.thrust * point.induced_velocity + profile * w, rtol=1e-10)
    assert np.allclose(point.drag_torque, static.torque * w**2, rtol=1e-10)


@given(flat_vehicles, generators)
def test_forces_are_integrals_over_the_blades(vehicle, rng):
    """(9), (14): the closed form of the thrust is the integral of the elements' lift, for any advance ratio."""
    blade, rotor = make_blade(rng), vehicle.rotor
    w, u, V_h = rotor_speeds(rng, vehicle, blade)[0], 3 * rng.normal(), abs(6 * rng.normal())
    found = blade_forces(rotor, blade.profile_drag, blade.lift_slope, w, u, V_h**2)
    thrust, _, _ = strip_integrals(rotor, blade, w, u, V_h)
    assert np.isclose(found.thrust, thrust, rtol=1e-10)
    at_rest = blade_forces(rotor, blade.profile_drag, blade.lift_slope, w, u, 0.0)
    assert np.isclose(at_rest.torque, strip_integrals(rotor, blade, w, u, 0.0)[2], rtol=1e-10)
    profile = blade_forces(rotor, blade.profile_drag, 0.0, w, u, V_h**2)  # without lift: profile drag alone
    assert np.isclose(profile.hub * V_h, strip_integrals(rotor, _liftless(blade), w, u, V_h)[1], rtol=1e-10)


def _liftless(blade):
    return type(blade)(0.0, blade.profile_drag, blade.body_drag)


@few
@given(flat_vehicles, generators)
def test_the_shaft_pays_for_what_the_air_gets(vehicle, rng):
    """Q w = T u + H V_h + profile power, and thrust is what momentum theory says, in level and climbing flight.

    T = 2 rho A V_I sqrt(V_h^2 + (V_I - V_z)^2).
    """
    blade, rotor = make_blade(rng), vehicle.rotor
    w, v = rotor_speeds(rng, vehicle, blade), np.array([4, 4, 1]) * rng.normal(size=3)
    v[2] = abs(v[2])  # climbing: no wake to descend through
    point = aerodynamic_point(vehicle, blade, v, w)
    V_h, u = np.hypot(v[0], v[1]), point.induced_velocity + v[2]
    momentum = 2 * rotor.air_density * np.pi * rotor.radius**2 * point.induced_velocity * np.hypot(V_h, u)
    assert np.allclose(point.thrust, momentum, rtol=1e-9)
    r2 = rotor.radius**2
    s = rotor.blades * rotor.air_density * rotor.chord / 8 * blade.profile_drag * r2
    profile = s * (r2 * w**2 + 3 * V_h**2) * w
    assert np.allclose(point.drag_torque * w, point.thrust * u + point.hub_force * V_h + profile, rtol=1e-9)


@few
@given(flat_vehicles, generators)
def test_high_speed_inflow_is_glauerts(vehicle, rng):
    """V_h >> V_I: V_I -> T / (2 rho A V_h), the elliptic wing; the relative error is of the order (V_I / V_h)^2."""
    blade, rotor = make_blade(rng), vehicle.rotor
    w = rotor_speeds(rng, vehicle, blade)
    V_h = 8 * static_coefficients(rotor, blade).inflow * w.max()
    point = aerodynamic_point(vehicle, blade, [V_h, 0, 0], w)
    wing = point.thrust / (2 * rotor.air_density * np.pi * rotor.radius**2 * V_h)
    assert np.all(np.abs(point.induced_velocity / wing - 1) < (point.induced_velocity / V_h) ** 2)


@few
@given(flat_vehicles, st.floats(0, 2 * np.pi), generators)
def test_small_velocity_is_linear_drag(vehicle, direction, rng):
    """V -> 0: F_xy = -sum h_i V_xy, h = s [r^2 C_d0 / 2 - r th C_la nu / 6 + C_la nu^2 / 2] w, the same in every
    direction; deviations fall with V^2 (thrust) and V (body drag). The residual's Jacobian at rest is this slope."""
    blade, rotor = make_blade(rng), vehicle.rotor
    w, nu = rotor_speeds(rng, vehicle, blade), static_coefficients(rotor, blade).inflow
    s = rotor.blades * rotor.air_density * rotor.chord / 2
    lift = blade.lift_slope * nu * (nu / 2 - rotor.radius * rotor.twist / 6)
    slope = s * w.sum() * (rotor.radius**2 * blade.profile_drag / 2 + lift)
    along = np.array([np.cos(direction), np.sin(direction), 0])
    for speed in (1e-3, 1e-2):
        force = aerodynamic_point(vehicle, blade, speed * along, w).force
        drag = rotor.air_density * rotor.reference_area / 2 * speed * blade.body_drag[1]
        assert np.allclose(force[:2] / speed, -slope * along[:2], atol=1e-4 * speed**2 + 2 * drag + 1e-7 * abs(slope))
    k = static_coefficients(rotor, blade).thrust
    vehicle = replace(vehicle, thrust_coefficient=k)
    residual = blade_element_residual(vehicle, blade)
    _, jacobian = residual.function(np.r_[np.zeros(6), k * w**2], residual.theta)
    assert np.allclose(jacobian.full()[:2, :2], -slope / vehicle.mass * np.eye(2), rtol=1e-7, atol=1e-9)


@few
@given(flat_vehicles, generators)
def test_own_velocities_change_nothing_without_turning(vehicle, rng):
    """Rotor-local velocities: at w = 0 the same forces; a rate moves thrust from the rotors that advance or climb."""
    blade = make_blade(rng)
    w, v = rotor_speeds(rng, vehicle, blade), 3 * rng.normal(size=3)
    v[2] = abs(v[2])
    plain = aerodynamic_point(vehicle, blade, v, w)
    local = aerodynamic_point(vehicle, blade, v, w, rate=np.zeros(3))
    assert np.allclose(local.force, plain.force, rtol=1e-12)
    for axis in range(3):  # any rate is damped
        rate = 0.2 * np.eye(3)[axis]
        still, turning = (aerodynamic_point(vehicle, blade, np.zeros(3), w, rate=r) for r in (0 * rate, rate))
        assert (turning.torque - still.torque) @ rate < 0


@given(generators)
def test_drag_is_odd_opposes_motion_and_scales(rng):
    """Linear, quadratic and body drag take power at every velocity; twice the speed, two and four times the force."""
    v, k = 5 * rng.normal(size=3), rng.uniform(0.01, 1, 3)
    for force, power in ((linear_drag_force, 1), (quadratic_drag_force, 2)):
        one, two, back = (np.array(ca.DM(force(ca.DM(f * v), ca.DM(k)))).ravel() for f in (1, 2, -1))
        assert np.all(one * v < 0) and np.allclose(back, -one) and np.allclose(two, 2**power * one)
    assert np.allclose(ca.DM(linear_drag_force(ca.DM(v), ca.DM(k))).full().ravel(), -k * v)
    assert np.allclose(ca.DM(quadratic_drag_force(ca.DM(v), ca.DM(k))).full().ravel(), -k * v * np.abs(v))


@given(flat_vehicles, generators)
def test_body_drag_is_the_aerodynamic_one(vehicle, rng):
    """-S rho |v| C_D v / 2."""
    v, c, rotor = 5 * rng.normal(size=3), rng.uniform(0.01, 1, 3), vehicle.rotor
    force = np.array(ca.DM(body_drag(rotor, ca.DM(v), ca.DM(c)))).ravel()
    expected = -rotor.reference_area * rotor.air_density / 2 * np.linalg.norm(v) * c * v
    assert np.allclose(force, expected, rtol=1e-12)


@given(flat_vehicles, generators)
def test_motor_coefficients_are_what_is_left_without_flow(vehicle, rng):
    """(18)-(21) written out, and the motor loss of Torrente et al. as a share of the normalised thrust."""
    blade, rotor = make_blade(rng), vehicle.rotor
    s, r, motor = rotor.blades * rotor.air_density * rotor.chord / 2, rotor.radius, motor_coefficients(rotor, blade)
    assert np.isclose(motor.thrust, s * blade.lift_slope * r**3 * rotor.twist / 3, rtol=1e-12)
    assert np.isclose(motor.hub, s * blade.profile_drag * r**2 / 2, rtol=1e-12)
    assert np.isclose(motor.torque, s * blade.profile_drag * r**4 / 4, rtol=1e-12)
    u, k = make_thrusts(rng, vehicle), rng.uniform(0, 0.1)
    normalised = u / vehicle.thrust_max
    assert np.allclose(thrust_loss(u, k, vehicle.thrust_max), k * normalised**2 * vehicle.thrust_max, rtol=1e-12)


@given(flat_vehicles, generators)
def test_where_the_iteration_for_the_inflow_starts(vehicle, rng):
    """Descending faster than it can push air down, V_I < V_z: a Newton step from V_I = 0 on the thrust balance."""
    blade, rotor = make_blade(rng), vehicle.rotor
    w = 0.3 * rotor_speeds(rng, vehicle, blade)[0]
    nu = static_coefficients(rotor, blade).inflow
    equation = balance(rotor, blade.lift_slope, w, (0.5 * nu * w) ** 2, 8 * nu * w)
    if float(equation.value(equation.axial)) < 0:
        return  # V_I > V_z after all
    newton_step = -float(equation.value(0.0)) / float(equation.slope(0.0))
    assert float(starting_point(equation)) == pytest.approx(min(newton_step, equation.axial), rel=1e-9)


@pytest.mark.parametrize(
    ("w", "in_plane", "descent"),
    [(672.353, 2.98950, 22.2675), (701.642, 3.52331, 20.1862), (509.256, 2.75686, 14.3998)],
)
def test_a_settled_iteration_is_not_an_answer(lei_li, blade, w, in_plane, descent):
    """Steep descents where the quick iteration settles, on the lowest of several induced velocities: refused all the
    same, because none of them is the model's only one."""
    K = 2 * lei_li.rotor.air_density * np.pi * lei_li.rotor.radius**2
    V = np.linspace(-1, descent, 200_001)  # the balance of thrusts written out, and its roots counted
    s, r, th = lei_li.rotor.blade_density, lei_li.rotor.radius, lei_li.rotor.twist
    lift = s * blade.lift_slope * (r**3 * th * w**2 / 3 - r**2 * (V - descent) * w / 2 + r * th * in_plane**2 / 2)
    assert np.count_nonzero(np.diff(np.sign(K * V * np.hypot(in_plane, V - descent) - lift))) == 3
    plant = BladeElementPlant(lei_li, blade, backend="interpreted")
    x = np.r_[np.zeros(3), 1, np.zeros(3), in_plane, 0, -descent, np.zeros(3)]
    with pytest.raises(ModelDomainError, match="more than one induced velocity"):
        plant.advance(x, np.full(4, lei_li.thrust_coefficient * w**2), 1e-4)


@few
@given(vehicles(), generators)
def test_rotors_with_their_own_velocities_one_by_one(vehicle, rng):
    """v + omega x r_i at every rotor, high or low, and the wrench as the sum of r_i x F_i and of the drag torques."""
    blade, rotor = make_blade(rng), vehicle.rotor
    v, rate, w = 3 * rng.normal(size=3), rng.normal(size=3), rotor_speeds(rng, vehicle, blade)
    v[2] = 3 + abs(v[2])
    point = aerodynamic_point(vehicle, blade, v, w, rate=rate)
    velocity = v + np.cross(rate, np.array(vehicle.rotor_position))
    in_plane = np.hypot(velocity[:, 0], velocity[:, 1])
    through = point.induced_velocity + velocity[:, 2]
    alone = [
        blade_forces(rotor, blade.profile_drag, blade.lift_slope, *air)
        for air in zip(w, through, in_plane**2, strict=True)
    ]
    forces = np.array(
        [[-hub * x, -hub * y, thrust] for (thrust, hub, _), (x, y, _) in zip(alone, velocity, strict=True)]
    )
    reaction = sum(spin * torque for spin, (_, _, torque) in zip(vehicle.rotor_spin, alone, strict=True))
    drag = -rotor.reference_area * rotor.air_density / 2 * np.linalg.norm(v) * np.array(blade.body_drag) * v
    torque = np.cross(np.array(vehicle.rotor_position), forces).sum(axis=0) + [0, 0, reaction]
    assert np.allclose(point.thrust, forces[:, 2], rtol=1e-9)
    assert np.allclose(point.force, forces.sum(axis=0) + drag, rtol=1e-9, atol=1e-12)
    assert np.allclose(point.torque, torque, rtol=1e-8, atol=1e-10)
