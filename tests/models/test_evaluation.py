"""Scores against their definitions, the split by flight, and the figures of a fit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from quadexp.errors import DataError
from quadexp.models.dataset import ResidualDataset
from quadexp.models.evaluation import drag_baseline, evaluate, fit_with_report, score, split_by_flight
from quadexp.models.gaussian_process import GPModel, GPSettings
from quadexp.models.sgpr import fit_gp
from quadexp.report.fit_figures import calibration_figure, curve, fit_figure, moved
from tests.models.synthetic import synthetic_dataset

QUICK = GPSettings(inducing=10, max_iterations=15)


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


def test_report_is_about_flights_the_model_has_not_seen(dataset, small_trials):
    fit = fit_with_report(dataset, GPModel, QUICK)
    rows = {(row["output"], row["predictor"]): row for row in fit.report["rows"]}
    for output in ("a_x", "a_y", "a_z"):
        gp, drag, zero = (rows[output, name] for name in ("gp", "linear_drag", "zero"))
        assert gp["rmse"] < 0.5 * drag["rmse"] < 0.5 * zero["rmse"]
        assert gp["nlpd"] < drag["nlpd"] < zero["nlpd"]
        assert 0.6 < gp["inside_1"] < 0.78 and 0.9 < gp["inside_2"] < 0.99
    assert fit.report["refitted"] and len(fit.report["held_out_flights"]) == 2
    assert fit.model.dataset["rows"] == dataset.n_rows > fit.held_out_model.dataset["rows"] == fit.train.n_rows
    assert fit.model.settings == QUICK.as_dict()


def test_one_flight_is_fitted_without_a_report_only():
    one = synthetic_dataset(rows=500, flights=1)
    with pytest.raises(DataError, match="one flight, .*collect more.*gp.holdout=0 for fit-gp"):
        fit_with_report(one, GPModel, QUICK)
    fit = fit_with_report(one, GPModel, GPSettings(inducing=5, max_iterations=5, holdout=0))
    assert fit.test is None and fit.report["rows"] == []


def test_drag_alone_is_evaluated_too(dataset):
    train, test = split_by_flight(dataset, 0.25)
    full = evaluate(drag_baseline(train), train, test)
    published = evaluate(drag_baseline(train, intercept=False, thrust=False), train, test)
    assert [row["output"] for row in full] == ["a_x", "a_x", "a_y", "a_y", "a_z", "a_z"]
    assert full[4]["rmse"] < published[4]["rmse"]  # on z the motors' loss needs more than the velocity


def test_more_points_and_their_optimisation_lower_the_error(dataset):
    train, test = split_by_flight(dataset, 0.2)
    found = {}
    for method, points in (("sgpr", 5), ("sgpr", 10), ("subset", 5)):
        model = fit_gp(train, GPSettings(inducing=points, method=method, max_iterations=10, max_rows=1500))
        found[method, points] = evaluate(model, train, test)[0]["rmse"]
    assert found["sgpr", 10] < found["sgpr", 5] < found["subset", 5]


@pytest.mark.parametrize("mean", ["zero", "linear_drag", "quadratic", "blade_element"])
def test_a_drawn_curve_is_the_prediction_with_all_else_at_its_median(dataset, mean):
    model = fit_gp(dataset, GPSettings(inducing=5, max_iterations=3, mean=mean))
    output, names = model.outputs[2], ["v_x", "v_y", "v_z", "u_0", "u_1", "u_2", "u_3"]  # a_z <- v_z, thrust
    middle = {name: np.median(dataset.matrix([name])) for name in names}
    middle |= {name: np.median(dataset.matrix(["thrust"])) / 4 for name in names[3:]}
    drawn = curve(model, output, 0, dataset, count=5)
    rows = {name: np.full(5, value) for name, value in middle.items()} | {"v_z": drawn.x, "flight": np.zeros(5, int)}
    np.testing.assert_allclose(drawn.mean, model.predict(ResidualDataset(rows, {}))["a_z"].mean, rtol=1e-12)
    remainder = moved(model, output, 0, dataset)[1]
    np.testing.assert_array_equal(remainder, dataset.matrix(["a_z"])[:, 0] - model.predict(dataset)["a_z"].mean)
    assert np.isfinite(curve(model, output, 0, None).mean).all()  # the page has a checkpoint whose data are gone


@pytest.mark.parametrize("mean", ["zero", "quadratic"])
def test_figures(dataset, tmp_path, mean):
    fit = fit_with_report(dataset, GPModel, GPSettings(inducing=10, max_iterations=10, mean=mean))
    figures = {
        "fit": fit_figure(fit.held_out_model, fit.test),
        "calibration": calibration_figure(fit.held_out_model, fit.test),
    }
    for name, figure in figures.items():
        for suffix in ("svg", "png", "pdf"):
            figure.savefig(tmp_path / f"{name}.{suffix}")
            assert (tmp_path / f"{name}.{suffix}").stat().st_size > 2000
    labels = [axes.get_ylabel() for axes in figures["fit"].axes]
    assert all("m/s²" in label for label in labels)
