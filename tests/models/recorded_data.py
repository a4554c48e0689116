"""The recorded flights beside the repository, read the shortest way; tests skip where they are not there."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight

FOLDER = Path(__file__).resolve().parents[2].parent / "shared" / "data"
G = 9.81


def nanobench(name: str) -> Flight:
    """A flight of NanoBench, cropped to the air (p_z > 0.5 m, 1.5 s off each side)."""
    file = FOLDER / "nanobench" / f"{name}.csv"
    if not file.is_file():
        pytest.skip("the flights of nanobench are not beside the repository (../shared/data/nanobench)")
    table = np.genfromtxt(file, delimiter=",", names=True)
    flying = np.flatnonzero(table["pz"] > 0.5)
    t = table["t"]
    table = table[(t >= t[flying[0]] + 1.5) & (t <= t[flying[-1]] - 1.5)]
    columns = {"t": table["t"] - table["t"][0], "battery_voltage": table["pwr_pm_vbat"]}
    columns |= {f"q_{axis}": table[f"q{axis}"] for axis in "wxyz"}
    for axis in "xyz":
        columns |= {f"p_{axis}": table[f"p{axis}"], f"v_{axis}": table[f"v{axis}"]}
        columns |= {f"w_{axis}": table[f"imu_gyro_{axis}"], f"acc_{axis}": G * table[f"imu_acc_{axis}"]}
    columns |= {f"motor_command_{i}": table[f"motor_motor_m{i + 1}"] / 65535 for i in range(4)}
    return _flight(columns, name)


def blackbird(part: str) -> Flight:
    """Part "train" or "test" of the Blackbird flight, from the sensors' FRD into FLU; velocity by differentiation."""
    file = FOLDER / "blackbird_clover" / part / "data.hdf5"
    if not file.is_file():
        pytest.skip("the flights of blackbird_clover are not beside the repository (../shared/data/blackbird_clover)")
    h5py = pytest.importorskip("h5py")
    with h5py.File(file) as data:
        ts, target = data["ts"][:], data["traj_target"][:]
        force, rate, thrust = (data[key][:] for key in ("accel_calib", "gyro_calib", "thrust"))
    turned = Rotation.from_quat(target[:, 3:7]) * Rotation.from_euler("x", np.pi)
    velocity = np.gradient(target[:, :3], ts, axis=0)
    columns = {"t": ts - ts[0], "thrust_acceleration": -thrust[:, 2]}
    columns |= {f"q_{axis}": turned.as_quat(scalar_first=True)[:, i] for i, axis in enumerate("wxyz")}
    for i, (axis, sign) in enumerate(zip("xyz", (1, -1, -1), strict=True)):
        columns |= {f"p_{axis}": target[:, i], f"v_{axis}": velocity[:, i]}
        columns |= {f"w_{axis}": sign * rate[:, i], f"acc_{axis}": sign * force[:, i]}
    return _flight(columns, part)


def _flight(columns: dict[str, np.ndarray], name: str) -> Flight:
    plain = {key: np.ascontiguousarray(values, float) for key, values in columns.items()}
    return Flight(plain, {"name": name, "recorded": True})
