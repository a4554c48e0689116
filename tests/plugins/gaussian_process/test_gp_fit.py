"""The fit finds the truth it was made from, and refuses what it cannot fit."""

import numpy as np
import pytest

from quadexp.errors import DataError, UsageError
from quadexp.models.dataset import ResidualDataset
from quadexp.plugins.gaussian_process.gaussian_process import GPConfig, fit_gp
from tests.models.synthetic import synthetic_dataset, truth


def error_against_truth(model, rows: ResidualDataset) -> dict[str, float]:
    """Root mean square of prediction minus truth where the fit has seen the features, per output (m/s^2)."""
    true = truth(rows.matrix(["v_x", "v_y", "v_z"]), rows.matrix([f"u_{i}" for i in range(4)]))
    errors = {}
    for output, prediction in model.predict(rows).items():
        posterior = next(o for o in model.outputs if o.output == output)
        limits = np.array([model.feature_range[name] for name in posterior.features])
        features = rows.matrix(posterior.features)
        covered = np.all((features >= limits[:, 0]) & (features <= limits[:, 1]), axis=1)
        error = (prediction.mean - true[:, "xyz".index(output[-1])])[covered]
        errors[output] = float(np.sqrt(np.mean(error**2)))
    return errors


def test_twenty_points_find_drag_and_motor_loss():
    model = fit_gp(synthetic_dataset(rows=5000), GPConfig(inducing=20))
    errors = error_against_truth(model, synthetic_dataset(rows=3000, seed=1))
    assert max(errors.values()) < 0.015, errors
    for output in model.outputs:  # the noise that was put in: 0.05
        assert np.sqrt(output.noise_variance) == pytest.approx(0.05, rel=0.04)


def test_thrust_feature_takes_the_motor_loss_out_of_z(dataset):
    settings = {"inducing": 10, "max_iterations": 20}
    without = fit_gp(dataset, GPConfig(features={"a_z": ["v_z"]}, **settings))
    with_thrust = fit_gp(dataset, GPConfig(features={"a_z": ["v_z", "thrust"]}, **settings))
    rows = synthetic_dataset(rows=3000, seed=1)
    assert error_against_truth(with_thrust, rows)["a_z"] < 0.3 * error_against_truth(without, rows)["a_z"]


@pytest.mark.parametrize("mean", ["zero", "constant", "linear_drag"])
def test_far_away_the_prior_mean_is_left(dataset, mean):
    model = fit_gp(dataset, GPConfig(features={"a_x": ["v_x"]}, inducing=8, mean=mean, max_iterations=5))
    far = ResidualDataset(
        {"v_x": np.array([500.0]), "v_y": np.zeros(1), "v_z": np.zeros(1), "thrust": np.zeros(1), "flight": [0]}, {}
    )
    expected = {
        "zero": 0.0,
        "constant": dataset.columns["a_x"].mean(),
        "linear_drag": model.linear_drag.acceleration(far)[0, 0],
    }[mean]
    prediction = model.predict(far)["a_x"]
    assert prediction.mean[0] == pytest.approx(expected, abs=1e-9)
    assert prediction.variance[0] == pytest.approx(model.outputs[0].signal_variance)


@pytest.mark.parametrize("count", [20, 500])
def test_the_subset_of_the_paper(dataset, count):
    model = fit_gp(dataset, GPConfig(features={"a_x": ["v_x"]}, inducing=count, method="subset", max_rows=500))
    assert len(model.outputs[0].alpha) == count
    rows = synthetic_dataset(rows=2000, seed=1)
    assert error_against_truth(model, rows)["a_x"] < 0.1


def test_progress_goes_from_nothing_to_all(dataset):
    seen = []
    settings = GPConfig(features={"a_x": ["v_x"], "a_y": ["v_y"]}, inducing=5, max_iterations=5, max_rows=1000)
    fit_gp(dataset, settings, callback=lambda message, share: seen.append((message, share)))
    shares = [share for _, share in seen]
    assert shares == sorted(shares) and shares[-1] == 1.0
    assert {message for message, _ in seen} == {"fit a_x", "fit a_y", "fit done"}


def test_threads_are_left_as_they_were(dataset):
    import torch

    before = torch.get_num_threads()
    fit_gp(dataset, GPConfig(features={"a_x": ["v_x"]}, inducing=3, max_iterations=2, max_rows=500))
    assert torch.get_num_threads() == before


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"features": {}}, "model.features: no output"),
        ({"features": {"a_q": ["v_x"]}}, "model.features.a_q: no such key"),
        ({"features": {"a_x": ["v_x", "v_x"]}}, "names a feature twice"),
        ({"inducing": 1}, r"model.inducing=1: must be in \[2, 1000\] points"),
    ],
)
def test_settings_out_of_range(settings, message):
    with pytest.raises(UsageError, match=message):
        GPConfig(**settings)


def test_datasets_that_cannot_be_fitted(dataset):
    with pytest.raises(DataError, match="it has no rows"):
        fit_gp(dataset.rows(np.zeros(dataset.n_rows, bool)))
    with pytest.raises(DataError, match="column 'u_7' is missing"):
        fit_gp(dataset, GPConfig(features={"a_x": ["v_x", "u_7"]}))
    with pytest.raises(DataError, match="50 points from 40 rows"):
        fit_gp(dataset.rows(np.arange(40)), GPConfig(inducing=50))
    still = ResidualDataset(dict(dataset.columns) | {"w_x": np.zeros(dataset.n_rows)}, {})
    with pytest.raises(DataError, match="model.features.a_x: 'w_x' never changes"):
        fit_gp(still, GPConfig(features={"a_x": ["v_x", "w_x"]}))
