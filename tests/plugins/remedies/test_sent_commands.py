"""Delivered thrusts: against a lag integrated over a late step-wise command, and from rotor speeds."""

import sys
import threading
from dataclasses import replace

import numpy as np
import pytest

import quadexp as qx
from quadexp.control.control_step import InputArrays, run
from quadexp.plugins.remedies.sent_commands import DeliveredThrust, SentCommands

PERIOD = 0.02


def now(delivered, speed=None) -> np.ndarray:
    """The thrusts at an instant with these rotor speeds, (4,), or without."""
    told = InputArrays(4)
    told.rotor_speed[...], told.rotor_speed_valid[0] = 0.0 if speed is None else speed, speed is not None
    run(delivered.before(told))
    return delivered.thrust


def go_on(delivered, command) -> None:
    """The end of an instant, at which this command, (4,), is sent."""
    run(delivered.after(command))
    delivered.memory.commit()


@pytest.mark.parametrize("lag", [0.0, 0.03])
@pytest.mark.parametrize("dead_time", [0.0, 0.013, 0.02, 0.047])
def test_commands_act_late_and_lag(vehicle, rng, dead_time, lag):
    first, commands, fine = rng.uniform(1, 5, 4), rng.uniform(1, 5, (6, 4)), 1e-5
    delivered = DeliveredThrust(vehicle, PERIOD, dead_time, lag)
    delivered.reset(first)
    assert np.array_equal(now(delivered), first)
    for command in commands:
        now(delivered)
        go_on(delivered, command)
    thrust, every = first.copy(), []
    for i in range(round(len(commands) * PERIOD / fine)):
        sent = int(np.floor((i * fine - dead_time) / PERIOD + 1e-9))
        acting = commands[sent] if sent >= 0 else first
        thrust = acting + (thrust - acting) * np.exp(-fine / lag) if lag else acting
        every.append(thrust)
    assert now(delivered) == pytest.approx(thrust, rel=1e-9)
    assert delivered.mean == pytest.approx(np.mean(every[-round(PERIOD / fine) :], axis=0), rel=1e-3)


def test_measured_rotor_speeds_are_believed(vehicle, rng):
    known = replace(vehicle, thrust_coefficient=2e-5)
    delivered = DeliveredThrust(known, PERIOD, lag=0.03)
    delivered.reset(np.full(4, 3.0))
    speeds = rng.uniform(200, 500, (2, 4))
    for speed in speeds:
        assert now(delivered, speed) == pytest.approx(2e-5 * speed**2)
        mean = delivered.mean.copy()
        go_on(delivered, np.full(4, 9.0))
    assert mean == pytest.approx(2e-5 * (speeds**2).mean(axis=0))


def test_speeds_say_nothing_without_a_coefficient(vehicle):
    delivered = DeliveredThrust(vehicle, PERIOD)
    delivered.reset(np.full(4, 3.0))
    assert now(delivered, np.full(4, 400.0)) == pytest.approx(3.0)


@pytest.mark.parametrize(
    "settings", ["dfbc", "geometric rate_loop=indi", "nominal_mpc rate_loop=indi", "dfbc observer=disturbance"]
)
def test_speeds_that_say_nothing_change_no_flight(settings):
    """Rotor speeds of a vehicle without a thrust coefficient: every thrust is that of a flight without them."""
    path = ("trajectory=lemniscate", "trajectory.speed=6", "plant=ideal", "plant.backend=interpreted")
    loop = qx.controller(*f"controller={settings}".split(), *path, "controller.backend=interpreted")
    flights = []
    for speed in (None, np.full(4, 500.0)):
        loop.reset()
        state, reading, thrusts = loop.start, None, []
        for t in loop.times[: round(2.0 / loop.period)]:
            thrusts.append(loop.step(qx.Measurement(t, state, reading, speed)))
            state, reading = loop.plant.advance(state, thrusts[-1], loop.period, np.random.default_rng(0))
        flights.append(thrusts)
    np.testing.assert_array_equal(*flights)


def test_controllers_of_one_size_share_no_buffers():
    """Two threads asked one function for the weights of theirs, and each got those of the other's delays."""
    spans, delays = np.array([[-PERIOD, 0.0]]), (0.0, 0.047)
    alone = [SentCommands(4, PERIOD, 0.3).weights(spans, delay, 0.02) for delay in delays]
    off, former = [], sys.getswitchinterval()

    def ask(i: int) -> None:
        sent = SentCommands(4, PERIOD, 0.3)
        off.append(max(np.abs(sent.weights(spans, delays[i], 0.02) - alone[i]).max() for _ in range(2000)))

    sys.setswitchinterval(1e-6)
    try:
        threads = [threading.Thread(target=ask, args=(i % 2,)) for i in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(former)
    assert off == [0.0] * 4
