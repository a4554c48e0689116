"""Networks: they learn what linear drag cannot, keep the promised slope, and come back from a file as they were."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from quadexp.errors import DataError, UsageError
from quadexp.models.checkpoint import MODEL_FILE, _hash, load_model, save_model
from quadexp.models.linear_drag import fit_linear_drag
from quadexp.models.verdict import evaluate, split_by_flight, without
from quadexp.plugins.neural.neural import NeuralModel, NNConfig
from tests.models.synthetic import synthetic_dataset
from tests.models.test_checkpoint import assert_same_bits

QUICK = NNConfig(hidden=(10, 10), max_iterations=120)


@pytest.fixture(scope="module")
def data():
    return synthetic_dataset(rows=3000, flights=6)


@pytest.fixture(scope="module")
def network(data) -> NeuralModel:
    return QUICK.fit(data)


def test_it_learns_what_linear_drag_cannot():
    """On held-out flights with noise of 0.05 m/s^2: quadratic drag, and the loss of the motors on z."""
    train, test = split_by_flight(synthetic_dataset(rows=6000), 0.3, 0)
    rows = evaluate(replace(QUICK, max_iterations=250).fit(train), train, test)
    error = {(row["output"], row["predictor"]): row["rmse"] for row in rows}
    for output in ("a_x", "a_y", "a_z"):
        assert error[output, "nn"] < 0.5 * error[output, "linear_drag"]
        assert error[output, "linear_drag"] < error[output, "zero"]
    assert {row["predictor"] for row in rows} == {"nn", "linear_drag", "zero"}


def test_a_seed_gives_the_same_weights_and_another_one_others(data, network):
    assert_same_bits(QUICK.fit(data).weights, network.weights)
    other = replace(QUICK, seed=1, max_iterations=3).fit(data)
    assert not np.array_equal(other.weights[0], network.weights[0])


@pytest.mark.parametrize("limit", [1.5, 5.0])
def test_spectral_normalisation_bounds_every_slope(data, limit):
    """The largest singular value of the scaled network's Jacobian, anywhere; it is of use: the bound is nearly met."""
    model = replace(QUICK, spectral=limit, max_iterations=60).fit(data)
    assert model.lipschitz <= limit * (1 + 1e-9)
    spread = data.matrix(model.features).std(axis=0)
    unit = np.sqrt(np.mean(data.matrix(model.outputs) ** 2, axis=0))
    rng = np.random.default_rng(0)
    largest = 0.0
    for z in 3 * spread * rng.normal(size=(300, len(spread))):
        rows = np.vstack([z + 1e-5 * spread * step for step in (*np.eye(len(spread)), *-np.eye(len(spread)))])
        y = model.network(rows) / unit
        jacobian = (y[: len(spread)] - y[len(spread) :]) / 2e-5
        largest = max(largest, np.linalg.norm(jacobian, 2))
    assert 0.2 * limit < largest <= limit * (1 + 1e-6)


def test_outputs_are_bounded_outside_the_data(network):
    """No velocity gives more than the last layer's weights allow."""
    far = 1e6 * np.random.default_rng(1).normal(size=(50, len(network.features)))
    bound = np.abs(network.weights[-1]).sum(axis=1) + np.abs(network.biases[-1])
    assert np.all(np.abs(network.network(far)) <= bound)


@pytest.mark.parametrize(
    ("key", "value"),
    [("weights", [[[1.0]]]), ("biases", [[1.0], [2.0]]), ("outputs", ["a_x", "a_x", "a_z"]), ("features", ["v_x"])],
)
def test_a_file_whose_parts_do_not_fit_is_refused(tmp_path, network, key, value):
    file = save_model(tmp_path / "nn", network) / MODEL_FILE
    document = json.loads(file.read_text())
    document["payload"][key] = value
    document["sha256"] = _hash(document["payload"])
    file.write_text(json.dumps(document))
    with pytest.raises(DataError, match="not a valid model"):
        load_model(tmp_path / "nn")


@pytest.mark.parametrize(
    "change",
    [{"hidden": ()}, {"outputs": ("a_q",)}, {"features": ("v_x", "v_x")}, {"features": ("speed",)}, {"spectral": -1.0}],
)
def test_impossible_settings_are_refused(change):
    with pytest.raises(UsageError, match=r"model\."):
        NNConfig(**change)


def test_constant_features_and_empty_data_are_refused(data):
    still = data._replace(columns=dict(data.columns) | {"v_x": np.zeros(data.n_rows)})
    with pytest.raises(DataError, match="'v_x' never changes"):
        QUICK.fit(still)
    with pytest.raises(DataError, match="no rows"):
        QUICK.fit(data.rows(np.zeros(data.n_rows, bool)))


def test_the_rest_is_what_another_model_leaves(data, network):
    drag = fit_linear_drag(data, intervals=False)
    rest = without(data, drag, "models/drag")
    target = data.matrix(["a_x", "a_y", "a_z"])
    assert np.allclose(rest.matrix(["a_x", "a_y", "a_z"]) + drag.acceleration(data), target)
    assert np.array_equal(rest.matrix(["tau_x"]), data.matrix(["tau_x"]))
    assert rest.sha256 != data.sha256
    with pytest.raises(UsageError, match="identified vehicle"):
        without(
            data, load_model(Path(__file__).parents[2] / "models" / "stored" / "vehicle_model.json"), "models/other"
        )
    left = without(data, network, "nn").matrix(["a_x"])
    assert np.sqrt(np.mean(left**2)) == pytest.approx(network.residual_std[0])
