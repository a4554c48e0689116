"""The verdict of fit-gp: right where the truth is known, silent where nothing can be shown."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import ttest_1samp

from quadexp.models.dataset import ResidualDataset
from quadexp.models.evaluation import fit_with_report
from quadexp.models.gaussian_process import GPModel, GPSettings
from quadexp.models.verdict import noise_floor, paired_ratio, verdict, verdict_lines
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


@pytest.mark.parametrize("memory", [0, 1], ids=["white", "derivative"])
def test_noise_is_found_below_a_slow_effect(memory):
    """White noise of .05 (or that of a differentiated velocity, which errs against its neighbour) below a slow .3."""
    rng, k = np.random.default_rng(2), 20_000
    white = rng.normal(size=k + 1)
    noise = 0.05 * (white[1:] if memory == 0 else (white[1:] - white[:-1]) / np.sqrt(2))
    slow = 0.3 * np.sqrt(2) * np.sin(2 * np.pi * 0.02 * np.arange(k) / 3)
    columns = {"t": 0.02 * np.arange(k), "dt": np.full(k, 0.02), "flight": np.zeros(k, int)}
    found = noise_floor([slow + noise], ResidualDataset(columns, {}))
    assert found == pytest.approx(0.05, rel=0.1)


def test_a_fit_that_sees_the_truth_is_better_and_down_to_the_noise():
    data = synthetic_dataset(rows=4800, flights=16, noise=0.05)
    settings = GPSettings(inducing=15, max_iterations=40, holdout=0.4, refit=False)
    fit = fit_with_report(data, GPModel, settings)
    found = verdict(fit.held_out_model, fit.train, fit.test, settings)
    for output in ("a_x", "a_y"):
        one = found["outputs"][output]
        assert one["verdict"] == "better" and one["noise"] == pytest.approx(0.05, rel=0.1)
        assert one["unexplained"] < 0.03 and "instead" not in one
    assert any("BETTER than linear drag" in line for line in verdict_lines(found))


def coupled_dataset(flights=14, rows=120) -> ResidualDataset:
    """Drag along x that goes with the speed: no function of v_x alone; a_y is linear in v_y."""
    data = synthetic_dataset(rows=flights * rows, flights=flights, noise=0.02)
    rng, columns = np.random.default_rng(5), dict(data.columns)
    t = np.asarray(columns["t"])
    for i, axis in enumerate("xyz"):
        rate, phase = rng.uniform(0.5, 1.5, flights), rng.uniform(0, 6, flights)
        columns[f"v_{axis}"] = 6 * np.sin(rate[columns["flight"]] * t * (1 + 0.3 * i) + phase[columns["flight"]])
    v = np.stack([columns[f"v_{axis}"] for axis in "xyz"], axis=1)
    speed = np.linalg.norm(v, axis=1)
    columns["a_x"] = -0.1 * v[:, 0] * speed + 0.02 * rng.normal(size=len(t))
    columns["a_y"] = -0.3 * v[:, 1] + 0.02 * rng.normal(size=len(t))
    return ResidualDataset(columns, data.metadata)


def test_where_it_is_not_better_it_says_so_and_names_the_features_that_are(monkeypatch):
    monkeypatch.setattr("quadexp.models.verdict.TRIAL_ITERATIONS", 15)
    data = coupled_dataset()
    settings = GPSettings(
        features={"a_x": ("v_x",), "a_y": ("v_y",)}, inducing=10, max_iterations=25, holdout=0.4, refit=False
    )
    fit = fit_with_report(data, GPModel, settings)
    found = verdict(fit.held_out_model, fit.train, fit.test, settings)
    a_x, a_y = found["outputs"]["a_x"], found["outputs"]["a_y"]
    assert a_x["verdict"] != "better" and a_x["instead"]["verdict"] == "better"
    assert set(a_x["instead"]["features"]) >= {"v_x", "v_y", "v_z"} and a_x["unexplained"] > 5 * 0.02
    assert a_y["verdict"] != "better" and a_y["instead"]["verdict"] != "better"
    text = "\n".join(verdict_lines(found))
    assert "gp.features.a_x=[v_x,v_y,v_z" in text and "NOT SHOWN TO BE BETTER" in text
    assert "no other features are shown to be better" in text
