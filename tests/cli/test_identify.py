"""quadexp identify: coefficients and their confidence from a recorded flight."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from quadexp.cli import app
from quadexp.flight.store import read_flight, read_table, write_flight

FLY = (
    "simulate", "vehicle=lei_li", "plant=blade_element", "sensor=lei_li", "trajectory=rectangle",
    "trajectory.duration=16", "controller=rls_feedback", "controller.backend=interpreted", "plant.backend=interpreted",
)  # fmt: skip


def run(*arguments):
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return done.exit_code, done.stdout, done.stderr


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "a.parquet"
    assert run(*FLY, "--out", path)[0] == 0
    return path


def test_help_has_an_example():
    code, out, _ = run("identify", "--help")
    assert code == 0 and "quadexp identify runs/a.parquet" in out and "--json" in out


def test_estimates_with_confidence_and_their_time_series(flight, tmp_path):
    code, out, _ = run("identify", flight, "--out", tmp_path / "estimates")
    assert code == 0
    assert out.strip().splitlines()[-1] == str(tmp_path / "estimates" / "a.parquet")
    columns, record = read_table(tmp_path / "estimates" / "a.parquet", "estimates", finite=True)
    assert len(columns["t"]) == 1600
    assert record["estimates"]["C_d0"] == pytest.approx(0.22, abs=5 * record["standard_errors"]["C_d0"])
    # V_I is solved with the current estimate, which biases C_la while the vehicle climbs
    assert record["estimates"]["C_la"] == pytest.approx(3.32, abs=0.015)
    assert columns["std_C_la"][-1] < 0.2 * columns["std_C_la"][10]


def test_json(flight, tmp_path):
    code, out, _ = run("identify", flight, "--out", tmp_path / "e", "--json")
    found = json.loads(out)["flights"][0]
    assert code == 0 and set(found["estimates"]) == {"C_d0", "C_la", "C_Dx", "C_Dy", "C_Dz"}


def test_a_flight_without_record_needs_its_vehicle(flight, tmp_path):
    bare = read_flight(flight)
    bare.metadata.pop("config")
    write_flight(tmp_path / "bare.parquet", bare)
    code, _, error = run("identify", tmp_path / "bare.parquet", "--out", tmp_path / "e")
    assert code == 1 and "does not say which vehicle flew: pass --vehicle NAME" in error
    assert run("identify", tmp_path / "bare.parquet", "--out", tmp_path / "e", "--vehicle", "lei_li")[0] == 0


def test_mistakes_are_one_line(flight, tmp_path):
    code, _, error = run("identify", tmp_path / "nothing.parquet", "--out", tmp_path / "e")
    assert code == 2 and "no such file" in error and error.count("\n") == 1
    silent = read_flight(flight)
    silent.columns.pop("rotor_speed_2")
    write_flight(tmp_path / "silent.parquet", silent)
    code, _, error = run("identify", tmp_path / "silent.parquet", "--out", tmp_path / "e")
    assert code == 1 and "column 'rotor_speed_2' is missing" in error
    assert not (tmp_path / "e").exists()
    twice = tmp_path / "again" / "a.parquet"
    write_flight(twice, read_flight(flight))
    code, _, error = run("identify", flight, twice, "--out", tmp_path / "e")
    assert code == 2 and "two flights named a" in error
    assert np.isfinite(read_flight(flight)["C_la"]).all()
