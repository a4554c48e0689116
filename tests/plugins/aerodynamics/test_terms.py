"""Sums of named terms against plain numpy, and lumped coefficients against the blade elements of tests/paper.py."""

import math

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq

from quadexp.errors import DataError, UsageError
from quadexp.models.checkpoint import load_model, save_model
from quadexp.models.residual import AXES
from quadexp.physics.rotor import RotorGeometry
from quadexp.plugins.aerodynamics.blade_element import motor_coefficients, static_coefficients
from quadexp.plugins.aerodynamics.blocks import regress
from quadexp.plugins.aerodynamics.coefficients import BladeCoefficients
from quadexp.plugins.aerodynamics.terms import (
    SELF_CONSISTENT,
    Z_TERMS,
    Inflow,
    TermStructure,
    all_columns,
    fit_terms,
    term_residual,
)
from quadexp.plugins.identification.inflow import fit_inflow, momentum_of
from quadexp.plugins.identification.thrust_curve import ThrustCurve
from quadexp.plugins.identification.vehicle_model import VehicleModel
from tests.models.air_data import air_data

CHOSEN = (
    ("linear", "hub", "hub_climb", "hub_inflow", "hub_square"),
    ("offset", "quadratic", "body"),
    ("thrust", "climb", "advance", "induced", "inflow", "linear"),
)
KAPPA = 0.16  # 1/m


def induced_velocity(a: float, v: np.ndarray) -> float:
    """V with kappa V sqrt(v_x^2 + v_y^2 + (V + v_z)^2) = a, in climb or level flight."""
    return brentq(lambda V: KAPPA * V * np.sqrt(v[0] ** 2 + v[1] ** 2 + (V + v[2]) ** 2) - a, 0, 100, xtol=1e-14)


def terms(v: np.ndarray, a: np.ndarray, i: int) -> dict[str, float]:
    """Every phi of the axis i, as the names say: a (n,) thrusts per mass, w ~ sqrt(a) their rotors' speeds."""
    root, V = np.sqrt(a), np.array([induced_velocity(one, v) for one in a])
    more = V - np.sqrt(a / KAPPA)
    through = more + v[2]
    return {
        "offset": 1.0,
        "linear": -v[i],
        "quadratic": -v[i] * abs(v[i]),
        "body": -v[i] * np.linalg.norm(v),
        "hub": -v[i] * root.sum(),
        "hub_climb": -v[i] * v[2] * len(a),
        "hub_inflow": -v[i] * through.sum(),
        "hub_square": -v[i] * (through**2 / root).sum(),
        "thrust": a.sum(),
        "climb": -v[2] * root.sum(),
        "advance": len(a) * (v[0] ** 2 + v[1] ** 2),
        "induced": -(root * more).sum(),
        "inflow": -(root * through).sum(),
    }


@pytest.mark.parametrize("mass", [0.4, 2.7])
def test_is_the_sum_of_its_terms(odd_vehicle, rng, mass):
    structure = TermStructure(CHOSEN, mass, KAPPA)
    coefficients = rng.normal(size=structure.n_parameters)
    assert structure.n_parameters == 14
    residual = term_residual(odd_vehicle, structure, coefficients)
    for _ in range(5):
        v, rate, u = rng.normal(0, 4, 3), rng.normal(size=3), mass * rng.uniform(0.5, 4, 6)
        v[2] = abs(v[2])
        given = iter(coefficients)
        expected = [
            sum(c * terms(v, u / mass, i)[name] for name, c in zip(names, given, strict=False))
            for i, names in enumerate(CHOSEN)
        ]
        assert residual(np.r_[v, rate, u])[0] == pytest.approx([*expected, 0, 0, 0], rel=1e-9, abs=1e-11)


def test_the_induced_velocity_needs_the_radius(odd_vehicle):
    with pytest.raises(UsageError, match="term 'hub_inflow' needs the rotors' radius"):
        term_residual(odd_vehicle, TermStructure(CHOSEN, 1.0), np.zeros(14))


GAIN = 1.04  # of the thrust curve over the true static thrust: `thrust` has to make up for it


@pytest.fixture(scope="module")
def air(lei_li, blade):
    """Data, rotor accelerations of a curve that is 4 % too strong, and the coefficients that the derivation gives."""
    data = air_data(600)
    truth = lumped_coefficients(lei_li.rotor, blade, lei_li.mass, GAIN * lei_li.thrust_coefficient)
    return data, GAIN * lei_li.thrust_coefficient / lei_li.mass * data.rotor_speed**2, truth


def lumped_coefficients(
    geometry: RotorGeometry, blade: BladeCoefficients, mass: float, thrust_coefficient: float
) -> dict[tuple[str, str], float]:
    """What the table of quadexp.plugins.aerodynamics.terms gives for a known rotor: (axis, term) -> value.

    thrust_coefficient: m times the thrust curve's c_2 (N s^2), which may differ from k_T,static: `thrust` corrects for
    it.
    """
    s, r, twist, lift = geometry.blade_density, geometry.radius, geometry.twist, blade.lift_slope
    static = static_coefficients(geometry, blade)
    nu = static.inflow
    root = mass * math.sqrt(thrust_coefficient / mass)
    climb = s * lift * r**2 / 2
    hub = motor_coefficients(geometry, blade).hub + s * lift * nu * (nu / 2 - r * twist / 6)
    found = {("z", "inflow"): climb / root, ("z", "thrust"): static.thrust / thrust_coefficient - 1}
    found["z", "advance"] = s * lift * r * twist / 2 / mass
    for i, axis in enumerate("xyz"):
        found[axis, "body"] = geometry.air_density * geometry.reference_area * blade.body_drag[i] / 2 / mass
    for axis in "xy":
        found[axis, "hub"] = hub / root
        found[axis, "hub_inflow"] = s * lift * (nu - r * twist / 6) / mass
        found[axis, "hub_square"] = s * lift / 2 * root / mass**2
    return found


def inflow_of(lei_li, truth) -> Inflow:
    kappa = momentum_of(lei_li, None)
    return Inflow(kappa, truth["z", "inflow"], truth["z", "advance"], truth["z", "thrust"])


@pytest.mark.parametrize("axis", range(3))
def test_the_lumped_form_is_the_blade_element_model(lei_li, air, axis):
    data, rotors, truth = air
    names = tuple(name for name in SELF_CONSISTENT[axis] if name != "offset")
    columns = all_columns(
        tuple(names if i == axis else () for i in range(3)), data.velocity, rotors, tuple(inflow_of(lei_li, truth))
    )
    force = columns[axis] @ [truth[AXES[axis], name] for name in names]
    if axis == 2:
        force += rotors.sum(axis=1)
    assert force == pytest.approx(data.specific_force[:, axis], abs=1e-9)


def test_coefficients_are_found_through_the_induced_velocity(lei_li, air, rng):
    data, rotors, truth = air
    noisy = data.specific_force + 0.05 * rng.normal(size=data.specific_force.shape)
    fit = fit_inflow(data.velocity, rotors, noisy[:, 2] - rotors.sum(axis=1), momentum_of(lei_li, None))
    flight = np.zeros(len(rotors), int)
    found = regress(fit.design, fit.target, Z_TERMS, flight, flight, what="z")
    wanted = np.array([truth["z", name] for name in Z_TERMS])
    assert np.all(np.abs(found.coefficients - wanted) < found.half_width(0.999))
    assert found.coefficients[1] == pytest.approx(wanted[1], rel=0.02)
    assert found.coefficients[:3] == pytest.approx([fit.inflow.scale, fit.inflow.loss, fit.inflow.advance], abs=1e-6)
    for axis in (0, 1):
        columns = all_columns(SELF_CONSISTENT, data.velocity, rotors, tuple(fit.inflow))[axis]
        found = regress(columns, noisy[:, axis], SELF_CONSISTENT[axis], flight, flight, what="x")
        wanted = np.array([truth.get((AXES[axis], name), 0.0) for name in SELF_CONSISTENT[axis]])
        assert np.all(np.abs(found.coefficients - wanted) < found.half_width(0.999))


def test_truth_is_inside_at_the_nominal_rate(lei_li, air, rng):
    data, rotors, truth = air
    wanted = np.array([truth["z", name] for name in Z_TERMS])
    flight, inside = np.zeros(len(rotors), int), np.zeros(len(Z_TERMS))
    for _ in range(25):
        target = data.specific_force[:, 2] + 0.05 * rng.normal(size=len(rotors)) - rotors.sum(axis=1)
        fit = fit_inflow(data.velocity, rotors, target, momentum_of(lei_li, None))
        found = regress(fit.design, fit.target, Z_TERMS, flight, flight, what="z")
        inside += np.abs(found.coefficients - wanted) < found.half_width()
    assert np.all(inside / 25 >= 0.80)  # 0.95 less three and a half standard deviations of 25 draws


def test_hovering_data_show_no_loss(lei_li, rng):
    velocity, rotors = 1e-3 * rng.normal(size=(200, 3)), np.full((200, 4), 9.81 / 4) + 0.1 * rng.normal(size=(200, 4))
    with pytest.raises(
        DataError, match="do not show that flow through the rotors costs thrust|cannot be distinguished"
    ):
        fit = fit_inflow(velocity, rotors, 0.3 * velocity[:, 2], 2.0)
        flight = np.zeros(200, int)
        regress(fit.design, fit.target, Z_TERMS, flight, flight, what="z")


def test_the_expression_and_the_checkpoint_are_the_model(lei_li, air, tmp_path):
    data, rotors, truth = air
    flight = np.zeros(len(rotors), int)
    inflow = tuple(inflow_of(lei_li, truth))
    model = fit_terms(
        "blade_element", SELF_CONSISTENT, data.velocity, rotors, data.specific_force, flight, flight, what="x",
        momentum=inflow,
    )  # fmt: skip
    v, a = ca.SX.sym("v", 3), ca.SX.sym("a", 4)
    theta = np.concatenate(model.coefficients)
    outputs = TermStructure(model.terms, 1.0, inflow).acceleration(ca.vertcat(v, 0, 0, 0, a), theta)
    function = ca.Function("f", [v, a], [outputs])
    values = model.acceleration(data.velocity, rotors)
    for k in (0, 77, 599):
        assert np.array(function(data.velocity[k], rotors[k])).ravel() == pytest.approx(values[k], rel=1e-10)
    curve = ThrustCurve("u", np.array([1.0]), np.array([1.0]), np.array([0.0]), signal_range=np.array([0.0, 9.0]))
    path = save_model(tmp_path / "model", VehicleModel(curve, model, None, model, "blade_element"))
    again = load_model(path).model()
    assert again.momentum == inflow and np.array_equal(again.acceleration(data.velocity, rotors), values)
