"""The numbers of a part of a flight, or of one that was changed, are those of its own samples."""

import numpy as np
import pandas as pd
import pytest

import quadexp as qx
from quadexp.log.store import read_flight
from quadexp.report.metrics import position_error
from tests.cli.command import run


@pytest.fixture(scope="module")
def flight():
    return qx.simulate("controller=pid", "trajectory=circle", speed=3, seed=1)


PARTS = {
    "the beginning": lambda f: f[f["t"] < 1],
    "head and tail": lambda f: pd.concat([f.head(40), f.tail(20)]),
    "thinned": lambda f: f.iloc[::7],
    "sorted by another column": lambda f: f.sort_values("p_x"),
    "filtered by another column": lambda f: f[f["v_x"] > 0],
    "changed": lambda f: f.assign(p_x=f["p_x"] + 1),
    "axes renamed": lambda f: f.rename(columns={"p_x": "p_y", "p_y": "p_x"}),
    "twice": lambda f: pd.concat([f, f]),
    "whole": lambda f: f,
}


@pytest.mark.parametrize("part", PARTS)
def test_numbers_are_of_the_samples_that_are_there(flight, tmp_path, part):
    kept = PARTS[part](flight)
    path = kept.save(tmp_path / "part.parquet")
    error = np.linalg.norm([kept[f"p_{i}"] - kept[f"ref_p_{i}"] for i in "xyz"], axis=0)
    stored = read_flight(path)
    for row in (kept.metrics, stored.metadata["row"]):
        assert row["mean_error"] == pytest.approx(error.mean()) and row["max_error"] == pytest.approx(error.max())
        assert row["duration"] == pytest.approx(kept["t"].max() - kept["t"].min())
        assert row["peak_speed"] == pytest.approx(np.linalg.norm([kept[f"v_{i}"] for i in "xyz"], axis=0).max())
    assert np.all(np.diff(stored.t) >= 0) and position_error(stored).mean() == pytest.approx(error.mean())
    code, out, err = run("show", path)
    assert code == 0, err
    assert f"flight      {stored.t[-1] - stored.t[0]:.2f} s" in out and f"mean {1e3 * error.mean():.4g} mm" in out
    assert run("export", path, "--to", "csv", "--out", tmp_path / "a.csv")[0] == 0


def test_a_whole_flight_keeps_its_record_to_the_last_bit(flight):
    assert flight.assign(mine=1.0).metrics["mean_error"] == flight.metrics["mean_error"]
    assert flight.copy().record == flight.record


def test_a_part_is_compared_as_it_is(flight, tmp_path):
    flight.save(tmp_path / "a.parquet")
    flight[flight["t"] < 1].save(tmp_path / "b.parquet")
    code, out, err = run("compare", tmp_path / "a.parquet", tmp_path / "b.parquet", "--json")
    assert code == 0, err
    assert '"duration"' in out and f"{flight[flight['t'] < 1].metrics['duration']}" in out


def test_without_the_reference_there_are_no_numbers(flight, tmp_path):
    kept = flight[["t", "p_x", "p_y", "p_z"]]
    assert kept.metrics == {}
    out = run("show", kept.save(tmp_path / "a.parquet"))[1]
    assert "error       mean" not in out and f"{len(kept)} rows" in out


def test_two_flights_together_are_none(flight, tmp_path):
    other = qx.simulate("controller=geometric", "trajectory=hover", duration=1)
    together = pd.concat([flight, other])
    assert together.metrics == {}
