"""quadexp identify: coefficients and their confidence from flights, by recursive least squares or by regression."""

import json

import numpy as np
import pytest
from typer.main import get_command

from quadexp.cli.app import app
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, read_table, write_flight
from quadexp.models.checkpoint import load_model
from quadexp.plugins.identification.commands import OPTIONS
from tests.cli.command import run
from tests.models.logged_flights import DRAG, logged_flight

FLY = (
    "simulate", "vehicle=lei_li", "plant=blade_element", "sensor=lei_li", "trajectory=rectangle",
    "trajectory.duration=16", "controller=rls_feedback", "controller.backend=interpreted", "plant.backend=interpreted",
)  # fmt: skip


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "a.parquet"
    assert run(*FLY, "--out", path)[0] == 0
    return path


def test_estimates_with_confidence_and_their_time_series(flight, tmp_path):
    code, out, _ = run("identify", flight, "--out", tmp_path / "estimates")
    assert code == 0
    assert out.strip().splitlines()[-1] == str(tmp_path / "estimates" / "a.parquet")
    columns, record = read_table(tmp_path / "estimates" / "a.parquet", "estimates", finite=True)
    assert len(columns["t"]) == 1600
    truth = {"C_d0": 0.22, "C_la": 3.32, "C_Dx": 0.01, "C_Dy": 0.01, "C_Dz": 0.02}
    for name, (low, high) in record["interval_95"].items():  # coverage: tests/plugins/papers/test_blade_fit.py
        assert abs(record["estimates"][name] - truth[name]) < high - low
        assert f"{name:<5} {record['estimates'][name]:9.5f}   95 % interval {low:.5f} to {high:.5f}" in out
    assert record["recursion"]["C_la"] == pytest.approx(3.32, abs=0.015)
    assert columns["std_C_la"][-1] < 0.2 * columns["std_C_la"][10]


def test_a_flight_without_record_needs_its_vehicle(flight, tmp_path):
    bare = read_flight(flight)
    bare.metadata.pop("config")
    write_flight(tmp_path / "bare.parquet", bare)
    code, _, error = run("identify", tmp_path / "bare.parquet", "--out", tmp_path / "e")
    assert code == 1 and "has no record of its vehicle: pass --vehicle NAME" in error
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


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flights")
    return [write_flight(folder / f"log_{seed}.parquet", logged_flight(seed, seconds=10)) for seed in range(2)]


def test_says_which_method_and_why(flight, logged, tmp_path):
    code, _, error = run("identify", flight, "--out", tmp_path / "e")
    assert code == 0 and "rls: rotor speeds and the rotors' geometry are known" in error
    code, _, error = run("identify", *logged, "--out", tmp_path / "m", "--no-figures")
    assert code == 0 and f"regression: {logged[0]} has no rotor speeds" in error
    code, out, error = run("identify", flight, "--method", "regression", "--out", tmp_path / "r", "--no-figures")
    assert code == 0 and "regression: as asked" in error and "on rotor_speed: c_2" in out
    assert load_model(tmp_path / "r").blade_element.terms[2] == ("thrust", "inflow", "advance", "body")


def test_logs_give_a_vehicle_model_with_intervals_and_figures(logged, tmp_path):
    out = tmp_path / "model"
    short, long = (
        run("identify", *logged, "--out", out, *more)[1].splitlines() for more in ([], ["--verbose", "--force"])
    )
    assert [line.split()[0] for line in short[:4]] == ["regression", "thrust", "drag", "best"]
    assert short[-1] == long[-1] == str(out) and len(long) > len(short)
    assert load_model(out).linear_drag.drag == pytest.approx(DRAG, abs=0.04)
    for name in ("thrust", "drag"):
        assert (out / "figures" / f"{name}.png").stat().st_size > 10_000
    shown = run("show", out)[1]
    assert any(line in shown for line in long if line.startswith("+ linear drag"))


def test_regression_as_json_and_its_options(logged, tmp_path):
    code, out, _ = run("identify", *logged, "--out", tmp_path / "m", "--no-figures", "--json", "--thrust-curve", "s+s2")
    found = json.loads(out)
    assert code == 0 and found["method"] == "regression" and set(found["models"]) >= {"linear", "quadratic"}
    assert "c_1" in found["thrust"] and "c_2" in found["thrust"]
    d_x = next(row for row in found["models"]["linear"] if (row["axis"], row["term"]) == ("x", "linear"))
    assert d_x["low"] < d_x["value"] < d_x["high"] and d_x["unit"] == "1/s"
    code, _, error = run("identify", *logged, "--out", tmp_path / "m", "--no-figures")
    assert code == 2 and "exists already; pass --force" in error


@pytest.mark.parametrize("method", OPTIONS)
def test_options_of_other_methods_are_refused(logged, tmp_path, method):
    """Of those that a method does not have, each alone; that no option is missing in the table shows the help."""
    words = {"--out": tmp_path / "e", "--rotor-radius": 0.1, "--thrust-curve": "s"}
    switches = ("force", "figures")
    flags = {one.name: one.opts[0] for one in get_command(app).commands["identify"].params}
    for name in {name for names in OPTIONS.values() for name in names} - set(OPTIONS[method]):
        value = [] if name in switches else [words.get(flags[name], "nonsense")]
        code, _, error = run("identify", logged[0], "--method", method, flags[name], *value)
        assert code == 2 and error.count("\n") == 1 and f"{flags[name]}: is for --method" in error
    given = set(flags) - {name for names in OPTIONS.values() for name in names}
    assert given == {"flights", "method", "vehicle", "conf", "verbose", "form", "json"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--method", "magic"], "'magic' is not one of 'rls', 'regression', 'delays'"),
        (["--thrust-curve", "s3"], "'s3' is not one of 'auto', 's', 's2', 's+s2'"),
        (["--method", "rls", "--rotor-radius", "0.1"], "is for --method regression"),
    ],
)
def test_a_wrong_option_is_one_line_and_writes_nothing(logged, tmp_path, options, message):
    code, _, error = run("identify", *logged, "--out", tmp_path / "m", "--no-figures", *options)
    assert code == 2 and message in error and not (tmp_path / "m").exists()


def test_a_flight_lacking_a_column_is_refused(tmp_path):
    whole = logged_flight(5, seconds=5)
    bare = Flight({k: v for k, v in whole.columns.items() if k != "acc_y"}, whole.metadata)
    path = write_flight(tmp_path / "bare.parquet", bare)
    code, _, error = run("identify", path, "--out", tmp_path / "m")
    assert code == 1 and "bare: column 'acc_y' is missing" in error
