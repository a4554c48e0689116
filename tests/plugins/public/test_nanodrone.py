"""The nanodrone benchmark: its errors by an independent computation, and its protocol on files of known truth."""

import json
import math

import numpy as np
import pandas
import pytest
from scipy.spatial.transform import Rotation

import quadexp
from quadexp.errors import DataError, UsageError
from quadexp.plugins.public import nanodrone, nanodrone_model
from quadexp.plugins.public.nanodrone import PARTS, PUBLISHED, SPEEDS, STATES, STEPS, Run, by_toolbox, errors, read
from quadexp.plugins.public.nanodrone_report import BLIND, HELD, LOOKED_AT, REPLAY, reproduce
from tests.models.recorded_flights import crazyflie

PATHS = (  # name of the file, what is flown
    ("train/square_20251017_run1", ("trajectory=lemniscate", "trajectory.radius=1", "trajectory.speed=2")),
    ("train/chirp_20251017_run1", ("trajectory=circle", "trajectory.radius=1", "trajectory.speed=3")),
    ("test/melon_20251017_run1", ("trajectory=lemniscate", "trajectory.radius=1.5", "trajectory.speed=2.5")),
)
OURS = ["p_x", "p_y", "p_z", "v_x", "v_y", "v_z", "q_x", "q_y", "q_z", "q_w", "w_x", "w_y", "w_z"]
DRAG = (0.4, 0.3, 0.2)  # 1/s


def some_runs(rng, count=2, samples=120):
    runs = []
    for number in range(count):
        y = rng.normal(size=(samples, len(STATES)))
        y[:, PARTS["R"]] = Rotation.random(samples, random_state=number).as_quat()
        runs.append(Run(f"melon_{number}", y, rng.uniform(1500, 1900, (samples, 4)), str(number)))
    predictions = [rng.normal(size=(len(run.starts), STEPS, len(STATES))) for run in runs]
    for predicted in predictions:
        predicted[..., PARTS["R"]] /= np.linalg.norm(predicted[..., PARTS["R"]], axis=2, keepdims=True)
    return runs, predictions


def error_of(part, truth, guess):
    """By the words of the paper, for one state."""
    if part != "R":
        return math.dist(truth[PARTS[part]], guess[PARTS[part]])
    apart = Rotation.from_quat(truth[PARTS[part]]).inv() * Rotation.from_quat(guess[PARTS[part]])
    angle = apart.magnitude()
    return angle if np.dot(truth[PARTS[part]], guess[PARTS[part]]) >= 0 else 2 * math.pi - angle


def test_errors_are_those_of_the_paper_s_words():
    """Each flight by itself, and laid end to end, where the last rows meet the next flight; both state by state."""
    runs, predictions = some_runs(np.random.default_rng(0))
    by_run, by_paper = errors(runs, predictions), errors(runs, predictions, as_paper=True)
    rows = [run.y[i + 1] for run in runs for i in run.starts]
    laid = np.concatenate(predictions)
    for part in PARTS:
        for step in (1, 2, 10, STEPS):
            means = []
            for run, predicted in zip(runs, predictions, strict=True):
                each = [error_of(part, run.y[i + step], predicted[i, step - 1]) for i in run.starts]
                means.append(np.mean(each))
            assert by_run[part][step - 1] == pytest.approx(np.mean(means), rel=1e-9)
            each = [error_of(part, rows[i + step - 1], laid[i, step - 1]) for i in range(len(rows) - step + 1)]
            assert by_paper[part][step - 1] == pytest.approx(np.mean(each), rel=1e-9)


def test_a_quaternion_of_the_other_sign_is_an_error_of_nearly_a_turn():
    """The metric is not free of the sign, so predictions have to keep that of the state they begin at."""
    runs, _ = some_runs(np.random.default_rng(1), count=1)
    truth = runs[0].y[:, PARTS["R"]]
    assert nanodrone.rotation_error(truth, truth) == pytest.approx(0, abs=1e-7)
    assert nanodrone.rotation_error(truth, -truth) == pytest.approx(2 * math.pi, abs=1e-7)
    still = nanodrone_model.Force(9.81 / 4, np.zeros(3))
    for sign in (1, -1):
        y = np.tile(runs[0].y[:1], (STEPS + 5, 1))
        y[:, PARTS["R"]] *= sign
        y[:, PARTS["w"]] = [1.0, -2.0, 3.0]
        run = Run("turning", y, np.full((STEPS + 5, 4), nanodrone_model.HOVER), "")
        turned = nanodrone_model.predicted(run, still, None, run.u.sum(axis=1).mean())[0, :, PARTS["R"]]
        steps = np.vstack([y[:1, PARTS["R"]], turned])
        assert (np.sum(steps[1:] * steps[:-1], axis=1) > 0.99).all()


def test_the_toolbox_computes_the_same():
    pytest.importorskip(
        "nonlinear_benchmarks.nanodrone_error_metrics",
        reason="no version of nonlinear_benchmarks with NanoDrone is installed",
    )
    runs, predictions = some_runs(np.random.default_rng(2), samples=60)
    theirs = by_toolbox(runs, predictions)
    for part, ours in errors(runs, predictions).items():
        assert theirs[part] == pytest.approx(ours, rel=1e-9)


def test_published_sums_fit_their_steps():
    """Errors grow over the steps, so the sum lies between 50 of the first and 50 of the last."""
    for parts in PUBLISHED.values():
        for first, tenth, last, total in parts.values():
            assert first < tenth < last and STEPS * first < total < STEPS * last


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A data set in the benchmark's files, of flights of a vehicle of 27 g whose every number is known."""
    folder = tmp_path_factory.mktemp("nanodrone")
    vehicle = crazyflie()
    drag = [vehicle.mass * share for share in DRAG]  # N s/m
    for name, path in PATHS:
        flight = quadexp.simulate(
            "vehicle=crazyflie", "controller=nominal_mpc", "plant=ideal", f"plant.linear_drag={drag}",
            "trajectory.acceleration=1", "controller.rate=100", *path,
        )  # fmt: skip
        table = pandas.DataFrame({theirs: flight[ours] for theirs, ours in zip(STATES, OURS, strict=True)})
        for i, speed in enumerate(SPEEDS):  # a flight's row has the command that led to it, theirs that from it on
            table[speed] = np.sqrt(flight[f"u_{i}"].shift(-1) / vehicle.thrust_coefficient)
        file = folder / f"{name}.csv"
        file.parent.mkdir(exist_ok=True)
        table[:-1].to_csv(file, index=False)
    return folder


def test_flights_of_known_truth_are_predicted_and_their_force_is_found(data, tmp_path):
    report = reproduce(data, tmp_path / "out")
    vehicle = crazyflie()
    force = report["constants"]["force"]
    assert force["thrust"] == pytest.approx(
        vehicle.thrust_coefficient * nanodrone_model.HOVER**2 / vehicle.mass, rel=0.01
    )
    assert force["drag"][:2] == pytest.approx(DRAG[:2], abs=0.02)
    rows = {row["model"]: row for row in report["rows"]}
    assert rows[REPLAY]["runs_p_h50"] < 0.1 * rows[HELD]["runs_p_h50"]
    assert rows[REPLAY]["runs_w_h50"] < 0.1 * rows[HELD]["runs_w_h50"]
    assert rows[REPLAY]["runs_w_h50"] < rows[BLIND]["runs_w_h50"]
    stored = json.loads((tmp_path / "out" / "submission.json").read_text())
    assert stored["looked_at"] == LOOKED_AT and set(stored["train"]) == {name[6:] for name, _ in PATHS[:2]}
    text = (tmp_path / "out" / "submission.md").read_text()
    assert LOOKED_AT in text and f"SimErr_pos = {rows[REPLAY]['runs_p_sum']:.6f} m" in text


def test_what_is_no_data_is_refused_with_the_way(data, tmp_path):
    with pytest.raises(UsageError, match=r"--data DIR .*data\.zip"):
        read(None)
    with pytest.raises(UsageError, match="no train/ and test/"):
        read(tmp_path)
    for part in ("train", "test"):
        (tmp_path / part).mkdir()
    with pytest.raises(UsageError, match="no CSV files"):
        read(tmp_path)
    melon = (data / "test" / "melon_20251017_run1.csv").read_bytes()
    (tmp_path / "test" / "melon_20251017_run1.csv").write_bytes(melon)
    (tmp_path / "train" / "random_20251017_run1.csv").write_bytes(melon)
    with pytest.raises(DataError, match="a flight of the test set"):
        read(tmp_path)
    (tmp_path / "train" / "random_20251017_run1.csv").write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(DataError, match="git lfs pull"):
        read(tmp_path)
    (tmp_path / "train" / "random_20251017_run1.csv").write_text("t,x\n0,1\n")
    with pytest.raises(DataError, match="no column 'y'"):
        read(tmp_path)
