"""What autopilots make of their parameters, by their own formulas, is the thrust and torque of the vehicle."""

import re
from dataclasses import replace

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment.vehicle_of import vehicle_named
from quadexp.plugins.exchange.autopilots import px4_sih
from quadexp.plugins.exchange.known import known_of
from quadexp.plugins.identification.vehicle_model import FitSettings, fit_vehicle_model
from tests.plugins.exchange.models import CURVE, crazyflie, crazyflie_flights, relative, states, torque

VEHICLE = vehicle_named("crazyflie", None)
FRD = np.diag([1, -1, -1])


def parameters(text: str) -> dict[str, float]:
    """Of a QGroundControl file: vehicle, component, name, value, type."""
    rows = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    assert all(row[:2] == ["1", "1"] and row[4] in ("6", "9") for row in rows)
    return {row[2]: float(row[3]) for row in rows}


def curve(model, voltage: float = 4.0) -> np.ndarray:
    """c_1, c_2 at a voltage; the flights' reference is 4 V, and the exponent 1."""
    assert model.thrust.reference_voltage == 4.0
    return model.thrust.coefficients * [voltage / 4, (voltage / 4) ** 2]


@pytest.mark.parametrize("voltage", [4.0, 3.6])
def test_px4_commands_the_signal_of_the_wished_thrust(export, voltage):
    """FunctionMotors solves f s^2 + (1 - f) s = u."""
    found = parameters(export("cf", "px4", "--voltage", str(voltage)))
    c1, c2 = curve(crazyflie(), voltage)
    wished = np.linspace(0.02, 1, 99)
    a, b = found["THR_MDL_FAC"], 1 - found["THR_MDL_FAC"]
    signal = -b / (2 * a) + np.sqrt(b**2 / (4 * a**2) + wished / a)
    assert (c1 * signal + c2 * signal**2) / (c1 + c2) == pytest.approx(wished, rel=1e-8)
    assert 4 * found["CA_ROTOR0_CT"] * found["MPC_THR_HOVER"] == pytest.approx(VEHICLE.mass * VEHICLE.gravity, rel=1e-8)
    assert found["THR_MDL_FAC"] == pytest.approx(CURVE[1] * voltage / (CURVE[0] * 4 + CURVE[1] * voltage), rel=0.1)


def test_px4_allocates_the_torques_of_the_vehicle(export):
    """ActuatorEffectivenessRotors: moment = CT r x axis - CT KM axis, axis = (0, 0, -1), FRD."""
    found = parameters(export("cf", "px4"))
    _, _, _, thrust = states(crazyflie(), VEHICLE)
    axis, wrench = np.array([0, 0, -1.0]), np.zeros((len(thrust), 3))
    for i in range(int(found["CA_ROTOR_COUNT"])):
        position = np.array([found[f"CA_ROTOR{i}_P{name}"] for name in "XYZ"])
        full = found[f"CA_ROTOR{i}_CT"]
        moment = full * np.cross(position, axis) - full * found[f"CA_ROTOR{i}_KM"] * axis
        wrench += np.outer(thrust[:, i] / full, moment)
    assert relative(wrench @ FRD, torque(VEHICLE, thrust)) < 1e-7


def test_px4s_simulation_has_thrust_torque_and_drag(export):
    """Sih::generate_force_and_torques, motors front right, back left, front left, back right, FRD."""
    found = parameters(export("cf", "px4_sih", "--motor-lag", "0.03"))
    velocity, _, _, thrust = states(crazyflie(), VEHICLE)
    order = [0, 2, 3, 1]  # of the Crazyflie's M1 (front right), M2 (back right), M3 (back left), M4 (front left)
    u = thrust[:, order] / found["SIH_T_MAX"]
    moments = np.column_stack(
        [
            found["SIH_L_ROLL"] * found["SIH_T_MAX"] * (-u[:, 0] + u[:, 1] + u[:, 2] - u[:, 3]),
            found["SIH_L_PITCH"] * found["SIH_T_MAX"] * (u[:, 0] - u[:, 1] + u[:, 2] - u[:, 3]),
            found["SIH_Q_MAX"] * (u[:, 0] + u[:, 1] - u[:, 2] - u[:, 3]),
        ]
    )
    assert relative(moments @ FRD, torque(VEHICLE, thrust)) < 1e-7
    drag = crazyflie().linear_drag.drag
    assert found["SIH_KDV"] == pytest.approx(VEHICLE.mass * (drag[0] + drag[1]) / 2, rel=1e-6)
    assert found["SIH_T_TAU"] == 0.03 and found["THR_MDL_FAC"] == 0
    for i, rotor in enumerate(order):
        assert found[f"CA_ROTOR{i}_PX"] == pytest.approx(VEHICLE.rotor_position[rotor][0])
        assert found[f"CA_ROTOR{i}_PY"] == pytest.approx(-VEHICLE.rotor_position[rotor][1])
    inertia = np.array([[found[f"SIH_I{''.join(sorted(a + b))}"] for b in "XYZ"] for a in "XYZ"])
    assert np.linalg.eigvalsh(inertia) == pytest.approx(np.linalg.eigvalsh(VEHICLE.inertia_matrix), rel=1e-6)


def test_ardupilots_expo_at_the_ends_of_the_spin_that_it_says(export):
    """AP_MotorsMulticopter: throttle = (e - 1 + sqrt((1 - e)^2 + 4 e u)) / (2 e) between MOT_SPIN_MIN and MAX."""
    text = export("cf", "ardupilot")
    found = dict(line.split(",") for line in text.splitlines() if line and not line.startswith("#"))
    c1, c2 = curve(crazyflie())
    e, hover = float(found["MOT_THST_EXPO"]), float(found["MOT_THST_HOVER"])
    beside = [float(x) for x in re.search(r"the defaults, they are (\S+) and (\S+)", text).groups()]
    for expo, share, low, high in ((e, hover, 0.0, 1.0), (*beside, 0.15, 0.95)):
        wished = np.linspace(0, 1, 50)
        throttle = (expo - 1 + np.sqrt((1 - expo) ** 2 + 4 * expo * wished)) / (2 * expo)
        signal = low + (high - low) * throttle
        ends = np.array([c1 * s + c2 * s * s for s in (low, high)])
        assert c1 * signal + c2 * signal**2 == pytest.approx(ends[0] + (ends[1] - ends[0]) * wished, rel=1e-3, abs=1e-9)
        assert ends[0] + (ends[1] - ends[0]) * share == pytest.approx(VEHICLE.gravity / 4, rel=1e-3)


@pytest.mark.parametrize(("firmware", "second_order"), [("4.5", False), ("2025.12", False), ("2026.6", True)])
def test_betaflights_percent_makes_the_thrust_most_linear(export, firmware, second_order):
    """Of all whole percents, by its C code: motorOutput *= 1 + e (1-x)^2, or 1 + e (1-x) (1 + e ((1-x) - x))."""
    found = int(
        re.search(r"^set thrust_linear = (\d+)$", export("cf", "betaflight", "--firmware", firmware), re.MULTILINE)[1]
    )
    c1, c2 = curve(crazyflie())
    x, departures = np.linspace(0.1, 1, 200), []
    for percent in range(151):
        e, inverse = percent / 100, 1 - x
        output = x * (1 + e * inverse * (1 + e * (inverse - x))) if second_order else x * (1 + e * inverse * inverse)
        departures.append(np.sqrt(np.mean(((c1 * output + c2 * output**2) / (c1 + c2) - x) ** 2)))
    assert found == np.argmin(departures) and departures[found] < departures[0] / 3


def test_an_interval_is_that_of_draws_from_the_fit():
    """Delta method against draws of c_1, c_2 from their covariance, which makes one of the other's errors up."""
    known = known_of(VEHICLE, crazyflie(), voltage=3.7)
    share = known.quantity(lambda p: p.c2 / (p.c1 + p.c2), "1")
    curve = crazyflie().thrust
    draws = np.random.default_rng(0).multivariate_normal(curve.coefficients, curve.covariance, 40_000)
    draws *= [3.7 / 4, (3.7 / 4) ** 2]
    spread = np.std(draws[:, 1] / draws.sum(axis=1))
    assert share.half_width == pytest.approx(1.96 * spread, rel=0.1)  # Student's t has a few more
    full = known.quantity(lambda p: p.full_thrust, "N")
    assert full.half_width == pytest.approx(1.96 * VEHICLE.mass * np.std(draws.sum(axis=1)), rel=0.1)


@pytest.mark.slow
def test_intervals_contain_the_truth():
    """Share of the square and full thrust at 4 V, of 40 vehicles with two flights each."""
    truth = np.array([CURVE[1] / sum(CURVE), VEHICLE.mass * sum(CURVE)])
    inside = np.zeros(2)
    for first in range(0, 80, 2):
        model = fit_vehicle_model(crazyflie_flights(2, first), VEHICLE, FitSettings(kinds=()), best="linear")
        known = known_of(VEHICLE, model)
        found = [known.quantity(lambda p: p.share, "1"), known.quantity(lambda p: p.full_thrust, "N")]
        inside += [abs(one.value - true) <= one.half_width for one, true in zip(found, truth, strict=True)]
    assert np.all(inside >= 35), inside


@pytest.mark.parametrize("to", ["px4", "px4_sih", "ardupilot", "betaflight"])
@pytest.mark.parametrize(("source", "has"), [("hb", "the curve is on rotor_speed"), ("vehicle=crazyflie", "no thrust")])
def test_an_autopilot_needs_motor_commands(export, to, source, has):
    said = export(source, to, code=2)
    assert "needs a thrust curve on motor commands" in said and has in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "add --firmware VERSION"),
        (("--firmware", "new"), "--firmware new: must be a version"),
        (("--firmware", "3.5"), "from 4.0 on"),
        (("--firmware", "4.5", "--motor-lag", "0.1"), "--motor-lag: --to betaflight does not use it"),
    ],
)
def test_betaflight_is_asked_for_its_version(export, options, message):
    assert message in export("cf", "betaflight", *options, code=2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rotor_spin": tuple(-spin for spin in VEHICLE.rotor_spin)}, "they turn the other way"),
        ({"rotor_position": ((0.05, 0, 0), (0, -0.05, 0), (-0.05, 0, 0), (0, 0.05, 0))}, "has four rotors in an x"),
        (
            {"rotor_position": ((0.05, -0.03, 0), (-0.02, -0.03, 0), (-0.03, 0.03, 0), (0.03, 0.03, 0))},
            "one arm along x",
        ),
    ],
)
def test_sih_has_one_layout_built_in(changes, message):
    vehicle = replace(VEHICLE, **changes)
    known = known_of(vehicle, crazyflie())
    with pytest.raises(UsageError, match=message):
        px4_sih(known)
