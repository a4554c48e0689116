"""Flights in other formats, each read back and held against the flight."""

from __future__ import annotations

import csv
import json
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.errors import UsageError
from quadexp.log.exporters import FORMATS, export_flight
from quadexp.log.schema import Flight
from quadexp.log.store import write_flight
from quadexp.reference.from_file import FileTrajectory
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
        turn = Rotation.from_euler(
            "ZYX", np.column_stack([2.9 + 0.02 * np.arange(40), 0.3 * np.ones(40), np.zeros(40)])
        )
        for name, values in zip("wxyz", turn.as_quat(scalar_first=True).T, strict=True):
            columns[f"{prefix}q_{name}"] = values
    columns["sweeps"] = np.arange(40, dtype=np.int16)
    columns["C_la"] = np.where(np.arange(40) < 2, np.nan, 3.3 + 0.01 * np.arange(40))
    return Flight(columns, made.metadata)


@pytest.fixture
def path(flight, tmp_path):
    return write_flight(tmp_path / "a.parquet", flight)


def read_csv(path):
    with open(path, newline="") as file:
        rows = list(csv.reader(file))
    return {
        name: np.array([float(v or "nan") for v in values])
        for name, values in zip(rows[0], zip(*rows[1:], strict=True), strict=True)
    }


def test_csv_loses_nothing(flight, path, tmp_path):
    files = export_flight(path, "csv", tmp_path / "out" / "a.csv")
    columns = read_csv(files["csv"])
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


class TestPX4:
    @pytest.fixture
    def topics(self, path, tmp_path):
        files = export_flight(path, "px4csv", tmp_path / "log")
        assert files["vehicle_attitude"].name == "log_vehicle_attitude_0.csv"
        return {name: read_csv(file) for name, file in files.items() if file.suffix == ".csv"}

    def test_topics_and_time(self, flight, topics):
        assert set(topics) == {
            "vehicle_local_position", "vehicle_local_position_setpoint", "vehicle_attitude",
            "vehicle_angular_velocity", "actuator_outputs", "sensor_combined",
        }  # fmt: skip
        for topic in topics.values():
            np.testing.assert_allclose(topic["timestamp"], 1e6 * flight.t, atol=0.5)

    def test_position_is_north_east_down(self, flight, topics):
        for name, prefix in (("vehicle_local_position", ""), ("vehicle_local_position_setpoint", "ref_")):
            topic = topics[name]
            np.testing.assert_array_equal(topic["x"], flight[f"{prefix}p_y"])
            np.testing.assert_array_equal(topic["y"], flight[f"{prefix}p_x"])
            np.testing.assert_array_equal(topic["z"], -flight[f"{prefix}p_z"])
            np.testing.assert_array_equal(topic["vz"], -flight[f"{prefix}v_z"])

    def test_attitude_turns_body_down_into_world_down(self, flight, topics):
        q = np.column_stack([topics["vehicle_attitude"][f"q[{i}]"] for i in range(4)])
        assert q[0, 0] >= 0 and np.all(np.sum(q[1:] * q[:-1], axis=1) > 0)
        enu = Rotation.from_quat(flight.stack(["q_w", "q_x", "q_y", "q_z"]), scalar_first=True)
        ned = Rotation.from_quat(q, scalar_first=True)
        for frd, flu in (([1, 0, 0], [1, 0, 0]), ([0, 1, 0], [0, -1, 0]), ([0, 0, 1], [0, 0, -1])):
            east, north, up = enu.apply(flu).T
            np.testing.assert_allclose(ned.apply(frd), np.column_stack([north, east, -up]), atol=1e-12)

    def test_heading_is_from_north(self, topics):
        # yaw 2.9 rad from east (ENU, counter-clockwise) is pi/2 - 2.9 from north (clockwise)
        assert topics["vehicle_local_position"]["heading"][0] == pytest.approx(np.pi / 2 - 2.9, abs=1e-12)

    def test_rates_force_and_thrust(self, flight, topics):
        for i, sign in enumerate((1, -1, -1)):
            axis = "xyz"[i]
            np.testing.assert_array_equal(topics["vehicle_angular_velocity"][f"xyz[{i}]"], sign * flight[f"w_{axis}"])
            sensor = topics["sensor_combined"]
            np.testing.assert_array_equal(sensor[f"gyro_rad[{i}]"], sign * flight[f"w_{axis}"])
            np.testing.assert_array_equal(sensor[f"accelerometer_m_s2[{i}]"], sign * flight[f"acc_{axis}"])
        np.testing.assert_array_equal(topics["sensor_combined"]["gyro_integral_dt"][1:], 20000)
        for i in range(4):
            np.testing.assert_array_equal(topics["actuator_outputs"][f"output[{i}]"], flight[f"u_{i}"])


def test_mcap_loses_nothing(flight, path, tmp_path):
    reader = pytest.importorskip("mcap.reader")
    made = export_flight(path, "mcap", tmp_path / "a.mcap")["mcap"]
    messages: dict[str, list] = {}
    with open(made, "rb") as file:
        opened = reader.make_reader(file)
        for schema, channel, message in opened.iter_messages():
            assert schema.encoding == "jsonschema" and channel.message_encoding == "json"
            messages.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
        record = {m.name: m.metadata for m in opened.iter_metadata()}["quadexp"]
    assert json.loads(record["record"])["seed"] == 7
    assert {topic: len(found) for topic, found in messages.items()} == {
        "/flight": 40, "/pose": 40, "/reference/pose": 40, "/tf": 40, "/path": 1, "/reference/path": 1,
    }  # fmt: skip
    for name, values in flight.columns.items():
        read = [row[name] for _, row in messages["/flight"]]
        np.testing.assert_array_equal(np.array([np.nan if v is None else v for v in read]), values)
    for k, (time, row) in enumerate(messages["/pose"]):
        assert time == round(1e9 * flight.t[k]) and row["frame_id"] == "world"
        assert row["pose"]["position"] == {axis: flight[f"p_{axis}"][k] for axis in "xyz"}
        assert row["pose"]["orientation"] == {axis: flight[f"q_{axis}"][k] for axis in "wxyz"}
    assert messages["/tf"][3][1]["translation"] == messages["/pose"][3][1]["pose"]["position"]


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


@pytest.mark.parametrize(("form", "package"), [("mcap", "mcap"), ("rerun", "rerun")])
def test_a_missing_extra_is_one_clear_line(form, package, path, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UsageError, match=r"needs the package .*pip install 'quadexp\[viz\]'"):
        export_flight(path, form, tmp_path / "out")
    assert list(tmp_path.iterdir()) == [path]


def test_refusals(path, tmp_path):
    with pytest.raises(UsageError, match="--to bag: no such format; there are csv, tum"):
        export_flight(path, "bag")
    (tmp_path / "a.csv").write_text("precious")
    with pytest.raises(UsageError, match="--force"):
        export_flight(path, "csv")
    empty = write_flight(tmp_path / "empty.parquet", straight_flight(0, outcome="infeasible"))
    with pytest.raises(UsageError, match=r"holds no samples \(infeasible\)"):
        export_flight(empty, "csv")


def test_beside_the_flight_unless_told(path):
    assert {name: set(export_flight(path, name)) for name in ("csv", "tum")} == {
        "csv": {"csv", "about"},
        "tum": {"tum", "reference"},
    }
    assert (path.parent / "a.tum").exists() and set(FORMATS) == {"csv", "tum", "px4csv", "mcap", "rerun"}
