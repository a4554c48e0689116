"""Commands that act late through a lag: against SciPy's integration; and what measured rotor speeds add."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid, solve_ivp

from quadexp.log.schema import Flight
from quadexp.models.rotor_thrust import HeldCommands, Timing, mean_thrust, measured_thrust
from quadexp.physics.state import STATE_COLUMNS, input_columns

DT = 0.02


def commands(rng, samples=30, rotors=4):
    return np.arange(samples) * DT, rng.uniform(1.0, 5.0, (samples, rotors))


def flight_of(t, u, **columns):
    return Flight({"t": t, **{f"u_{i}": u[:, i] for i in range(u.shape[1])}, **columns}, {})


@pytest.mark.parametrize(
    "timing",
    [
        Timing(0.03, 0.03),
        Timing(0.03, 0.03, delay=0.013),
        Timing(0.004, 0.06, delay=0.045),
        Timing(0.0125, 0.025, "rotor_speed"),
        Timing(0.2, 0.01, "rotor_speed", 0.02),
    ],
)
def test_the_thrust_of_held_commands_is_the_integrated_lag(rng, timing):
    """value and integral at any times; the right side is integrated piece by piece, from change to change."""
    t, u = commands(rng)
    squared = timing.lag_of == "rotor_speed"
    root, thrust = (np.sqrt, np.square) if squared else (np.asarray, np.asarray)
    first = np.full(4, 2.5)
    model = HeldCommands(t, u, timing, first)
    at = np.sort(rng.uniform(-0.02, t[-1] + timing.delay, 60))
    begin, y, area = -0.02, root(first), np.zeros(4)
    expected, integrals = [], []
    changes = [*(t + timing.delay), np.inf]
    for end in at:
        while begin < end:
            k = np.searchsorted(changes, begin, side="right") - 1
            command = root(u[k] if k >= 0 else first)
            until = min(end, changes[k + 1])

            def slope(_, s, c=command):
                return np.r_[(c - s[:4]) / np.where(c > s[:4], timing.lag_up, timing.lag_down), thrust(s[:4])]

            found = solve_ivp(slope, (begin, until), np.r_[y, area], rtol=1e-11, atol=1e-12).y[:, -1]
            begin, y, area = until, found[:4], found[4:]
        expected.append(thrust(y))
        integrals.append(area)
    assert model.value(at) == pytest.approx(np.array(expected), abs=1e-7)
    assert np.diff(model.integral(at), axis=0) == pytest.approx(np.diff(integrals, axis=0), abs=1e-8)


def test_without_lag_a_delay_shifts_the_commands(rng, vehicle):
    t, u = commands(rng)
    shifted = mean_thrust(flight_of(t, u), vehicle, Timing(delay=DT))
    assert np.isnan(shifted[0]).all() and shifted[1:] == pytest.approx(u[:-2], rel=1e-9)
    half = mean_thrust(flight_of(t, u), vehicle, Timing(delay=DT / 2))
    assert half[1:] == pytest.approx((u[:-2] + u[1:-1]) / 2, rel=1e-9)
    assert np.array_equal(mean_thrust(flight_of(t, u), vehicle, Timing()), u[:-1])


@pytest.mark.parametrize(
    ("speed", "recorded", "before"),
    [(3.0, False, "reference"), (1e-12, False, "hover"), (None, False, "hover"), (3.0, True, "command")],
)
def test_a_flight_begins_with_what_its_rotors_gave(rng, vehicle, speed, recorded, before):
    """In motion the thrusts of its reference within their limits; the mean over a held command u, from y on, is
    u + (y - u) (1 - exp(-dt / tau)) tau / dt."""
    t, u = commands(rng)
    lag, reference = 0.03, np.array([2.0, -3.0, 25.0, 4.0])
    columns = {}
    if speed is not None:
        first = np.r_[np.zeros(3), 1, np.zeros(3), speed, np.zeros(5), reference]
        names = [f"ref_{name}" for name in (*STATE_COLUMNS, *input_columns(4))]
        columns = {name: np.full(len(t), value) for name, value in zip(names, first, strict=True)}
    flight = flight_of(t, u, **columns)
    flight.metadata["recorded"] = recorded
    y = {"reference": [2.0, 0.0, 20.0, 4.0], "hover": np.full(4, vehicle.hover_thrust), "command": u[0]}[before]
    share = (1 - np.exp(-DT / lag)) * lag / DT
    assert mean_thrust(flight, vehicle, Timing(lag, lag))[0] == pytest.approx(u[0] + (y - u[0]) * share, abs=1e-12)


def test_measured_thrusts_correct_a_model_that_is_wrong(rng, lei_li):
    """Thrusts with a scale, and a lag that the model has 30 % too long: the speeds at the samples mend the means."""
    t, u = commands(rng, 60)
    scale, lag = np.array([1.1, 0.9, 1.0, 0.8]), 0.03
    fine = np.linspace(0.0, t[-1], 100 * (len(t) - 1) + 1)
    truth = HeldCommands(t, scale * u, Timing(lag, lag), scale * u[0])
    speed = np.sqrt(truth.value(t) / lei_li.thrust_coefficient)
    flight = flight_of(t, u, **{f"rotor_speed_{i}": speed[:, i] for i in range(4)})
    assert measured_thrust(flight, lei_li) == pytest.approx(truth.value(t))
    area = cumulative_trapezoid(truth.value(fine), fine, axis=0, initial=0.0)
    mean = np.diff(area[::100], axis=0) / DT
    found = mean_thrust(flight, lei_li, Timing(1.3 * lag, 1.3 * lag, measured=True))
    commanded = mean_thrust(flight, lei_li, Timing(1.3 * lag, 1.3 * lag))
    rms = [np.sqrt(np.mean((one - mean) ** 2)) for one in (found, commanded)]
    assert rms[0] < 0.03 < 0.3 < rms[1]


def test_a_state_that_is_late_belongs_to_earlier_thrusts(rng, lei_li):
    """With the speeds known the state's delay shifts measured thrusts; it is the same as a delay of commands alone."""
    t, u = commands(rng, 60)
    speed = np.sqrt(HeldCommands(t, u, Timing(0.03, 0.03, delay=0.01), u[0]).value(t) / lei_li.thrust_coefficient)
    flight = flight_of(t, u, **{f"rotor_speed_{i}": speed[:, i] for i in range(4)})
    late = mean_thrust(flight, lei_li, Timing(0.03, 0.03, delay=0.01, state_delay=0.015, measured=True))
    both = mean_thrust(flight, lei_li, Timing(0.03, 0.03, delay=0.025))
    assert late[15:] == pytest.approx(both[15:], abs=1e-3)


def test_without_a_thrust_coefficient_rotor_speeds_say_nothing(vehicle, rng):
    t, u = commands(rng)
    assert measured_thrust(flight_of(t, u, **{f"rotor_speed_{i}": u[:, i] for i in range(4)}), vehicle) is None
