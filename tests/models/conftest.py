import pytest

from tests.models.synthetic import synthetic_dataset


@pytest.fixture(scope="session")
def dataset():
    return synthetic_dataset(rows=6000)


@pytest.fixture(scope="session")
def model(dataset):
    """Gaussian processes that were fitted to it, where that plug-in is there."""
    from quadexp.plugins.gaussian_process.gaussian_process import GPConfig, fit_gp

    return fit_gp(dataset, GPConfig(inducing=8, mean="linear_drag", max_iterations=8))
