"""What training flights are drawn from."""

import numpy as np
import pytest

from quadexp.experiment.collect import collect_flights
from quadexp.log.schema import Flight
from quadexp.parts.compose import compose

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
        both = min(len(path), len(again))  # the last path of the shorter data set ends in time
        assert np.array_equal(path[:both], again[:both])
    assert len(drawn) == 2 and min(map(len, drawn)) > 50


@pytest.mark.parametrize(("seconds", "flies"), [(5, 5), (1.37, 1.37), (0.001, 1.0)])
def test_as_many_seconds_are_flown_as_are_asked_for_and_one_at_least(seconds, flies):
    flown = collect_flights(compose([*SHORT, f"collect.duration={seconds}"]))
    assert sum(float(flight.t[-1]) for flight in flown) == pytest.approx(flies, abs=0.021)  # one control period


def test_another_seed_draws_others(drawn):
    assert not np.array_equal(drawn[0][:20], paths("seed=1")[0][:20])


def test_the_configured_accelerometer_is_flown():
    """No MPC reads it: the flights are those without it, but for bias and noise of its readings."""
    given = ["sensor=lei_li", "sensor.accelerometer_bias=[1,-2,3]", "sensor.accelerometer_noise=[0.1,0.2,0.4]"]
    for exact, read in zip(*(collect_flights(compose([*SHORT, *more])) for more in ([], given)), strict=True):
        assert np.array_equal(exact.state, read.state)
        off = (read.stack(["acc_x", "acc_y", "acc_z"]) - exact.stack(["acc_x", "acc_y", "acc_z"]))[1:]
        assert off.mean(axis=0) == pytest.approx([1, -2, 3], abs=0.1)
        assert off.std(axis=0) == pytest.approx([0.1, 0.2, 0.4], rel=0.2)
