"""What every learned model promises, whatever it is: the seam of quadexp/models/base.py."""

import msgspec
import numpy as np
import pytest

from quadexp.models.base import AXIS
from quadexp.models.checkpoint import load_model, plain, record_of, save_model
from quadexp.models.linear_drag import DragConfig, LinearDrag
from quadexp.plugins.gaussian_process.gaussian_process import GaussianProcessModel, GPConfig
from quadexp.plugins.neural.neural import NeuralModel, NNConfig
from tests.models.synthetic import synthetic_dataset
from tests.models.test_dataset import VEHICLE

SETTINGS = {
    LinearDrag: DragConfig(),
    GaussianProcessModel: GPConfig(
        inducing=5, max_iterations=5, mean="quadratic", features={"a_x": ("v_x",), "tau_y": ("w_y",)}
    ),
    NeuralModel: NNConfig(hidden=(4,), max_iterations=5),
}
FEATURES = ["v_x", "v_y", "v_z", "w_x", "w_y", "w_z", "u_0", "u_1", "u_2", "u_3"]


@pytest.fixture(scope="module")
def rows():
    return synthetic_dataset(600, 4)


@pytest.fixture(scope="module")
def fits(rows):
    return {kind: settings.fit(rows) for kind, settings in SETTINGS.items()}


@pytest.mark.parametrize("kind", SETTINGS, ids=lambda kind: kind.__name__)
class TestContract:
    @pytest.fixture
    def fitted(self, kind, fits):
        return fits[kind]

    def test_what_flies_is_what_is_predicted(self, kind, rows, fitted):
        flown = fitted.residual(VEHICLE)(rows.matrix(FEATURES))
        np.testing.assert_allclose(flown[:, :3], fitted.acceleration(rows), atol=1e-9)
        for output, found in fitted.predict(rows).items():
            if output in AXIS:
                assert np.array_equal(found.mean, fitted.acceleration(rows)[:, AXIS[output]])
            assert found.std.shape == (rows.n_rows,) and np.all(found.std > 0)

    def test_a_checkpoint_is_its_fields(self, kind, rows, fitted, tmp_path):
        loaded = load_model(save_model(tmp_path / "model", fitted))
        assert type(loaded) is kind and plain(loaded) == plain(fitted)
        with pytest.raises(msgspec.ValidationError, match="unknown field `colour`"):
            record_of(plain(fitted) | {"colour": "red"}, kind)
        with pytest.raises(msgspec.ValidationError, match=r"is of shape \(2,\); \(3,\) is needed"):
            record_of(plain(fitted.linear_drag) | {"drag": [1.0, 2.0]}, LinearDrag)

    def test_adapting_in_flight_begins_with_the_fit(self, kind, rows, fitted):
        residual = fitted.residual(VEHICLE)
        adapting = fitted.adapting(VEHICLE, residual, 1.0)
        assert np.array_equal(adapting.residual.theta, residual.theta) and adapting.blocks

    def test_fitted_again_to_the_same_rows_it_is_the_same(self, kind, rows, fitted):
        recorded = rows._replace(metadata={**rows.metadata, "recorded": True})
        again = fitted.refitted(rows if kind is not LinearDrag else recorded)
        if kind is LinearDrag:  # of recorded flights, whose thrust has a scale in common
            np.testing.assert_allclose(again.drag[:2], fitted.drag[:2], rtol=1e-12)
        else:
            np.testing.assert_allclose(again.acceleration(rows), fitted.acceleration(rows), rtol=1e-12)
        assert again.kind == fitted.kind and fitted.summary
