"""Any cell alone, after any other, in any order and in any number of threads: the same flight to the last bit.

Workers are processes that fly one cell after the other. 200 pairs: python -m pytest -m slow tests/properties
"""

import contextlib
import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
from msgspec.structs import replace

from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.log.outcome import COMPLETED
from quadexp.models.checkpoint import save_model
from quadexp.parts.compose import compose, session
from quadexp.parts.schema import Config
from quadexp.plugins.gaussian_process.gaussian_process import GPConfig, fit_gp
from quadexp.plugins.neural.neural import NeuralModel
from quadexp.sweeps.server import start_server
from tests.models.synthetic import synthetic_dataset
from tests.properties import cells


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Checkpoints for the controllers and the plant that have one; what they know is of no importance."""
    folder, vehicle, rng = tmp_path_factory.mktemp("models"), compose().vehicle, np.random.default_rng(0)
    told = {"name": vehicle.name, "fingerprint": build_vehicle(vehicle).fingerprint}
    gp = fit_gp(synthetic_dataset(400, 4), GPConfig(inducing=5, features={"a_x": ("v_x",)}))
    save_model(folder / "gp", replace(gp, vehicle=told))
    axes, weights = ("x", "y", "z"), (rng.normal(size=(4, 3)) / 5, rng.normal(size=(3, 4)) / 5)
    names = tuple(tuple(f"{one}_{axis}" for axis in axes) for one in "va")
    biases = (np.zeros(4), np.zeros(3))
    about = {"vehicle": told, "dataset": gp.dataset, "feature_range": gp.feature_range}
    save_model(folder / "nn", NeuralModel(*names, weights, biases, np.ones(3), 1.0, gp.linear_drag, **about))
    return str(folder)


def pairs_that_compose(count: int, models: str) -> list[tuple[list[str], Config]]:
    """Cells by their overrides, each with the one it is a pair with beside it."""
    found: list[tuple[list[str], Config]] = []
    pairs = cells.drawn_pairs(count, models)
    with session() as composer:
        while len(found) < 2 * count:
            with contextlib.suppress(UsageError):
                found += [(given, composer.expand(given, check=False)[0].config) for given in next(pairs)]
    return found


def flown_alone(configs: list[Config]) -> list[str]:
    """Each in a process that has flown nothing else."""
    start_server()  # as the engine does: it stays for the tests that follow
    context = multiprocessing.get_context("forkserver")
    with ProcessPoolExecutor(2, mp_context=context, max_tasks_per_child=1) as pool:
        return list(pool.map(cells.fingerprint, configs))


def flown_in_threads(configs: list[Config]) -> list[str]:
    """Three at a time, the last ones first."""
    with ThreadPoolExecutor(3) as pool:
        return list(pool.map(cells.fingerprint, configs[::-1]))[::-1]


@pytest.mark.parametrize("pairs", [6, pytest.param(200, marks=pytest.mark.slow)])
def test_a_cell_is_the_same_flight_whatever_flew_before(models, pairs):
    overrides, configs = zip(*pairs_that_compose(pairs, models), strict=True)
    alone = flown_alone(configs)
    assert sum(one.startswith(COMPLETED) for one in alone) > len(alone) / 2
    together = {"in order": [*map(cells.fingerprint, configs)], "in threads": flown_in_threads(configs)}
    for how, found in together.items():
        wrong = [given for given, one, other in zip(overrides, alone, found, strict=True) if one != other]
        assert not wrong, how
