"""Columns in another unit or with another factor, a turn against a bias, a delay against a turn: of a known size."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import log_faults
from quadexp.log.schema import Flight
from quadexp.plugins.check.axis_scale import gains
from quadexp.plugins.check.quality import check_flight
from quadexp.plugins.check.signals import check_rotor_unit, plausible_speeds
from tests.log.imitated import attitude_of, imitated, vehicle_named
from tests.plugins.check.faults import ACC, P, V, W, changed, times, turned

DEGREES = 180 / np.pi
Q = ["q_w", "q_x", "q_y", "q_z"]


@pytest.fixture(scope="module")
def flight():
    return imitated(5, duration=40)


def named(flight):
    return [one for one in check_flight(flight) if one.severity != "info"]


def delayed(flight, names, seconds):
    late = {name: np.interp(flight.t - seconds, flight.t, flight[name]) for name in names}
    inner = (flight.t > 0.5) & (flight.t < flight.t[-1] - 0.5)
    columns = {**flight.columns, **late}
    return Flight({name: values[inner] for name, values in columns.items()}, flight.metadata)


def circle(speed=5.0, radius=4.0, rate=100.0, duration=30.0):
    """At a constant speed, where a delay is a turn about the vertical."""
    rng = np.random.default_rng(0)
    t = np.arange(0, duration, 1 / rate)
    omega = speed / radius
    x, y = radius * np.cos(omega * t), radius * np.sin(omega * t)
    p = np.column_stack([x, y, 2 + 0 * t])
    v = omega * np.column_stack([-y, x, 0 * t])
    a = -(omega**2) * np.column_stack([x, y, 0 * t])
    R = attitude_of(v, a, 0 * t, np.array([0.3, 0.3, 0.0]), 15)
    w = np.gradient(np.zeros_like(p), axis=0)
    w[1:-1] = (R[:-2].inv() * R[2:]).as_rotvec() * rate / 2
    columns = {"t": t}
    force = R.apply(a + [0, 0, 9.81], inverse=True)
    for names, values, noise in ((P, p, 5e-4), (V, v, 0.02), (W, w, 0.02), (ACC, force, 0.2)):
        noisy = values + noise * rng.standard_normal(values.shape)
        columns |= {name: noisy[:, i] for i, name in enumerate(names)}
    q = (R * Rotation.from_rotvec(0.003 * rng.standard_normal(p.shape))).as_quat(scalar_first=True)
    q *= np.cumprod(np.append(1.0, np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)))[:, None]
    return Flight({**columns, **{name: q[:, i] for i, name in enumerate(Q)}}, {"recorded": True})


def test_a_gain_lies_between_both_regressions():
    """Noise on either side, each axis with a gain of its own; the bounds are those of the definition. The estimate is
    within 1 %, where both regressions are off by up to 3 and 11 %."""
    rng = np.random.default_rng(0)
    halves = rng.normal(size=(10000, 3)) * [1.0, 2.0, 0.5]
    true = np.concatenate([halves, halves])
    factor = np.array([1.25, 1.0, 0.6])
    x = true + 0.1 * rng.normal(size=true.shape)
    y = factor * true + 0.1 * rng.normal(size=true.shape)
    gain = gains(x, y, len(halves))
    assert (gain.low - 3 * gain.low_error < np.append(factor, 9))[:3].all()
    assert (gain.high + 3 * gain.high_error > np.append(factor, 0))[:3].all()
    assert gain.size[:3] == pytest.approx(factor, rel=0.01)
    assert max(np.abs(gain.low[:3] / factor - 1)) > 0.02 and max(np.abs(gain.high[:3] / factor - 1)) > 0.05
    assert gain.apart(np.full(4, 0.03)).tolist()[:3] == [True, False, True]


@pytest.mark.parametrize(("column", "factor"), [("acc_y", 1.14), ("acc_y", 0.88)])
def test_a_small_factor_beside_the_thrust_is_said_and_does_not_block(flight, column, factor):
    """An attitude that leans with the motion looks the same, so both are named."""
    (found,) = named(Flight({**flight.columns, column: factor * flight[column]}, flight.metadata))
    assert found.name == "scale" and found.severity == "warning"
    assert column in found.measured and "leans with the motion" in found.measured
    undone = found.correction["acceleration"]["scale"]["xyz".index(column[-1])]
    assert undone == pytest.approx(1 / factor, rel=0.03)


@pytest.mark.parametrize(
    ("names", "factors", "key", "undone"),
    [
        (ACC, [1.25, 1, 1], "acceleration", [0.8, 1, 1]),
        (W, [1, 1, 1.2], "rate", [1, 1, 1 / 1.2]),
        (W, [DEGREES, DEGREES, 1], "rate", [1 / DEGREES, 1 / DEGREES, 1]),
        (P, [1, 1, 1 / 0.3048], "position", [1, 1, 0.3048]),
        (V, [1, 100, 1], "velocity", [1, 0.01, 1]),
        (ACC, [1 / 9.80665, 1, 1], "acceleration", [9.80665, 1, 1]),
    ],
)
def test_a_column_has_its_own_factor(flight, names, factors, key, undone):
    wrong = changed(times(names, np.array(factors)), flight)
    (found,) = named(wrong)
    assert found.name in ("units", "scale")
    assert found.correction[key]["scale"] == pytest.approx(undone, rel=0.02)
    mended = changed(times(names, np.array(found.correction[key]["scale"])), wrong)
    assert not named(mended)


@pytest.mark.parametrize("factor", [1000.0, 100.0])
def test_a_height_and_a_climb_in_another_unit(flight, factor):
    """They agree with each other, so that only the accelerometer tells."""
    (found,) = named(changed(times(("p_z", "v_z"), np.full(2, factor)), flight))
    undone = {"scale": [1.0, 1.0, 1 / factor]}
    assert (found.name, found.correction) == ("units", {"position": undone, "velocity": undone})


def test_a_gyro_of_four_per_cent_is_warned_of(flight):
    (found,) = named(changed(times(W, 1.04), flight))
    assert (found.name, found.severity) == ("scale", "warning")
    assert found.correction["rate"]["scale"] == pytest.approx(1 / 1.04, abs=0.012)


def test_what_is_left_after_a_correction_is_said(flight):
    """Degrees, and a noise of 0.6 rad/s along y that no correction takes away."""
    noisy = {name: values.copy() for name, values in flight.columns.items()}
    noisy["w_y"] += np.interp(flight.t, flight.t[::20], np.random.default_rng(0).normal(0, 0.9, len(flight.t[::20])))
    found = named(changed(times(W, DEGREES), Flight(noisy, flight.metadata)))
    (misfit,) = [one for one in found if one.name == "misfit"]
    assert "units" in {one.name for one in found} and "along y" in misfit.measured


@pytest.mark.parametrize("bias", [[0.5, -0.7, 0.0], [-0.9, 0.3, 0.4]])
def test_a_bias_is_no_turn(flight, bias):
    own = check_bias(flight)
    columns = {**flight.columns, **{name: flight[name] + b for name, b in zip(ACC, bias, strict=True)}}
    (found,) = named(Flight(columns, flight.metadata))
    assert found.name == "bias"
    assert found.correction["acceleration"]["offset"] == pytest.approx(own + bias, abs=0.1)


def check_bias(flight):
    """That of the imitated flight itself, by what the gap's mean is: (3,)."""
    from quadexp.plugins.check.sides import sensor_sides
    from quadexp.plugins.logs.signal.windows import cut, streams_of

    x, y = sensor_sides(cut(flight.t, streams_of(flight), np.ones(len(flight), bool)))["f"]
    return np.mean(y - x, axis=0)


def test_an_accelerometer_in_g_that_is_turned_has_no_bias_of_g(flight):
    """The unit is named, and which way both sensors stand: a constant of 9 m/s^2 is no bias of a sensor."""
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    in_g = changed(
        times(ACC, np.full(3, 1 / 9.80665)), changed(turned(quarter, ACC), changed(turned(quarter, W), flight))
    )
    found = [one for one in named(in_g) if one.correction]
    assert not any("offset" in lines for one in found for lines in one.correction.values())
    lines = [one.correction for one in found]
    assert {"acceleration": {"unit": "g"}} in lines and {"acceleration": {"frame": "body y -x z"}} in lines
    assert {"rate": {"frame": "body y -x z"}} in lines and len(lines) == 3


def test_a_turn_and_a_bias_at_once(flight):
    turn = Rotation.from_euler("x", 6, degrees=True).as_matrix()
    tilted = changed(turned(turn.T, ACC), flight)
    columns = {**tilted.columns, "acc_x": tilted["acc_x"] + 0.9}
    (found,) = named(Flight(columns, flight.metadata))
    lines = found.correction["acceleration"]
    assert lines["mounting"][0] == pytest.approx(6, abs=1.2) and abs(lines["mounting"][1]) < 1.5
    assert lines["offset"][0] == pytest.approx(0.9, abs=0.25)


def test_on_a_circle_a_late_pose_is_named_before_a_turn():
    """60 ms at 1.25 rad/s is a turn of 4.3 deg: the flight does not tell, both are named, the delay first."""
    (found,) = named(delayed(circle(), [*P, *V, *Q], 0.06))
    assert found.name == "time_offset" and "turned by 4.3 deg" in found.measured and "mounting" in found.advice


def test_a_sensor_turned_by_90_degrees_in_a_slow_flight_is_warned_of(monkeypatch):
    """It differs by no more than sensors do, but the air along the wrong axis says which way it stands."""
    monkeypatch.setattr(log_faults, "AMPLITUDES", 0.3 * log_faults.AMPLITUDES)
    rng = np.random.default_rng(11)
    log = {name: values[::10] for name, values in log_faults.truth(rng, 0.01, 0.03).items()}
    air = (log["t"] > 15) & (log["t"] < 65)
    columns = {"t": log["t"][air]}
    for names, letter in ((P, "p"), (V, "v"), (W, "w"), (ACC, "f"), (Q, "q")):
        values = log[letter][air]
        noisy = values + log_faults.NOISE.get(letter, 0.001) * rng.standard_normal(values.shape)
        columns |= {name: noisy[:, i] for i, name in enumerate(names)}
    slow = Flight(columns, {"recorded": True})
    assert not named(slow)
    quarter = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    (found,) = named(changed(turned(quarter, ACC), slow))
    assert (found.name, found.severity) == ("axis_swap", "warning")
    assert found.correction == {"acceleration": {"frame": "body y -x z"}}


def test_a_late_attitude_alone_is_no_turn():
    """Then the specific force tells: no turn is offered beside."""
    (found,) = named(delayed(circle(), Q, 0.06))
    assert found.name == "time_offset" and "turned" not in found.measured


def test_gyro_and_accelerometer_that_are_late_are_one_finding(flight):
    (found,) = named(delayed(flight, [*W, *ACC], 0.05))
    assert found.name == "time_offset" and "w_*" in found.where and "acc_*" in found.where


@pytest.mark.parametrize("vehicle", ["crazyflie", "torrente", "blackbird", "lei_li", "octo", None])
@pytest.mark.parametrize("unit", ["rad/s", "rpm"])
def test_rotor_speeds_in_rpm(vehicle, unit):
    """Of hovering vehicles: 9.55 times too large, faster than sound or than the hover by far."""
    body = None if vehicle is None else vehicle_named(vehicle)
    low, high = plausible_speeds(body)
    hover = 1500.0 if vehicle is None else np.sqrt(low * high)
    speed = np.full(100, hover * (60 / (2 * np.pi) if unit == "rpm" else 1.0))
    flight = Flight({"t": np.arange(100) / 100, **{f"rotor_speed_{i}": speed for i in range(4)}}, {})
    found = check_rotor_unit(flight, body)
    assert [one.correction for one in found] == ([{"rotor_speed": {"unit": "rpm"}}] if unit == "rpm" else [])
