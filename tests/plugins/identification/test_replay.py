"""The replay test on simulated flights: it predicts what the true plant does, and says what it cannot tell."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from quadexp import requests
from quadexp.cli.app import app
from quadexp.errors import DataError, UsageError
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, write_flight
from quadexp.models.checkpoint import load_model
from quadexp.plugins.identification import replay
from quadexp.plugins.identification import requests as of_logs
from quadexp.plugins.identification.predictors import predictors
from quadexp.plugins.logs.samples import read_rows
from tests.models.recorded_flights import crazyflie, recorded_flight

FORCE, TORQUE = 0.03, 2e-3  # N/sqrt(Hz), N m/sqrt(Hz)
WORLD = [
    "plant.linear_drag=[0.3,0.25,0.1]", "plant.quadratic_drag=[0,0,0]", "plant.motor_loss=0",
    "plant.motor_noise_density=0", f"plant.force_noise_density={FORCE}", f"plant.torque_noise_density={TORQUE}",
]  # fmt: skip
PATHS = {
    "circle": ["trajectory=circle", "trajectory.speed=5"],
    "random": ["trajectory=random", "trajectory.speed=6", "seed=3"],
    "eight": ["trajectory=lemniscate", "trajectory.speed=4"],
}


def flown(file: Path, *words: str) -> Flight:
    return requests.simulate([*WORLD, *words], file, force=True).flight


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Three flights of one plant, and the vehicle identified from two of them."""
    folder = tmp_path_factory.mktemp("replay")
    for name, path in PATHS.items():
        flown(folder / f"{name}.parquet", *path, "controller=geometric")
    fitted = [folder / "circle.parquet", folder / "random.parquet"]
    of_logs.identify(fitted, folder / "model", method="regression", settings={}, figures=False)
    return folder


def row_of(report, quantity: str):
    return next(row for row in report["rows"] if row["quantity"] == quantity)


def test_the_controller_of_the_log_repeats_the_log(folder, tmp_path):
    report = replay.replay_test(folder / "eight.parquet", folder / "model", members=3, out=tmp_path / "out")
    assert report["controller"] == "geometric"
    assert report["completed"] == 3
    assert report["number"] == pytest.approx(1.0, abs=0.08)
    for quantity in ("collective thrust / mass, mean", "collective thrust / mass, about its mean", "w_x", "w_y"):
        assert row_of(report, quantity)["ratio"] == pytest.approx(1.0, abs=0.1), quantity
    assert (tmp_path / "out" / "replay.json").is_file()
    assert (tmp_path / "out" / "replay.svg").is_file()


def test_another_controller_flies_as_it_does_in_the_true_plant(folder, tmp_path):
    """Second computation: that controller simulated in the plant that flew the log."""
    truth = flown(tmp_path / "truth.parquet", *PATHS["eight"], "controller=nominal_mpc")
    settled = truth.t >= 1.0
    apart = truth.stack(["p_x", "p_y", "p_z"]) - truth.stack(["ref_p_x", "ref_p_y", "ref_p_z"])
    direct = np.sqrt(np.mean(np.sum(apart[settled] ** 2, axis=1)))
    report = replay.replay_test(folder / "eight.parquet", folder / "model", ["controller=nominal_mpc"], members=3)
    error = row_of(report, "position error")
    assert error["replay"] == pytest.approx(direct, rel=0.1)
    assert abs(error["ratio"] - 1) > 0.2  # the two controllers differ, so that this says something


def test_the_noise_is_that_of_the_plant(folder):
    flight = read_flight(folder / "eight.parquet")
    model = load_model(folder / "model")
    vehicle = replay.build_vehicle(replay.config_for([folder / "eight.parquet"]).vehicle)
    predictor = predictors(model, "model", vehicle, None)[1]
    noise = replay.noise_of(read_rows(flight, "eight", predictor.curve.signal), predictor, vehicle)
    assert noise.shows_torque
    assert noise.force == pytest.approx(FORCE, rel=0.25)
    assert noise.torque == pytest.approx(TORQUE, rel=0.25)


def test_coefficients_are_drawn_with_their_covariance(folder):
    model = load_model(folder / "model")
    draws = [replay.drawn_model(model, {}, np.random.default_rng(seed)) for seed in range(400)]
    values = np.array([drawn.model().coefficients[0] for drawn in draws])
    size = len(model.model().terms[0])
    expected = np.sqrt(np.diag(np.reshape(model.model().covariance[0], (size, size))))
    assert values.std(axis=0) == pytest.approx(expected, rel=0.2)
    assert values.mean(axis=0) == pytest.approx(model.model().coefficients[0], abs=float(expected.max()) / 4)


def test_what_makes_it_no_test_is_said(folder, tmp_path):
    own = replay.replay_test(folder / "circle.parquet", folder / "model", members=1)
    assert any("fitted to circle itself" in text for text in own["warnings"])
    fast = flown(tmp_path / "fast.parquet", "trajectory=circle", "trajectory.speed=10", "controller=geometric")
    assert fast.metadata["outcome"] == "ok"
    report = replay.replay_test(tmp_path / "fast.parquet", folder / "model", members=1)
    assert any("the plant extrapolates in" in text for text in report["warnings"])
    assert not any("extrapolates" in text for text in own["warnings"])
    windy = replay.replay_test(
        folder / "circle.parquet", folder / "model", ["wind=constant", "wind.velocity=[2,0,0]"], members=1
    )
    assert any("wind=constant, where the plant extrapolates" in text for text in windy["warnings"])


def test_shared_data_of_plant_and_controller_is_said(folder):
    words = ["controller=linear_drag_mpc", f"model={folder / 'model'}"]
    report = replay.replay_test(folder / "eight.parquet", folder / "model", words, members=1)
    assert any("plant and controller share the model" in text for text in report["warnings"])


def test_a_log_without_reference_is_followed_where_it_flew(tmp_path):
    vehicle = crazyflie()
    for seed in range(3):
        write_flight(tmp_path / f"{seed}.parquet", recorded_flight(seed, vehicle))
    files = [tmp_path / f"{seed}.parquet" for seed in range(3)]
    of_logs.identify(files[:2], tmp_path / "model", settings={"powers": (1,)}, figures=False)
    report = replay.replay_test(files[2], tmp_path / "model", ["controller=geometric"], members=2)
    assert "no reference" in report["meaning"]
    assert report["number"] == row_of(report, "distance between the paths")["replay"]
    assert row_of(report, "collective thrust / mass, mean")["ratio"] == pytest.approx(1.0, abs=0.05)
    assert any("does not show the torque" in text for text in report["warnings"])  # the four commands are equal


@pytest.mark.parametrize(
    ("words", "said"),
    [(["plant=simplified"], "plant=simplified: the log and the model decide"), (["controller=nobody"], "nobody")],
)
def test_words_that_cannot_be_given(folder, words, said):
    with pytest.raises(UsageError, match=said):
        replay.replay_test(folder / "eight.parquet", folder / "model", words)


def test_what_cannot_be_used_is_refused_in_one_line(folder, tmp_path):
    flight = read_flight(folder / "eight.parquet")
    short = {name: column[:300] for name, column in flight.columns.items()}
    write_flight(tmp_path / "short.parquet", Flight(short, flight.metadata))
    with pytest.raises(DataError, match="longest stretch without a gap takes 2.98 s; 4 are needed"):
        replay.replay_test(tmp_path / "short.parquet", folder / "model")
    done = CliRunner().invoke(app, ["replay-test", str(folder / "eight.parquet"), str(tmp_path / "none")])
    assert done.exit_code == 2
    assert done.stderr.strip().splitlines()[-1].startswith(f"error: {tmp_path / 'none'}: no model there")


def test_the_track_of_a_log_that_turns_on_and_on_is_read_back(tmp_path):
    """Its heading is written within half a turn of zero, where it cannot be taken for degrees."""
    from quadexp.plugins.identification.replay import write_track
    from quadexp.plugins.identification.replay_log import LoggedPath
    from quadexp.plugins.logs.positions import read_positions

    t = np.arange(100) / 10
    heading = 2.0 * t
    point = np.column_stack([t, np.sin(t), 1 + 0 * t])
    write_track(tmp_path / "a.csv", LoggedPath(t, point, None, heading, np.zeros((100, 3)), np.zeros((100, 4)), None))
    assert read_positions(tmp_path / "a.csv").yaw == pytest.approx(heading, abs=1e-8)
