"""What training flights are drawn from."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.config.compose import compose
from quadexp.experiment.collect import collect_flights
from quadexp.log.schema import Flight

SHORT = ["controller.backend=interpreted", "plant.backend=interpreted", "collect.duration=8"]


def paths(*overrides: str) -> list[np.ndarray]:
    flights: list[Flight] = collect_flights(compose([*SHORT, *overrides]))
    return [flight.stack(["ref_p_x", "ref_p_y", "ref_p_z"]) for flight in flights]


@pytest.fixture(scope="module")
def drawn() -> list[np.ndarray]:
    return paths()


@pytest.mark.parametrize(
    "changed", ["controller=perfect_mpc", "controller.attitude_error=body", "plant=ideal", "collect.duration=16"]
)
def test_paths_do_not_depend_on_what_flies_them_nor_on_how_many_there_are(drawn, changed):
    for path, again in zip(drawn, paths(changed), strict=False):
        assert np.array_equal(path, again)


def test_another_seed_draws_others(drawn):
    assert not np.array_equal(drawn[0][:20], paths("seed=1")[0][:20])
