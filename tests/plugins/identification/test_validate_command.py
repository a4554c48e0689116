"""`quadexp validate` and the chain before it, from the command line, on flights whose model is known."""

import json

import pytest
from typer.testing import CliRunner

from quadexp.cli.app import app
from quadexp.log.store import read_flight, write_flight
from quadexp.models.checkpoint import load_model, save_model
from quadexp.models.linear_drag import fit_linear_drag
from quadexp.plugins.gaussian_process.gaussian_process import GPConfig, fit_gp
from quadexp.plugins.identification.recorded import recorded_dataset
from quadexp.plugins.identification.vehicle_model import FitSettings, fit_vehicle_model
from quadexp.plugins.neural.neural import NNConfig
from tests.models.recorded_flights import crazyflie, recorded_flight

VEHICLE = crazyflie()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded")
    flights = [recorded_flight(seed, VEHICLE, duration=8, scale=(1.0, 1.02, 0.97)[seed]) for seed in range(3)]
    for name, flight in zip("abc", flights, strict=True):
        write_flight(folder / f"{name}.parquet", flight)
    settings = FitSettings(powers=(1,), kinds=("linear",))
    save_model(folder / "vehicle", fit_vehicle_model(flights[:2], VEHICLE, settings, names=["a", "b"]))
    return folder


def run(*words: object):
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture(scope="module")
def report(folder):
    """Of the flight that was not fitted; figures in v."""
    words = ("--flights", folder / "c.parquet", "--out", folder / "v", "--horizons", "0.1,0.2", "--json")
    done = run("validate", folder / "vehicle", *words)
    assert done.exit_code == 0, done.stderr
    return json.loads(done.stdout)


def by_predictor(report):
    return {(row["predictor"], row["thrust_tracked"]): row for row in report["rows"]}


def test_the_drag_is_what_the_unseen_flight_has_beyond_its_thrust(folder, report):
    rows = by_predictor(report)
    assert rows["linear drag", False]["rms_x"] == pytest.approx(0.02, rel=0.15)  # the accelerometer's noise
    assert rows["linear drag", False]["rms_z"] == pytest.approx(0.04 * 10.2, rel=0.1)  # 0.97 of a curve fitted at 1.01
    assert rows["linear drag", True]["rms"] < 0.5 * rows["linear drag", False]["rms"]
    assert {path.name for path in (folder / "v").iterdir()} >= {"validation.json", "speed.svg", "rollouts.png"}


def test_shares_are_of_nominal_treated_alike(report):
    rows = by_predictor(report)
    static, tracked, linear = rows["nominal", False], rows["nominal", True], rows["linear drag", True]
    assert static["share_alike"] == tracked["share_alike"] == 1.0 and tracked["share"] < 1.0
    assert linear["share_alike"] == pytest.approx(linear["rms"] / tracked["rms"])
    assert linear["share"] == pytest.approx(linear["rms"] / static["rms"]) and linear["share"] < linear["share_alike"]
    assert report["nominal"].startswith("on motor_command: c_1")


def test_a_flight_that_was_fitted_is_no_test(folder):
    flights = [folder / "a.parquet", folder / "c.parquet"]
    done = run("validate", folder / "vehicle", "--flights", *flights, "--horizons", "0.1")
    assert done.exit_code == 0, done.stderr
    assert "warning: a is one of the flights that linear drag was fitted to" in done.stdout
    assert "nominal: the thrust curve on motor_command: c_1" in done.stdout


def test_leave_one_out_refits_every_kind_of_model(folder):
    """A Gaussian process, a drag fit and a network of the same flights, beside the identified vehicle."""
    paths = [folder / f"{name}.parquet" for name in "abc"]
    flights = [read_flight(path) for path in paths]
    rows = recorded_dataset(flights, VEHICLE, load_model(folder / "vehicle").thrust, names=["a", "b", "c"])
    small = NNConfig(hidden=(4,), max_iterations=20, features=("v_x", "v_y", "v_z"))
    save_model(folder / "nn", small.fit(rows))
    save_model(folder / "gp", fit_gp(rows, GPConfig(inducing=5, max_iterations=10, features={"a_x": ("v_x",)})))
    save_model(folder / "drag", fit_linear_drag(rows))
    models = [folder / name for name in ("vehicle", "nn", "gp", "drag")]
    done = run("validate", *models, "--flights", *paths, "--leave-one-out", "--json", "--horizons", "0.2")
    assert done.exit_code == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["leave_one_out"] and not report["notes"] and {r["horizon"] for r in report["rollouts"]} == {0.2}
    static = next(r for r in report["rows"] if r["predictor"] == "linear drag" and not r["thrust_tracked"])
    assert static["rms_z"] == pytest.approx(10.2 * ((0.005**2 + 0.035**2 + 0.04**2) / 3) ** 0.5, rel=0.15)
    errors = {row["predictor"]: row["rms"] for row in report["rows"] if row["thrust_tracked"]}
    assert {"nominal", "linear drag", "nn", "gp", "drag"} <= errors.keys() and errors["drag"] < errors["nominal"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["validate", "vehicle"], "no flight given"),
        (["validate", "nowhere", "--flights", "c.parquet"], "no model there"),
        (["validate", "vehicle", "--flights", "c.parquet", "--horizons", "x"], "--horizons: 'x'"),
        (["validate", "vehicle", "--flights", "c.parquet", "--leave-one-out"], "at least two flights"),
        (["validate", "vehicle", "vehicle=torrente", "--flights", "c.parquet"], "flown by vehicle crazyflie"),
        (["collect", "--flight", "a.parquet", "vehicle=crazyflie", "--out", "x.parquet"], "collect.identified"),
        (
            ["simulate", "vehicle=crazyflie", "plant=from_model", "plant.model=none", "--out", "s.parquet"],
            "plant.model=none",
        ),
    ],
)
def test_one_line_says_what_is_wrong(folder, monkeypatch, words, message):
    monkeypatch.chdir(folder)
    done = run(*words)
    assert done.exit_code in (1, 2)
    assert message in done.stderr and len(done.stderr.strip().splitlines()) == 1
