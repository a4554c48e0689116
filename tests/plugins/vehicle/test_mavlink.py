"""The bridge over MAVLink against a stand-in autopilot on loopback, and its frames by themselves."""

from __future__ import annotations

import signal
import socket
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from quadexp import requests
from quadexp.errors import QuadexpError, UsageError
from quadexp.log.schema import Flight
from quadexp.loop import controller
from quadexp.physics.rotation import rotation_matrix
from quadexp.plugins.vehicle.mavlink.frames import ThrustMap, swapped, thrust_map, turned
from quadexp.plugins.vehicle.mavlink.link import address
from quadexp.plugins.vehicle.mavlink.session import Asked, fly_mavlink
from quadexp.plugins.vehicle.rates import rate_gain, wanted_rates
from tests.plugins.vehicle.stand_in import StandIn

PATH = ("trajectory=circle", "trajectory.speed=4", "trajectory.acceleration=2", "trajectory.radius=2")
INVERSE = Asked(rates="inverse=25,25,10", arm=True, lockstep=True)


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def bridged(*settings: str, asked: Asked = INVERSE, **faults: Any) -> tuple[Flight, StandIn]:
    """A flight through the stand-in, and what that saw."""
    messages = pytest.importorskip("pymavlink.dialects.v20.common")
    port = free_port()
    stand_in = StandIn(controller(*settings, *PATH), port, messages, **faults)
    stand_in.start()
    try:
        return fly_mavlink(f"udp:127.0.0.1:{port}", [*settings, *PATH], None, asked), stand_in
    finally:
        stand_in.join(5)


def bench_error(*settings: str) -> float:
    flight = requests.simulate([*settings, *PATH]).flight
    return float(flight.metadata["row"]["mean_error"])


def logged_errors(flight: Flight) -> np.ndarray:
    columns = flight.columns
    away = np.stack([columns[f"p_{axis}"] - columns[f"ref_p_{axis}"] for axis in "xyz"])
    return np.asarray(np.linalg.norm(away, axis=0))


@pytest.mark.parametrize("name", ["controller=nominal_mpc", "controller=geometric"])
def test_a_circle_is_flown_as_well_as_on_the_bench(name: str) -> None:
    flight, stand_in = bridged(name)
    assert flight.metadata["outcome"] == "ok", flight.metadata["cause"]
    assert len(flight) == len(stand_in.errors)
    assert np.mean(stand_in.errors) == pytest.approx(bench_error(name), rel=0.2)
    assert logged_errors(flight) == pytest.approx(stand_in.errors, abs=1e-5)  # a message is in floats


def test_a_flight_says_how_late_commands_were() -> None:
    flight, stand_in = bridged("controller=perfect_mpc")
    assert 0 < flight.metadata["latency_ms"]["p50"] <= flight.metadata["latency_ms"]["p99"]
    assert np.mean(stand_in.errors) < 1.2 * bench_error("controller=perfect_mpc")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["controller=perfect_mpc", "controller=nominal_mpc"])
def test_a_circle_in_real_time(name: str) -> None:
    """Within half of the bench's error; a machine without a core to spare may answer too late for that."""
    flight, _ = bridged(name, asked=replace(INVERSE, lockstep=False), paced=True)
    assert flight.metadata["outcome"] == "ok", flight.metadata["cause"]
    assert logged_errors(flight).mean() == pytest.approx(bench_error(name), rel=0.5)


def test_parts_of_a_state_are_put_together_where_there_is_no_odometry() -> None:
    flight, stand_in = bridged("controller=nominal_mpc", whole=False)
    assert flight.metadata["outcome"] == "ok", flight.metadata["cause"]
    assert np.mean(stand_in.errors) == pytest.approx(bench_error("controller=nominal_mpc"), rel=0.2)


def test_predicted_rates_fly() -> None:
    flight, _ = bridged("controller=nominal_mpc", asked=Asked(arm=True, lockstep=True))
    assert flight.metadata["outcome"] == "ok", flight.metadata["cause"]


@pytest.mark.parametrize(
    ("faults", "outcome", "said"),
    [
        ({"silent_at": 40}, "lost", "the link is silent"),
        ({"reset_at": 40}, "solver_failed", "estimate was reset"),
        ({"place": lambda t: np.nan if t > 0.395 else 0.0}, "lost", "estimate is no number"),
    ],
)
def test_it_ends_with_a_reason(faults: dict[str, Any], outcome: str, said: str) -> None:
    flight, _ = bridged("controller=geometric", **faults)
    assert flight.metadata["outcome"] == outcome
    assert said in flight.metadata["cause"]
    assert len(flight) == 40


@pytest.mark.parametrize(
    ("stamp", "said"),
    [(lambda t: t + 100 * (t > 1.5), "the time of the states jumps by 100"), (lambda t: t - (t > 1.5), "is silent")],
)
def test_a_clock_that_jumps_ends_the_flight(stamp: Any, said: str) -> None:
    flight, _ = bridged("controller=geometric", asked=replace(INVERSE, lockstep=False), paced=True, stamp=stamp)
    assert flight.metadata["outcome"] == "lost"
    assert said in flight.metadata["cause"]
    assert len(flight) < 200


def test_messages_of_others_are_ignored() -> None:
    """A gimbal behind the same address, another vehicle, what is no message, half of one, one of another dialect."""
    kinds = pytest.importorskip("pymavlink.dialects.v20.common")
    gimbal = kinds.MAVLink_heartbeat_message(kinds.MAV_TYPE_GIMBAL, kinds.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    unknown = [float("nan")] * 21
    place, level = (90.0, 90.0, 90.0), [1.0, 0.0, 0.0, 0.0]
    far = kinds.MAVLink_odometry_message(0, 1, 12, *place, level, 0, 0, 0, 0, 0, 0, unknown, unknown, 7, 0, 100)
    of_gimbal = gimbal.pack(kinds.MAVLink(None, srcSystem=1, srcComponent=kinds.MAV_COMP_ID_GIMBAL))
    of_other = far.pack(kinds.MAVLink(None, srcSystem=2, srcComponent=1))
    of_dialect = of_gimbal[:7] + b"\x39\x30\x01" + of_gimbal[10:]
    beside = of_gimbal, of_other, b"hello", of_other[:40], of_dialect
    flight, stand_in = bridged("controller=geometric", beside=beside)
    assert flight.metadata["outcome"] == "ok", flight.metadata["cause"]
    assert logged_errors(flight) == pytest.approx(stand_in.errors, abs=1e-5)


def test_a_flight_that_is_stopped_is_written() -> None:
    def stop(t: float) -> float:
        if 0.495 < t < 0.505:
            signal.raise_signal(signal.SIGINT)
        return 0.0

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # dask-jobqueue, once imported, has another one
    try:
        flight, _ = bridged("controller=geometric", place=stop)
    finally:
        signal.signal(signal.SIGINT, before)
    assert (flight.metadata["outcome"], flight.metadata["cause"]) == ("lost", "stopped by Ctrl-C")
    assert 49 <= len(flight) <= 51
    assert np.isfinite(logged_errors(flight)).all()


def test_another_autopilot_is_refused() -> None:
    with pytest.raises(QuadexpError, match="PX4"):
        bridged("controller=geometric", autopilot=3)


def test_it_arms_only_when_asked() -> None:
    flight, stand_in = bridged("controller=geometric", asked=Asked(rates=INVERSE.rates, lockstep=True), arms=True)
    assert flight.metadata["outcome"] == "ok"  # somebody else armed
    assert stand_in._armed


@pytest.mark.parametrize("target", ["udp:192.168.1.4:14540", "udp:vehicle.local:14540", "udp:0.0.0.0:14540"])
def test_addresses_off_this_machine_need_a_word(target: str) -> None:
    with pytest.raises(UsageError, match="--vehicle-is-real"):
        address(target, real=False)
    assert address(target, real=True)[1] == 14540


@pytest.mark.parametrize("target", ["tcp:127.0.0.1:1", "udp:127.0.0.1", "udp::14540", "udp:127.0.0.1:99999", "serial"])
def test_other_targets_are_refused(target: str) -> None:
    with pytest.raises(UsageError, match="udp:HOST:PORT"):
        address(target, real=True)


def test_predicted_rates_need_a_prediction() -> None:
    pytest.importorskip("pymavlink")
    with pytest.raises(UsageError, match="predicts no body rates"):
        fly_mavlink("udp:127.0.0.1:1", ["controller=geometric", *PATH], None, Asked())


# --------------------------------------------------------------------------------------------------------------- frames
def test_frames_turn_as_matrices_do() -> None:
    rng = np.random.default_rng(1)
    world, body = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1.0, -1, -1])
    for _ in range(20):
        q = rng.normal(size=4)
        q /= np.linalg.norm(q)
        assert np.allclose(rotation_matrix(turned(q)).full(), world @ rotation_matrix(q).full() @ body)
        assert np.allclose(np.abs(turned(turned(q)) @ q), 1)
    v = rng.normal(size=3)
    assert np.allclose(swapped(v), world @ v)
    assert np.allclose(turned([1, 0, 0, 0]), [np.sqrt(0.5), 0, 0, np.sqrt(0.5)])  # nose north: a quarter from east


def test_thrust_is_inverted() -> None:
    curve = ThrustMap(40.0, 0.7)
    for share in (0.0, 0.2, 0.9, 1.0):
        assert curve.share(40 * (0.7 * share**2 + 0.3 * share)) == pytest.approx(share)
    assert ThrustMap(40.0).share(50) == 1
    vehicle = controller("controller=geometric").vehicle
    assert thrust_map("hover=0.4", vehicle).share(vehicle.mass * vehicle.gravity) == pytest.approx(0.4)
    for wrong in ("hover", "hover=2", "full=1", "curve=x", "half"):
        with pytest.raises(UsageError, match="--thrust"):
            thrust_map(wrong, vehicle)


def test_rates_give_the_torque_of_the_thrusts() -> None:
    vehicle, rng = controller("controller=geometric").vehicle, np.random.default_rng(2)
    x, gain = np.concatenate([rng.normal(size=10), rng.normal(size=3)]), rate_gain("inverse=20,30,8")
    thrusts = rng.uniform(vehicle.thrust_min, vehicle.thrust_max, 4)
    assert gain is not None
    J, w = vehicle.inertia_matrix, x[10:]
    wanted, rate, step = np.array(wanted_rates(vehicle, x, thrusts, gain, 0.01)).ravel(), w.copy(), 1e-6
    for _ in range(10_000):
        rate += step * gain * (wanted - rate)
    alpha = (rate - w) / 0.01  # in the mean
    assert np.allclose(J @ alpha + np.cross(w, J @ w), vehicle.allocation[1:] @ thrusts, rtol=1e-4, atol=1e-4)
    for wrong in ("inverse", "inverse=1,2", "inverse=1,2,-3", "measured"):
        with pytest.raises(UsageError, match="--rates"):
            rate_gain(wrong)
