"""Faults as a logger or an importer makes them, each put into a clean flight, and clean flights to put them into."""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight

NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])
FRD = np.diag([1, -1, -1.0])
P, V, W, ACC = ([f"{name}_{axis}" for axis in "xyz"] for name in ("p", "v", "w", "acc"))
Q = ["q_w", "q_x", "q_y", "q_z"]


def take(c: dict, names: list[str]) -> np.ndarray:
    return np.stack([c[name] for name in names], axis=-1)


def put(c: dict, names: list[str], values: np.ndarray) -> None:
    c.update(zip(names, values.T.copy(), strict=True))


def rotation(c: dict) -> Rotation:
    return Rotation.from_quat(take(c, ["q_x", "q_y", "q_z", "q_w"]))


Change = Callable[[dict], dict | None]


def changed(change: Change, flight: Flight) -> Flight:
    """The flight after a change of its columns, in place or as what the change returns."""
    columns = {key: values.copy() for key, values in flight.columns.items()}
    return Flight(change(columns) or columns, dict(flight.metadata))


def inject(flight: Flight, name: str) -> Flight:
    return changed(FAULTS[name][1], flight)


def times(names: list[str], factor) -> Change:
    return lambda c: put(c, names, take(c, names) * factor)


def turned(matrix: np.ndarray, *groups: list[str]) -> Change:
    def change(c: dict) -> None:
        for names in groups:
            put(c, names, take(c, names) @ matrix.T)

    return change


def rows(chosen: Callable[[int, np.ndarray], np.ndarray]) -> Change:
    """chosen: the rows that are left, by their number and times."""
    return lambda c: {key: values[chosen(len(c["t"]), c["t"])] for key, values in c.items()}


def renamed(names: list[str], others: list[str]) -> Change:
    return lambda c: put(c, names, take(c, others))


def at(names: list[str], when: slice, value=None) -> Change:
    """Some samples of columns: a value, or what stands in the first of them."""

    def change(c: dict) -> None:
        for name in names:
            c[name][when] = c[name][when.start] if value is None else value

    return change


def ned_everything(c):
    turned(NED, P, V)(c)
    both = Rotation.from_matrix(NED) * rotation(c) * Rotation.from_matrix(FRD)
    put(c, Q, np.roll(both.as_quat(), 1, axis=1))
    turned(FRD, W, ACC)(c)


def moved(seconds: float) -> Change:
    return lambda c: {**c, "t": c["t"] + seconds * (np.arange(len(c["t"])) >= len(c["t"]) // 2)}


def imu_50_ms_late(c):
    c |= {name: np.interp(c["t"] - 0.05, c["t"], c[name]) for name in (*W, *ACC)}


def command_spikes(c):
    name = "motor_command_1" if "motor_command_1" in c else "u_1"
    rng = np.random.default_rng(0)
    c[name][rng.integers(0, len(c["t"]), 15)] = rng.choice([-5.0, 40.0], 15)


def spikes(name: str, count: int, size: float) -> Change:
    def change(c: dict) -> None:
        c[name][np.random.default_rng(0).integers(0, len(c["t"]), count)] += size

    return change


def without_a_stretch(n: int, t: np.ndarray) -> np.ndarray:
    lost = int(0.4 / np.median(np.diff(t)))
    return np.delete(np.arange(n), slice(n // 2, n // 2 + lost))


def dropped(n: int, _: np.ndarray) -> np.ndarray:
    kept = np.random.default_rng(0).random(n) > 0.05
    kept[[0, -1]] = True
    return np.flatnonzero(kept)


# Name -> the finding by which it must be reported, and what it does to the columns.
FAULTS: dict[str, tuple[str, Change]] = {
    "acceleration_in_g": ("units", times(ACC, 1 / 9.81)),
    "rates_in_degrees": ("units", times(W, 180 / np.pi)),
    "position_in_centimetres": ("units", times(P, 100)),
    "clock_in_milliseconds": ("units", times(["t"], 1000)),
    "scalar_last": ("quaternion_order", renamed(Q, ["q_x", "q_y", "q_z", "q_w"])),
    "conjugated": ("quaternion_conjugate", times(Q, [1, -1, -1, -1])),
    "ned_position_and_velocity": ("ned_not_converted", turned(NED, P, V)),
    "ned_everything": ("ned_not_converted", ned_everything),
    "frd_imu": ("frd_not_converted", turned(FRD, W, ACC)),
    "body_velocity_labelled_world": ("frame_velocity", lambda c: put(c, V, rotation(c).inv().apply(take(c, V)))),
    "gravity_removed": (
        "gravity_removed", lambda c: put(c, ACC, take(c, ACC) - rotation(c).inv().apply([0, 0, 9.81]))),
    "gyro_axis_flipped": ("sign_flip", times(["w_y"], -1)),
    "accelerometer_axis_flipped": ("sign_flip", times(["acc_x"], -1)),
    "velocity_axis_flipped": ("sign_flip", times(["v_y"], -1)),
    "gyro_axes_swapped": ("axis_swap", renamed(["w_x", "w_y"], ["w_y", "w_x"])),
    "time_jump": ("clock_jump", moved(1.0)),
    "time_back": ("clock_jump", moved(-0.5)),
    "stretch_missing": ("gap", rows(without_a_stretch)),
    "dropped_samples": ("dropped_samples", rows(dropped)),
    "duplicated_rows": ("duplicated_rows", rows(lambda n, _: np.sort(np.r_[np.arange(n), np.arange(100, 130)]))),
    "block_written_twice": ("duplicated_rows", rows(lambda n, _: np.r_[np.arange(130), np.arange(100, n)])),
    "scaled_clock": ("clock_scale", times(["t"], 1.05)),
    "clock_at_half_speed": ("clock_scale", times(["t"], 0.5)),
    "imu_50_ms_late": ("time_offset", imu_50_ms_late),
    "command_spikes": ("impossible_command", command_spikes),
    "nan_burst": ("not_finite", at(W, slice(100, 150), np.nan)),
    "frozen_gyro": ("frozen_sensor", at(W, slice(100, 200))),
    "frozen_position": ("frozen_sensor", at(P, slice(100, 200))),
    "acceleration_spikes": ("acceleration_outlier", spikes("acc_y", 10, 400)),
    "position_spikes": ("position_outlier", spikes("p_y", 5, 3)),
    "quaternion_not_of_norm_one": ("quaternion_norm", times(Q, 1.05)),
}  # fmt: skip
