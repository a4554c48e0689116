"""Flights in other formats, each read back and held against the flight."""

import json
import sys

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from quadexp.errors import UsageError
from quadexp.log.schema import Flight
from quadexp.log.store import write_flight
from quadexp.plugins.exchange.flights import FORMATS, export_flight
from quadexp.plugins.logs.from_file import FileTrajectory
from tests.log.flights import straight_flight


@pytest.fixture
def flight(rng) -> Flight:
    """A flight in which no two numbers are alike, with integers, a NaN and an extra column."""
    made = straight_flight(40, outcome="ok", seed=7)
    columns = dict(made.columns)
    for name, values in columns.items():
        if values.dtype.kind == "f" and name != "t":
            columns[name] = values + rng.normal(size=len(values))
    for prefix in ("", "ref_"):
        angles = np.column_stack([2.9 + 0.02 * np.arange(40), 0.3 * np.ones(40), np.zeros(40)])
        q = Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)
        columns |= {f"{prefix}q_{name}": q[:, i] for i, name in enumerate("wxyz")}
    columns["sweeps"] = np.arange(40, dtype=np.int16)
    columns["C_la"] = np.where(np.arange(40) < 2, np.nan, 3.3 + 0.01 * np.arange(40))
    return Flight(columns, made.metadata)


@pytest.fixture
def path(flight, tmp_path):
    return write_flight(tmp_path / "a.parquet", flight)


def test_csv_loses_nothing(flight, path, tmp_path):
    files = export_flight(path, "csv", tmp_path / "out" / "a.csv")
    columns = pd.read_csv(files["csv"], float_precision="round_trip")
    assert list(columns) == list(flight.columns)
    for name, values in flight.columns.items():
        np.testing.assert_array_equal(columns[name], values)
    about = json.loads(files["about"].read_text())
    assert about["columns"]["v_x"] == {"unit": "m/s", "frame": "world", "description": "velocity"}
    assert about["record"]["seed"] == 7


def test_tum_is_read_by_what_reads_tum(flight, path, tmp_path):
    files = export_flight(path, "tum", tmp_path / "a.tum")
    names = ["t", "p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w"]
    np.testing.assert_array_equal(np.loadtxt(files["tum"]), flight.stack(names))
    wanted = flight.stack(["t", *(f"ref_{name}" for name in names[1:])])
    np.testing.assert_array_equal(np.loadtxt(files["reference"]), wanted)
    again = FileTrajectory(path=str(files["tum"]))
    np.testing.assert_allclose(again.flat_output(flight.t).position[:, 0], flight.stack(names[1:4]), atol=1e-9)


def test_rerun_loses_nothing(flight, path, tmp_path):
    rerun = pytest.importorskip("rerun")
    if not hasattr(rerun, "chunk"):
        pytest.skip("this rerun-sdk cannot read recordings")
    made = export_flight(path, "rerun", tmp_path / "a.rrd")["rerun"]
    read: dict[str, dict[str, list]] = {}
    for chunk in rerun.chunk.RrdReader(str(made)).stream():
        batch = chunk.to_record_batch()
        columns = read.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            columns.setdefault(name, []).extend(batch.column(name).to_pylist())
    for name, values in flight.columns.items():
        entity = read[f"/columns/{name}"]
        np.testing.assert_array_equal([value for (value,) in entity["Scalars:scalars"]], values.astype(float))
        seconds = [t.total_seconds() for t in entity["t"]]
        np.testing.assert_allclose(seconds, flight.t, atol=1e-6)  # timedelta holds microseconds
    drone = read["/world/drone"]
    position = np.array([value[0] for value in drone["Transform3D:translation"]])
    np.testing.assert_allclose(position, flight.stack(["p_x", "p_y", "p_z"]), rtol=1e-6, atol=1e-6)  # float32
    quaternion = np.array([value[0] for value in drone["Transform3D:quaternion"]])
    np.testing.assert_allclose(quaternion, flight.stack(["q_x", "q_y", "q_z", "q_w"]), atol=1e-6)


def test_a_missing_extra_is_one_clear_line(path, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UsageError, match=r"needs the package .*pip install 'quadexp\[viz\]'"):
        export_flight(path, "rerun", tmp_path / "out")
    assert list(tmp_path.iterdir()) == [path]


def test_refusals(path, tmp_path):
    for form, said in (
        ("bag", "no such format; there are csv, tum"),
        ("mcap", "no such format; there are csv, tum, rerun"),
    ):
        with pytest.raises(UsageError, match=f"--to {form}: {said}"):
            export_flight(path, form)
    (tmp_path / "a.csv").write_text("precious")
    with pytest.raises(UsageError, match="--force"):
        export_flight(path, "csv")
    empty = write_flight(tmp_path / "empty.parquet", straight_flight(0, outcome="infeasible"))
    with pytest.raises(UsageError, match=r"holds no samples \(infeasible\)"):
        export_flight(empty, "csv")


def test_beside_the_flight_unless_told(path):
    assert set(export_flight(path, "csv")) == {"csv", "about"} and set(export_flight(path, "tum")) == {
        "tum",
        "reference",
    }
    assert (path.parent / "a.tum").exists() and set(FORMATS) == {"csv", "tum", "rerun"}
