"""quadexp check: what it prints, its exit codes, JSON, figures."""

import json
import shutil

import numpy as np
import pytest

from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, write_flight
from tests.cli.command import run

FLY = (
    "simulate", "controller=nominal_mpc", "trajectory=circle", "trajectory.speed=6", "sensor=lei_li",
    "controller.backend=interpreted", "plant.backend=interpreted",
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """good: a flight; turned: its quaternions conjugated; copy: the good one again; dropped: rows missing."""
    folder = tmp_path_factory.mktemp("runs")
    assert run(*FLY, "--out", folder / "good.parquet")[0] == 0
    good = read_flight(folder / "good.parquet")
    columns = good.columns | {f"q_{axis}": -good[f"q_{axis}"] for axis in "xyz"}
    write_flight(folder / "turned.parquet", Flight(columns, good.metadata))
    write_flight(folder / "copy.parquet", good)
    rows = np.random.default_rng(0).random(len(good)) > 0.05
    write_flight(folder / "dropped.parquet", Flight({name: x[rows] for name, x in good.columns.items()}, good.metadata))
    return folder


def test_a_clean_flight(folder):
    code, out, _ = run("check", folder / "good.parquet")
    assert code == 0 and out.strip().splitlines()[-1] == "1 flight: 1 clean, 0 with warnings, 0 blocked"


def test_a_fault_blocks_and_says_where(folder):
    code, out, error = run("check", folder / "good.parquet", folder / "turned.parquet")
    assert code == 1 and "1 of 2 flights have findings that block" in error
    assert "quaternion_conjugate" in out and "world to body" in out and "q_*" in out


def test_a_duplicate_is_said_of_the_second(folder):
    code, out, _ = run("check", folder / "good.parquet", folder / "copy.parquet", "--json")
    good, copy = json.loads(out)["flights"]
    assert code == 1 and not good["blocked"] and copy["blocked"]
    assert [one["name"] for one in copy["findings"] if one["blocks"]] == ["duplicate"]


def test_strict_lets_warnings_block(folder):
    assert run("check", folder / "dropped.parquet")[0] == 0
    code, out, _ = run("check", folder / "dropped.parquet", "--strict", "--json")
    record = json.loads(out)
    assert code == 1 and record["strict"] and record["blocked"] == 1
    (finding,) = [one for one in record["flights"][0]["findings"] if one["severity"] == "warning"]
    assert finding["name"] == "dropped_samples"
    assert {"where", "measured", "allowed", "message", "blocks", "severity"} <= set(finding)


def shorter(flight, rows):
    return Flight({name: values[:rows] for name, values in flight.columns.items()}, flight.metadata)


def test_figures_of_flights_of_one_name_too(folder, tmp_path):
    flight, drawn = read_flight(folder / "turned.parquet"), []
    for copy, one in (("x", shorter(flight, 300)), ("z/x", shorter(flight, 260))):
        (tmp_path / copy).mkdir(parents=True)
        drawn.append(tmp_path / copy / "a.parquet")
        write_flight(drawn[-1], one)
    code, out, _ = run("check", *drawn, "--figures", tmp_path / "figures")
    figures = sorted((tmp_path / "figures").rglob("*.svg"))
    assert code == 1 and all(str(figure) in out for figure in figures)
    assert len(figures) == len({figure.read_bytes() for figure in figures}) == 2


def test_a_log_is_a_duplicate_only_of_one_that_was_imported(folder, tmp_path):
    for name in ("good", "turned"):
        assert run("export", folder / f"{name}.parquet", "--to", "csv", "--out", tmp_path / f"{name}.csv")[0] == 0
    (tmp_path / "mapping.yaml").write_text(run("import", "--describe", tmp_path / "good.csv")[1])
    shutil.copy(tmp_path / "turned.csv", tmp_path / "again.csv")
    logs = (tmp_path / "turned.csv", tmp_path / "again.csv", "--mapping", tmp_path / "mapping.yaml")
    code, out, error = run("import", *logs, "--out", tmp_path / "out")
    assert code == 1 and out.count("NOT IMPORTED") == 2 and "same bytes" not in out + error
    code, out, error = run("import", *logs, "--out", tmp_path / "out", "--keep")
    assert code == 0 and "the same bytes as turned.csv" in out
