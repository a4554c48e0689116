"""A step of a loop of the user's own is, in C, what it is in Python: every thrust and record, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

import quadexp as qx
from quadexp import loop
from quadexp.compile.compiler import compiler
from quadexp.control.compiled_loop import UserLoop
from quadexp.control.readings import HELD

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")

# What is flown, and the least share of its steps that C makes.
CONTROLLERS = {
    "nominal_mpc": 0.6,
    "nominal_mpc vehicle.thrust_max=3.0": 0.6,
    "nominal_mpc controller.motor_lag=0.03 controller.distance_limit=0.3": 0.3,
    "nominal_mpc controller.input_hold=deviation controller.attitude_error=body": 0.6,
    "perfect_mpc observer=wind controller.dead_time=0.02 horizon=robust": 0.05,  # large beliefs go by Python
    "perfect_mpc observer=wind delay=prediction horizon=robust": 0.05,  # what was assumed when a step began again
    "online_mpc controller.residual=[terms]": 0.0,
    "geometric observer=disturbance": 0.6,
    "pid adaptive=l1": 0.6,
    "dfbc rate_loop=indi rate_loop.rate=300": 0.6,
}


def steps(settings, monkeypatch, *, in_c, seed=0, count=150):
    """What a loop answers to a series of steps of every kind, and which of them C made."""
    made, original = [], UserLoop.step

    def step(self, *arguments):
        made.append(original(self, *arguments))
        return made[-1]

    with monkeypatch.context() as patch:
        patch.setattr(UserLoop, "step", step)
        if not in_c:
            patch.setattr(loop, "goes_in_c", lambda controller: False)
        flown = qx.controller(*settings, "trajectory=circle", "trajectory.speed=4", "trajectory.acceleration=2")
        rng, answers, k = np.random.default_rng(seed), [], 0
        window = flown._reference.window(40)
        for _ in range(count):
            answers.append(answer(flown, k, window, rng))
            k += int(rng.integers(5) > 0) + int(HELD / flown.period) * int(rng.integers(40) == 0)
    return answers, made


def answer(flown, k, window, rng):
    """One step: its thrusts, or the error that it raises, and the loop's record of it."""
    state = flown.reference_state(k * flown.period) + 0.05 * rng.normal(size=13)
    kind = rng.integers(14)
    state[:3] += (kind == 0) * rng.normal(size=3)
    state[3:7] *= rng.choice([-1, 1]) / np.linalg.norm(state[3:7])
    force, speed = np.r_[rng.normal(size=2), 9.81], 700 + 20 * rng.normal(size=flown.vehicle.n_rotors)
    if kind == 1:
        (state, force, speed)[rng.integers(3)][rng.integers(3)] = rng.choice([np.nan, np.inf, 1e200])
    if kind in (2, 3, 4):
        flown.prepare((k + (kind == 4)) * flown.period)
    if kind == 5:
        flown.controller.forget()
    readings = [None if rng.integers(8) == 0 else reading for reading in (force, speed)]
    measured = state if kind in (6, 7) else qx.Measurement(k * flown.period, state, *readings)
    try:
        thrusts = flown.step(measured, k * flown.period, window if kind in (2, 8) else None).tobytes()
    except qx.QuadexpError as error:
        thrusts = str(error)
    record = flown.record and flown.record._replace(solve_time=0.0)
    rates = None if flown.rates is None else flown.rates.tobytes()
    return thrusts, record, flown.failed, rates, [*flown.controller.log().values()]


@pytest.mark.parametrize("flown", CONTROLLERS)
def test_every_step(monkeypatch, flown):
    settings = [f"controller={flown.split()[0]}", *flown.split()[1:], "vehicle.thrust_coefficient=1.2e-5"]
    if "mpc" in flown:
        settings.append("controller.allow_unstable=true")
    compiled, made = steps(settings, monkeypatch, in_c=True)
    interpreted, none = steps(settings, monkeypatch, in_c=False)
    assert not none and sum(made) >= CONTROLLERS[flown] * len(compiled)
    for k, (one, other) in enumerate(zip(compiled, interpreted, strict=True)):
        assert one == other, k


def test_a_reading_is_held_from_when_it_was_good(monkeypatch):
    """C's readings count for those that Python holds, and no longer."""
    flown = qx.controller("controller=geometric", "adaptive=l1", "trajectory=hover")
    force, state = np.array([0, 0, 9.81]), flown.start
    for k in range(3):
        flown.step(qx.Measurement(k * flown.period, state, force, None))
    last = 2 * flown.period
    for t in np.arange(last + flown.period, last + 0.999 * HELD, flown.period):
        flown.step(qx.Measurement(float(t), state, np.full(3, np.nan), None))
    with pytest.raises(qx.QuadexpError, match="no good reading is younger"):
        flown.step(qx.Measurement(last + 1.01 * HELD, state, np.full(3, np.nan), None))


def test_two_loops_in_turn_are_two_loops(monkeypatch):
    """Each has its own arrays: what one is asked changes nothing of the other."""
    first, second = (qx.controller("controller=nominal_mpc", "trajectory=circle") for _ in range(2))
    alone = [first.step(first.start, t) for t in first.times[:6]]
    first.reset()
    for t, expected in zip(first.times[:6], alone, strict=True):
        assert first.step(first.start, t).tobytes() == expected.tobytes()
        second.step(second.start + 0.1 * np.eye(13)[0], t)
