"""Thrust curves from commands, rotor speeds and logged accelerations, with the drag along z beside them."""

import numpy as np
import pytest

from quadexp.errors import DataError
from quadexp.log.schema import Flight
from quadexp.models.regression import half_width
from quadexp.plugins.identification.thrust_curve import CurveSettings, ThrustCurve, fit_thrust_samples
from quadexp.plugins.logs.samples import choose_signal, gather
from tests.models.logged_flights import CURVE, DRAG, logged_flight


def fit_thrust_curve(flights, *, signal=None, drag=True, **settings) -> ThrustCurve:
    return fit_thrust_samples(gather(flights, choose_signal(flights, signal)), CurveSettings(**settings), drag=drag)[0]


@pytest.fixture(scope="module")
def flights():
    return [logged_flight(seed) for seed in range(3)]


def test_command_and_voltage(flights):
    curve = fit_thrust_curve(flights)
    assert curve.signal == "motor_command" and curve.reference_voltage == 4.0 and curve.rotors == 4
    assert np.all(np.abs(curve.coefficients - CURVE) < half_width(curve.errors, curve.freedom, 0.99))
    assert abs(curve.drag_z - DRAG[2]) < half_width(curve.drag_z_error, curve.freedom, 0.99)
    assert curve.residual_std == pytest.approx(0.05, rel=0.1)


def test_truth_is_inside_at_the_nominal_rate():
    inside = np.zeros(3)
    for seed in range(60):
        curve = fit_thrust_curve([logged_flight(100 + seed, seconds=10)])
        found = np.r_[curve.coefficients, curve.drag_z] - [*CURVE, DRAG[2]]
        inside += np.abs(found) < half_width(np.r_[curve.errors, curve.drag_z_error], curve.freedom)
    assert np.all(inside / 60 >= 0.85)  # 0.95 less three standard deviations of 60 draws


def test_drag_fitted_apart_goes_into_the_curve(flights):
    """A vehicle that climbs against drag commands more thrust: the curve alone takes that for less thrust a command."""
    columns = dict(flights[0].columns)
    climb = columns["v_z"] - columns["v_z"].mean()
    columns |= {f"motor_command_{i}": 0.75 + 0.05 * climb for i in range(4)}
    scaled = columns["motor_command_0"] * columns["battery_voltage"] / 4
    columns |= {"q_w": np.ones(len(climb))} | {f"q_{axis}": 0 * climb for axis in "xyz"}
    columns["acc_z"] = 4 * (CURVE[0] * scaled + CURVE[1] * scaled**2) - 0.5 * columns["v_z"]
    flight = Flight(columns, flights[0].metadata)
    together, alone = (fit_thrust_curve([flight], drag=drag) for drag in (True, False))
    assert together.coefficients == pytest.approx(CURVE, rel=1e-6) and together.drag_z == pytest.approx(0.5, rel=1e-6)
    assert np.all(np.abs(alone.coefficients - CURVE) > 0.3)


def test_voltage_exponent():
    flights = [logged_flight(seed, exponent=0.7) for seed in range(3)]
    curve = fit_thrust_curve(flights, voltage_exponent=None)
    assert abs(curve.voltage_exponent - 0.7) < half_width(curve.voltage_exponent_error, curve.freedom, 0.99) < 0.2
    assert np.all(np.abs(curve.coefficients - CURVE) < half_width(curve.errors, curve.freedom, 0.99))


def test_rotor_accelerations_are_the_curve_at_each_rotors_command(flights):
    curve = fit_thrust_curve(flights)
    rotors = curve.rotor_acceleration(flights[0])
    assert rotors.shape == (2000, 4)
    k = 700
    s = flights[0]["motor_command_2"][k] * flights[0]["battery_voltage"][k] / 4
    assert rotors[k, 2] == pytest.approx(curve.coefficients[0] * s + curve.coefficients[1] * s**2)


def test_rotor_speed_and_logged_acceleration(flights, rng):
    columns = dict(flights[0].columns)
    speed = 2000 + 200 * rng.normal(size=(2000, 4))
    columns |= {f"rotor_speed_{i}": speed[:, i] for i in range(4)}
    columns["acc_z"] = 6e-7 * (speed**2).sum(axis=1) + 0.05 * rng.normal(size=2000)
    curve = fit_thrust_curve([Flight(columns, flights[0].metadata)])
    assert curve.signal == "rotor_speed" and curve.reference_voltage == 0
    assert abs(curve.coefficients[0] - 6e-7) < half_width(curve.errors, curve.freedom, 0.99)[0]
    columns["thrust_acceleration"] = (columns["acc_z"] - 0.3) / 0.95 + 0.01 * rng.normal(size=2000)
    curve = fit_thrust_curve([Flight(columns, flights[0].metadata)], signal="thrust_acceleration")
    assert curve.coefficients[0] == pytest.approx(0.95, abs=0.01) and curve.intercept == pytest.approx(0.3, abs=0.1)
    assert curve.rotor_acceleration(Flight(columns, {})).shape == (2000, 4)
    assert curve.rotor_acceleration(Flight(columns, {})).sum(axis=1) == pytest.approx(columns["acc_z"], abs=0.06)


def test_what_the_flights_cannot_tell(flights):
    with pytest.raises(DataError, match="flight_0: columns rotor_speed_0 .. are missing"):
        fit_thrust_curve(flights, signal="rotor_speed")
    silent = Flight({k: v for k, v in flights[1].columns.items() if not k.startswith("motor")}, {"name": "silent"})
    with pytest.raises(DataError, match="no signal of the thrust is in every flight"):
        fit_thrust_curve([flights[0], silent])
    columns = flights[0].columns | {"acc_z": flights[0]["acc_z"].copy()}
    columns["acc_z"][7] = np.nan
    with pytest.raises(DataError, match="spoilt: column 'acc_z' is not finite in row 7"):
        fit_thrust_curve([Flight(columns, {"name": "spoilt", "recorded": True})])
    columns = flights[0].columns | {"battery_voltage": np.r_[0.0, flights[0]["battery_voltage"][1:]]}
    with pytest.raises(DataError, match="flat: battery_voltage is 0 V in row 0"):
        fit_thrust_curve([Flight(columns, {"name": "flat", "recorded": True})])


def test_simulated_commands_belong_to_the_interval_before(flights):
    """A simulated reading is of the end of the interval over which the row before's command was held."""
    columns = dict(flights[0].columns)
    thrust = np.stack([columns[f"motor_command_{i}"] for i in range(4)], axis=1) * 3
    columns |= {f"u_{i}": thrust[:, i].copy() for i in range(4)}
    columns["acc_z"] = np.r_[9.81, thrust.sum(axis=1)[:-1]]
    curve = fit_thrust_curve([Flight(columns, {"name": "simulated"})], signal="u", drag=False)
    assert curve.coefficients[0] == pytest.approx(1.0, rel=1e-12) and curve.residual_std < 1e-12
