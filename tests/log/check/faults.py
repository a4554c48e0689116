"""Faults as a logger or an importer makes them, each put into a clean flight, and clean flights to put them into."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight

NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
FRD = np.diag([1, -1, -1.0])
P, V, W, ACC = ([f"{name}_{axis}" for axis in "xyz"] for name in ("p", "v", "w", "acc"))
Q = ["q_w", "q_x", "q_y", "q_z"]
NANOBENCH = Path(__file__).parents[3].parent / "shared" / "data" / "nanobench"


def nanobench(name: str, crop: bool = True) -> Flight:
    """A flight of the NanoBench folder, read by its documentation alone."""
    log = np.genfromtxt(NANOBENCH / f"{name}.csv", delimiter=",", names=True)
    columns = {"t": log["t"] - log["t"][0]}
    for axis in "xyz":
        columns[f"p_{axis}"], columns[f"v_{axis}"] = log[f"p{axis}"], log[f"v{axis}"]
        columns[f"w_{axis}"], columns[f"acc_{axis}"] = log[f"imu_gyro_{axis}"], 9.81 * log[f"imu_acc_{axis}"]
    columns |= {f"q_{i}": log[f"q{i}"] for i in "wxyz"}
    columns |= {f"motor_command_{i}": log[f"motor_motor_m{4 - i}"] / 65535 for i in range(4)}
    rows = np.ones(len(log), bool)
    if crop:
        up = np.flatnonzero(columns["p_z"] > 0.5)
        rows[:] = (columns["t"] > columns["t"][up[0]] + 1.5) & (columns["t"] < columns["t"][up[-1]] - 1.5)
    return Flight({key: values[rows] for key, values in columns.items()}, {"recorded": True, "name": name})


def take(c: dict, names: list[str]) -> np.ndarray:
    return np.stack([c[name] for name in names], axis=-1)


def put(c: dict, names: list[str], values: np.ndarray) -> None:
    c.update(zip(names, values.T.copy(), strict=True))


def rotation(c: dict) -> Rotation:
    return Rotation.from_quat(take(c, ["q_x", "q_y", "q_z", "q_w"]))


FAULTS: dict[str, tuple[str, Callable[[dict], dict | None]]] = {}


def fault(finding: str) -> Callable:
    """Register a fault under its function's name; `finding`: the name it must be reported by."""

    def register(function: Callable[[dict], dict | None]) -> Callable:
        FAULTS[function.__name__] = (finding, function)
        return function

    return register


def inject(flight: Flight, name: str) -> Flight:
    columns = {key: values.copy() for key, values in flight.columns.items()}
    return Flight(FAULTS[name][1](columns) or columns, dict(flight.metadata))


def rows_of(c: dict, rows: np.ndarray) -> dict:
    return {key: values[rows] for key, values in c.items()}


@fault("units")
def acceleration_in_g(c):
    put(c, ACC, take(c, ACC) / 9.81)


@fault("units")
def rates_in_degrees(c):
    put(c, W, np.degrees(take(c, W)))


@fault("units")
def position_in_centimetres(c):
    put(c, P, 100 * take(c, P))


@fault("units")
def clock_in_milliseconds(c):
    c["t"] *= 1000


@fault("quaternion_order")
def scalar_last(c):
    put(c, Q, take(c, ["q_x", "q_y", "q_z", "q_w"]))


@fault("quaternion_conjugate")
def conjugated(c):
    put(c, Q, take(c, Q) * [1, -1, -1, -1])


@fault("ned_not_converted")
def ned_position_and_velocity(c):
    put(c, P, take(c, P) @ NED.T)
    put(c, V, take(c, V) @ NED.T)


@fault("ned_not_converted")
def ned_everything(c):
    ned_position_and_velocity(c)
    turned = Rotation.from_matrix(NED) * rotation(c) * Rotation.from_matrix(FRD)
    put(c, Q, np.roll(turned.as_quat(), 1, axis=1))
    put(c, W, take(c, W) @ FRD)
    put(c, ACC, take(c, ACC) @ FRD)


@fault("frd_not_converted")
def frd_imu(c):
    put(c, W, take(c, W) @ FRD)
    put(c, ACC, take(c, ACC) @ FRD)


@fault("frame_velocity")
def body_velocity_labelled_world(c):
    put(c, V, rotation(c).inv().apply(take(c, V)))


@fault("gravity_removed")
def gravity_removed(c):
    put(c, ACC, take(c, ACC) - rotation(c).inv().apply([0, 0, 9.81]))


@fault("sign_flip")
def gyro_axis_flipped(c):
    c["w_y"] = -c["w_y"]


@fault("sign_flip")
def accelerometer_axis_flipped(c):
    c["acc_x"] = -c["acc_x"]


@fault("sign_flip")
def velocity_axis_flipped(c):
    c["v_y"] = -c["v_y"]


@fault("axis_swap")
def gyro_axes_swapped(c):
    c["w_x"], c["w_y"] = c["w_y"], c["w_x"]


@fault("axis_swap")
def velocity_axes_swapped(c):
    c["v_x"], c["v_y"] = c["v_y"], c["v_x"]


@fault("clock_jump")
def time_jump(c):
    c["t"][len(c["t"]) // 2 :] += 1.0


@fault("clock_jump")
def time_back(c):
    c["t"][len(c["t"]) // 2 :] -= 0.5


@fault("gap")
def stretch_missing(c):
    rows = np.ones(len(c["t"]), bool)
    rows[len(rows) // 2 :][: int(0.4 / np.median(np.diff(c["t"])))] = False
    return rows_of(c, rows)


@fault("dropped_samples")
def dropped_samples(c):
    rows = np.random.default_rng(0).random(len(c["t"])) > 0.05
    rows[[0, -1]] = True
    return rows_of(c, rows)


@fault("duplicated_rows")
def duplicated_rows(c):
    return rows_of(c, np.sort(np.concatenate([np.arange(len(c["t"])), np.arange(100, 130)])))


@fault("duplicated_rows")
def block_written_twice(c):
    return rows_of(c, np.concatenate([np.arange(130), np.arange(100, len(c["t"]))]))


@fault("clock_scale")
def scaled_clock(c):
    c["t"] *= 1.05


@fault("clock_scale")
def clock_at_half_speed(c):
    c["t"] *= 0.5


def _delay(c: dict, seconds: float) -> None:
    for name in (*W, *ACC):
        c[name] = np.interp(c["t"] - seconds, c["t"], c[name])


@fault("time_offset")
def imu_50_ms_late(c):
    _delay(c, 0.05)


@fault("impossible_command")
def command_spikes(c):
    name = "motor_command_1" if "motor_command_1" in c else "u_1"
    rng = np.random.default_rng(0)
    c[name][rng.integers(0, len(c["t"]), 15)] = rng.choice([-5.0, 40.0], 15)


@fault("not_finite")
def nan_burst(c):
    for name in W:
        c[name][100:150] = np.nan


@fault("frozen_sensor")
def frozen_gyro(c):
    for name in W:
        c[name][100:200] = c[name][100]


@fault("frozen_sensor")
def frozen_position(c):
    for name in P:
        c[name][100:200] = c[name][100]


@fault("acceleration_outlier")
def acceleration_spikes(c):
    c["acc_y"][np.random.default_rng(0).integers(0, len(c["t"]), 10)] = 400


@fault("position_outlier")
def position_spikes(c):
    c["p_y"][np.random.default_rng(0).integers(0, len(c["t"]), 5)] += 3


@fault("quaternion_norm")
def quaternion_not_of_norm_one(c):
    put(c, Q, 1.05 * take(c, Q))
