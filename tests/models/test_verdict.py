"""How well a fit predicts: scores by their definitions, the split by flight, the verdict where the truth is known."""

import numpy as np
import pytest
from scipy.stats import norm, ttest_1samp

from quadexp.errors import DataError
from quadexp.models.base import feature_ranges, outside_shares
from quadexp.models.checkpoint import load_model, save_model
from quadexp.models.dataset import ResidualDataset
from quadexp.models.linear_drag import fit_linear_drag
from quadexp.models.verdict import (
    evaluate,
    fit_with_report,
    noise_floor,
    paired_ratio,
    score,
    split_by_flight,
    verdict,
    verdict_lines,
)
from quadexp.plugins.gaussian_process.gaussian_process import GPConfig, fit_gp
from quadexp.plugins.page.model_figures import curve, moved
from tests.models.synthetic import synthetic_dataset


def test_the_ratio_is_a_paired_t_interval_of_logarithms():
    rng, flight = np.random.default_rng(0), np.repeat(np.arange(8), 200)
    size = rng.uniform(0.5, 5, 8)[flight]
    error, other = 0.7 * size * rng.normal(size=1600), size * rng.normal(size=1600)
    logs = [0.5 * np.log(np.mean(error[flight == f] ** 2) / np.mean(other[flight == f] ** 2)) for f in range(8)]
    ratio, expected = paired_ratio(error, other, flight), ttest_1samp(logs, 0).confidence_interval(0.95)
    assert (ratio.low, ratio.high) == pytest.approx((np.exp(expected.low), np.exp(expected.high)))
    assert ratio.verdict == "better" and paired_ratio(other, error, flight).verdict == "worse"


def test_equal_predictors_are_called_better_in_one_of_forty_at_most_often():
    """Two-sided 95 %: "better" by chance in 2.5 %; 400 trials, one standard deviation is 0.8 %."""
    rng, flight, called = np.random.default_rng(1), np.repeat(np.arange(6), 50), 0
    for _ in range(400):
        error, other = rng.normal(size=(2, 300)) * rng.uniform(0.5, 2, (2, 6))[:, flight]
        called += paired_ratio(error, other, flight).verdict == "better"
    assert called / 400 < 0.05


def test_one_flight_shows_nothing():
    ratio = paired_ratio(np.full(9, 0.1), np.ones(9), np.zeros(9))
    assert ratio.verdict == "open" and "no interval" in str(ratio)


@pytest.mark.parametrize(
    ("flights", "of", "identified", "said"),
    [
        (2, 10, False, "2 held-out flights are too few to tell, 3 the least: model.holdout=0.3 holds out 3 of these"),
        (1, 7, True, "1 held-out flight is too few to tell, 3 the least: model.holdout=0.43 holds out 3 of these 7"),
        (1, 2, False, "collect 7 in all (collect.duration=70), and model.holdout=0.43 holds out 3 of them"),
        (1, 2, True, "collect 7 in all (add flights), and model.holdout=0.43 holds out 3 of them"),
        (3, 10, False, ""),
    ],
)
def test_too_few_held_out_flights_are_called_that_and_what_would_do(flights, of, identified, said):
    """Two of README's own course said that a model a hundred times better was not shown to be better."""
    row = paired_ratio(np.full(10 * flights, 0.01), np.ones(10 * flights), np.repeat(np.arange(flights), 10)).record()
    row |= {"rmse": 0.01, "drag_rmse": 1.0, "noise": 0.003, "unexplained": 0.009}
    model = {"model": "this fit", "rms": 0.01, "share": 0.1}
    report = {"outputs": {"a_y": row}, "flights": flights, "of": of, "duration": 10.0 * of}
    report |= {"identified": [model, {**model, "model": "linear drag", "rms": 1.0} | row]} if identified else {}
    lines = verdict_lines(report)
    assert (said in lines[0]) == bool(said) or not said
    assert any("TOO FEW FLIGHTS TO TELL: 0.01 (no interval)" in line for line in lines) == bool(said)
    assert not any("NOT SHOWN" in line for line in lines)
    if said and (share := float(lines[0].partition("model.holdout=")[2].split()[0])):
        every = max(of, 7)
        data = ResidualDataset({"flight": np.arange(every)}, {})
        assert len(split_by_flight(data, share)[1].flights) == 3


@pytest.mark.parametrize("memory", [0, 1], ids=["white", "derivative"])
def test_noise_is_found_below_a_slow_effect(memory):
    """White noise of 0.05 (or that of a differentiated velocity, which errs against its neighbour) below a slow 0.3."""
    rng, k = np.random.default_rng(2), 20_000
    white = rng.normal(size=k + 1)
    noise = 0.05 * (white[1:] if memory == 0 else (white[1:] - white[:-1]) / np.sqrt(2))
    slow = 0.3 * np.sqrt(2) * np.sin(2 * np.pi * 0.02 * np.arange(k) / 3)
    columns = {"t": 0.02 * np.arange(k), "dt": np.full(k, 0.02), "flight": np.zeros(k, int)}
    found = noise_floor([slow + noise], ResidualDataset(columns, {}))
    assert found == pytest.approx(0.05, rel=0.1)


def test_a_fit_that_sees_the_truth_is_better_and_down_to_the_noise():
    data = synthetic_dataset(rows=4800, flights=16, noise=0.05)
    settings = GPConfig(inducing=15, max_iterations=40, holdout=0.4, refit=False)
    fit = fit_with_report(data, settings)
    found = verdict(fit.held_out_model, fit.train, fit.test)
    for output in ("a_x", "a_y"):
        one = found["outputs"][output]
        assert one["verdict"] == "better" and one["noise"] == pytest.approx(0.05, rel=0.1)
        assert one["unexplained"] < 0.03
    assert any("BETTER than linear drag" in line for line in verdict_lines(found))


QUICK = GPConfig(inducing=10, max_iterations=15)
ALONG_X = {"a_x": QUICK.features.a_x}


def test_scores_are_what_they_say():
    rng = np.random.default_rng(0)
    mean, std = rng.normal(size=20000), rng.uniform(0.5, 2, 20000)
    target = mean + std * rng.normal(size=20000)
    found = score(target, mean, std)
    assert found["nlpd"] == pytest.approx(-np.mean(norm(mean, std).logpdf(target)))
    assert found["rmse"] == pytest.approx(np.sqrt(np.mean((target - mean) ** 2)))
    assert found["inside_1"] == pytest.approx(0.683, abs=0.01) and found["inside_2"] == pytest.approx(0.954, abs=0.005)


def test_split_keeps_flights_whole(dataset):
    train, test = split_by_flight(dataset, 0.25, seed=3)
    assert len(test.flights) == 3 and len(train.flights) == 9
    assert not set(train.flights) & set(test.flights)
    assert train.n_rows + test.n_rows == dataset.n_rows
    assert set(split_by_flight(dataset, 0.25, seed=3)[1].flights) == set(test.flights)
    assert len(split_by_flight(dataset, 1e-6)[1].flights) == 1 and len(split_by_flight(dataset, 0.99)[0].flights) == 1


def test_report_is_about_flights_the_model_has_not_seen(dataset):
    fit = fit_with_report(dataset, QUICK)
    rows = {(row["output"], row["predictor"]): row for row in fit.report["rows"]}
    for output in ("a_x", "a_y", "a_z"):
        gp, drag, zero = (rows[output, name] for name in ("gp", "linear_drag", "zero"))
        assert gp["rmse"] < 0.5 * drag["rmse"] < 0.5 * zero["rmse"]
        assert gp["nlpd"] < drag["nlpd"] < zero["nlpd"]
        assert 0.6 < gp["inside_1"] < 0.78 and 0.9 < gp["inside_2"] < 0.99
    assert fit.report["refitted"] and len(fit.report["held_out_flights"]) == 2
    assert fit.model.dataset["rows"] == dataset.n_rows > fit.held_out_model.dataset["rows"] == fit.train.n_rows


def test_one_flight_is_fitted_without_a_report_only():
    one = synthetic_dataset(rows=500, flights=1)
    with pytest.raises(DataError, match="one flight, .*collect more.*model.holdout=0"):
        fit_with_report(one, QUICK)
    fit = fit_with_report(one, GPConfig(inducing=5, max_iterations=5, holdout=0))
    assert fit.test is None and fit.report["rows"] == []


def test_more_points_and_their_optimisation_lower_the_error(dataset):
    train, test = split_by_flight(dataset, 0.2)
    found = {}
    for method, points in (("sgpr", 5), ("sgpr", 10), ("subset", 5)):
        settings = GPConfig(inducing=points, method=method, max_iterations=10, max_rows=1500, features=ALONG_X)
        model = fit_gp(train, settings)
        found[method, points] = evaluate(model, train, test)[0]["rmse"]
    assert found["sgpr", 10] < found["sgpr", 5] < found["subset", 5]


@pytest.mark.parametrize("mean", ["zero", "linear_drag", "quadratic", "blade_element"])
def test_a_drawn_curve_is_the_prediction_with_all_else_at_its_median(dataset, mean):
    dataset = dataset.rows(np.arange(0, dataset.n_rows, 10))
    model = fit_gp(dataset, GPConfig(inducing=5, max_iterations=3, mean=mean))
    output, names = model.outputs[2], ["v_x", "v_y", "v_z", "u_0", "u_1", "u_2", "u_3"]  # a_z <- v_z, thrust
    middle = {name: np.median(dataset.matrix([name])) for name in names}
    middle |= {name: np.median(dataset.matrix(["thrust"])) / 4 for name in names[3:]}
    drawn = curve(model, output, 0, dataset, count=5)
    rows = {name: np.full(5, value) for name, value in middle.items()} | {"v_z": drawn.x, "flight": np.zeros(5, int)}
    np.testing.assert_allclose(drawn.mean, model.predict(ResidualDataset(rows, {}))["a_z"].mean, rtol=1e-12)
    remainder = moved(model, output, 0, dataset)[1]
    np.testing.assert_array_equal(remainder, dataset.matrix(["a_z"])[:, 0] - model.predict(dataset)["a_z"].mean)


def rows(velocity, thrust=None) -> ResidualDataset:
    velocity = np.asarray(velocity, float)
    columns = {f"v_{axis}": velocity[:, i] for i, axis in enumerate("xyz")}
    return ResidualDataset(columns | {"thrust": np.full(len(velocity), 10.0) if thrust is None else thrust}, {})


def test_ranges_are_those_of_the_rows_and_speed_counts_from_zero():
    ranges = feature_ranges(rows([[3, 0, 0], [-3, 4, 1]], np.array([5.0, 9.0])), ["thrust"])
    assert ranges["v_x"] == [-3, 3] and ranges["v_y"] == [0, 4] and ranges["thrust"] == [5, 9]
    assert ranges["speed"] == [0, pytest.approx(np.sqrt(26))]


def test_a_corner_inside_every_axis_is_outside_by_its_speed():
    """17 m/s along x and along y, never both: 24 m/s along the diagonal was not in the data."""
    ranges = feature_ranges(rows([[17, 0, 0], [-17, 0, 0], [0, 17, 0], [0, -17, 0]]))
    shares = outside_shares(ranges, rows([[0, 0, 0], [16, 16, 0], [17, 0, 0], [18, 0, 0]]))
    assert shares["v_x"] == 0.25 and shares["v_y"] == 0 and shares["speed"] == 0.5 and shares["any"] == 0.5


def test_the_rows_of_the_fit_are_never_outside(dataset, model):
    assert outside_shares(model.feature_range, dataset)["any"] == 0
    assert outside_shares(fit_linear_drag(dataset, intervals=False).feature_range, dataset)["any"] == 0
    assert {"v_x", "v_y", "v_z", "speed", "thrust"} == set(model.feature_range)


def test_a_checkpoint_keeps_them_and_one_without_them_says_unknown(dataset, tmp_path):
    from msgspec.structs import replace

    from quadexp.report.summary import summarise

    fit = fit_linear_drag(dataset, intervals=False)
    save_model(tmp_path / "new", fit)
    assert load_model(tmp_path / "new").feature_range == fit.feature_range
    assert any(line.startswith("covers      v_x ") for line in summarise(tmp_path / "new")["lines"])
    save_model(tmp_path / "old", replace(fit, feature_range={}))
    assert any("covers      unknown" in line for line in summarise(tmp_path / "old")["lines"])
