"""The plant made of an identified model: its motion is the model's, its reading the specific force, noise as asked."""

import numpy as np
import pytest
from msgspec.structs import replace

from quadexp.errors import UsageError
from quadexp.experiment.build import model_residual
from quadexp.models.checkpoint import save_model
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.plugins.identification.from_model import FromModelPlant
from quadexp.plugins.identification.vehicle_model import FitSettings, fit_vehicle_model
from tests.models.recorded_flights import DRAG, OFFSET, crazyflie, recorded_flight

VEHICLE = crazyflie()
AT_REST = np.r_[0.0, 0.0, 1.0, 1.0, np.zeros(9)]


def plant(**options) -> FromModelPlant:
    residual = linear_drag_residual(VEHICLE, [0.4, 0.3, 0.1])
    return FromModelPlant(VEHICLE, residual, backend="interpreted", **options)


def test_velocity_decays_as_drag_says():
    """Level flight with the thrust of hovering: v_x' = -0.4 v_x, exactly."""
    x = AT_REST.copy()
    x[7] = 2.0
    hover = np.full(4, VEHICLE.hover_thrust)
    for _ in range(50):
        x, reading = plant().advance(x, hover, 0.02, np.random.default_rng(0))
    assert x[7] == pytest.approx(2.0 * np.exp(-0.4), rel=1e-9)
    assert x[0] == pytest.approx(5.0 * (1 - np.exp(-0.4)), rel=1e-9)
    assert reading == pytest.approx([-0.4 * x[7], 0.0, 9.81], abs=1e-9)


def test_commands_are_clipped_to_the_vehicle():
    truth = plant()
    ends = [truth.advance(AT_REST, np.full(4, thrust), 0.02, np.random.default_rng(0))[0] for thrust in (0.15, 10.0)]
    assert np.array_equal(*ends)


def test_noise_has_the_density_asked_for():
    """A velocity driven by white noise of density D / m for a time T spreads by D sqrt(T) / m, whatever the step."""
    density, rng = 1e-3, np.random.default_rng(0)
    for step in (1e-3, 5e-3):
        truth = plant(force_noise_density=density, step=step)
        hover = np.full(4, VEHICLE.hover_thrust)
        ends = np.array([truth.advance(AT_REST, hover, 0.02, rng)[0] for _ in range(1500)])
        assert np.std(ends[:, 7:10]) == pytest.approx(density / VEHICLE.mass * np.sqrt(0.02), rel=0.05)
        assert np.array_equal(ends[:, 10:], np.zeros((1500, 3)))


def test_it_is_the_model_that_flights_taught(tmp_path):
    flights = [recorded_flight(seed, VEHICLE) for seed in range(2)]
    model = fit_vehicle_model(flights, VEHICLE, FitSettings(powers=(1,), kinds=("linear", "quadratic")))
    path = save_model(tmp_path / "vehicle", model)
    residual = model_residual(VEHICLE, path, "linear")
    v, u = np.array([1.0, -0.5, 0.2]), np.full(4, 0.06)
    value = residual(np.r_[v, 0, 0, 0, u])[0]
    assert value[:2] == pytest.approx((-DRAG * v + OFFSET)[:2], abs=0.01)
    assert np.array_equal(value[3:], np.zeros(3))
    with pytest.raises(UsageError, match="blade_element"):
        model_residual(VEHICLE, path, "blade_element")


def test_the_scale_of_the_thrust_is_that_of_the_torque():
    """A model that says of the curve 0.2 more thrust: force and angular acceleration of the rotors are both 1.2 times,
    as they are pushed by the same blades."""
    flights = [recorded_flight(seed, VEHICLE) for seed in range(2)]
    fitted = fit_vehicle_model(flights, VEHICLE, FitSettings(powers=(1,), kinds=("quadratic",)), best="quadratic")
    assert fitted.quadratic.terms[2][0] == "thrust"
    z = np.r_[0.2, np.zeros(len(fitted.quadratic.terms[2]) - 1)]
    sides = [np.zeros(len(names)) for names in fitted.quadratic.terms[:2]]
    model = replace(fitted, quadratic=replace(fitted.quadratic, coefficients=(*sides, z)))
    truth = FromModelPlant(VEHICLE, model.residual(VEHICLE), backend="interpreted")
    thrusts = VEHICLE.hover_thrust * np.array([1.1, 0.9, 1.05, 0.8])
    moved, reading = truth.advance(AT_REST, thrusts, 1e-3, np.random.default_rng(0))
    torque = np.zeros(3)
    for thrust, position, spin in zip(thrusts, VEHICLE.rotor_position, VEHICLE.rotor_spin, strict=True):
        torque += 1.2 * thrust * (np.cross(position, [0, 0, 1]) + [0, 0, spin * VEHICLE.torque_coefficient])
    assert moved[10:] / 1e-3 == pytest.approx(np.linalg.solve(VEHICLE.inertia_matrix, torque), rel=1e-3)
    assert reading[2] == pytest.approx(1.2 * thrusts.sum() / VEHICLE.mass, rel=1e-3)
