"""Flights of which a sample every evaluate.log_period is stored: they say so, are refused where samples are
differentiated, and show the errors of the table."""

import numpy as np
import pytest

from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_flight
from quadexp.parts.compose import expand
from quadexp.report.metrics import mean_error, position_error
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.cli.command import run

CELLS = ["trajectory=random", "trajectory.speed=6", "controller=nominal_mpc,perfect_mpc", "controller.rate=60"]


def fly(out, period):
    return run_sweep(expand([*CELLS, f"evaluate.log_period={period}"]), out, SweepRequest(isolate=False))


def flights(out, rows):
    return [read_flight(CellStore(out).path(row["key"])) for row in rows]


@pytest.fixture(scope="module")
def thinned(tmp_path_factory):
    out = tmp_path_factory.mktemp("sweep") / "results"
    return out, fly(out, 0.11)


def test_it_says_so_and_shows_the_errors_of_the_table(thinned):
    from quadexp.plugins.page.report.sections import Page, worst_section
    from quadexp.plugins.page.report.source import read_comparison

    out, result = thinned
    whole = fly(out.parent / "whole", 0).rows
    for row, other, flight in zip(result.rows, whole, flights(out, result.rows), strict=True):
        assert flight.metadata["thinned"] == pytest.approx({"log_period": 0.11, "control_period": 1 / 60})
        assert np.diff(flight.t) == pytest.approx(7 / 60)
        assert row["max_error"] == other["max_error"] > position_error(flight).max()
        assert mean_error(flight) == row["mean_error"] != pytest.approx(position_error(flight).mean(), rel=1e-9)
    table = worst_section(Page(read_comparison(out), None, None, "", ())).blocks[0].tables["worst"]
    largest = [float(line[2].text.removesuffix(" mm")) for line in table.rows]
    assert sorted(largest) == pytest.approx(sorted(1e3 * r["max_error"] for r in whole), rel=5e-3)


@pytest.mark.parametrize(
    "command",
    [
        ["collect", "--out", "OUT", "--flight", "FLIGHT"],
        ["identify", "FLIGHT", "--method", "delays"],
        ["identify", "FLIGHT", "--method", "regression", "--out", "OUT"],
        ["identify", "FLIGHT", "--method", "rls", "--out", "OUT"],
        ["check", "FLIGHT"],
        ["animate", "FLIGHT", "--out", "OUT.gif"],
    ],
    ids=" ".join,
)
def test_what_needs_every_instant_refuses_it(thinned, tmp_path, command):
    path = str(CellStore(thinned[0]).path(thinned[1].rows[0]["key"]))
    words = [word.replace("FLIGHT", path).replace("OUT", str(tmp_path / "made")) for word in command]
    code, _, error = run(*words)
    error = error.splitlines()[-1]
    assert code == 1 and path in error
    assert "every 0.11 s" in error and "every 0.0166667 s" in error and "evaluate.log_period=0" in error
    assert not any(tmp_path.iterdir())


def test_a_run_recalls_what_holds_the_samples_it_asks_for(thinned):
    out, result = thinned
    flown = [(period, fly(out, period).flown) for period in (0.11, 0.5, 0.05, 0.11, 0, 0.11, 0)]
    assert flown == [(0.11, 0), (0.5, 0), (0.05, 2), (0.11, 0), (0, 2), (0.11, 0), (0, 0)]
    assert all("thinned" not in flight.metadata for flight in flights(out, result.rows))
