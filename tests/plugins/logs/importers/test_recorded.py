"""Real flights: units, frames and signs are right where the drag that plain least squares finds is the known one."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.plugins.logs.import_flights import import_files
from quadexp.plugins.logs.importers import Options, import_log
from tests.plugins.logs.importers import logs


def body_velocity(flight: Flight) -> np.ndarray:
    R = Rotation.from_quat(flight.stack(["q_w", "q_x", "q_y", "q_z"]), scalar_first=True)
    return R.apply(flight.stack(["v_x", "v_y", "v_z"]), inverse=True)


@pytest.mark.parametrize(
    ("name", "d_x", "d_y"),
    [("B2_circle_fast_rep2", 0.388, 0.418), ("B9_trefoil_fast_rep14", 0.414, 0.393),
     ("B3_figure8_fast_rep1", 0.405, 0.406)],
)  # fmt: skip
def test_nanobench_drag(name, d_x, d_y):
    """a_x = -d v_x + b on body axes, against the figures that come with the data, within 1 %."""
    flight, _ = import_log(logs.recorded("nanobench") / f"{name}.csv", None, Options())
    v = body_velocity(flight)
    assert -np.polyfit(v[:, 0], flight["acc_x"], 1)[0] == pytest.approx(d_x, rel=0.01)
    assert -np.polyfit(v[:, 1], flight["acc_y"], 1)[0] == pytest.approx(d_y, rel=0.01)
    assert flight["acc_z"].mean() == pytest.approx(9.9, abs=0.2)
    assert flight["p_z"].min() > 0.5


def test_nanobench_traps_are_named(tmp_path):
    """A duplicate, commands that cannot be, and a file without a flight: each named, none written."""
    files = sorted(logs.recorded("nanobench").glob("*.csv"))
    found = {one.log.stem: one for one in import_files(files, tmp_path, Options(), vehicle="crazyflie")}
    assert {path.stem for path in tmp_path.glob("*.parquet")} == {
        "B2_circle_fast_rep2", "B3_figure8_fast_rep1", "B9_trefoil_fast_rep14", "B9_trefoil_slow_rep12",
    }  # fmt: skip
    for name, fault in (("B9_trefoil_slow_rep7", "duplicate"), ("B2_circle_medium_rep3", "impossible_command"),
                        ("B7_oval_slow_rep1", "no_flight")):  # fmt: skip
        assert found[name].path is None
        assert fault in [finding.name for finding in found[name].findings if finding.severity == "blocking"]
    again = read_flight(tmp_path / "B3_figure8_fast_rep1.parquet")
    assert again.metadata["vehicle"]["name"] == "crazyflie" and again.metadata["recorded"]


def test_blackbird_nominal_and_linear_drag():
    """Residual of least squares over both parts: 0.727 m/s^2 with an offset alone, 0.323 with linear drag, +-3 %."""
    velocities, residuals = [], []
    for part in ("train", "test"):
        flight, _ = import_log(logs.recorded("blackbird_clover") / part / "data.hdf5", None, Options())
        residual = flight.stack(["acc_x", "acc_y", "acc_z"])
        residual[:, 2] -= flight["thrust_acceleration"]
        velocities.append(body_velocity(flight))
        residuals.append(residual)
    v, a = np.concatenate(velocities), np.concatenate(residuals)
    left = np.stack([a[:, i] - np.polyval(np.polyfit(v[:, i], a[:, i], 1), v[:, i]) for i in range(3)], axis=1)
    assert np.sqrt(((a - a.mean(axis=0)) ** 2).sum(axis=1).mean()) == pytest.approx(0.727, rel=0.03)
    assert np.sqrt((left**2).sum(axis=1).mean()) == pytest.approx(0.323, rel=0.03)
