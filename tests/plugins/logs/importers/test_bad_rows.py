"""Repeated rows, outliers and a dead logger's line: refused with what mends it, left out or cut on request."""

import numpy as np
import pytest

from quadexp.log.schema import Flight
from quadexp.plugins.check.quality import check_flight
from quadexp.plugins.check.samples import check_dead
from tests.log.imitated import VEHICLES, imitated
from tests.models.recorded_data import blackbird, nanobench
from tests.plugins.check.faults import P, Q, V, at, changed
from tests.plugins.logs.importers.logs import imported


def taken(flight: Flight, share: float, seed: int) -> np.ndarray:
    rows = np.arange(10, len(flight) - 10)
    return np.random.default_rng(seed).choice(rows, int(share * len(flight)), replace=False)


def with_repeats(flight: Flight, share: float, seed: int = 0) -> Flight:
    """A logger that writes the row before again, with the time of now."""
    rows = np.arange(len(flight))
    for k in np.sort(taken(flight, share, seed)):
        rows[k] = rows[k - 1]
    return Flight({n: x if n == "t" else x[rows] for n, x in flight.columns.items()}, flight.metadata)


def with_outliers(flight: Flight, share: float, name: str, size: float, seed: int = 0) -> Flight:
    values = flight[name].copy()
    values[taken(flight, share, seed)] += size
    return Flight({**flight.columns, name: values}, flight.metadata)


def with_line(flight: Flight, start: float, end: float) -> Flight:
    """The state between two times as the interpolation over a loss has it."""
    columns = {key: values.copy() for key, values in flight.columns.items()}
    i, j = np.searchsorted(flight.t, [start, end])
    for name in (*P, *V, *Q):
        columns[name][i : j + 1] = np.interp(flight.t[i : j + 1], flight.t[[i, j]], columns[name][[i, j]])
    return Flight(columns, flight.metadata)


SPOILT = {
    "1 % repeated": (lambda f: with_repeats(f, 0.01), "duplicated_rows"),
    "4 % repeated": (lambda f: with_repeats(f, 0.04, 1), "duplicated_rows"),
    "2 % of acceleration": (lambda f: with_outliers(f, 0.02, "acc_x", 150.0), "acceleration_outlier"),
    "1 % of position": (lambda f: with_outliers(f, 0.01, "p_y", -1.0), "position_outlier"),
    "3 % of velocity": (lambda f: with_outliers(f, 0.03, "v_x", 6.0, 2), "velocity_outlier"),
    "a line of 2 s": (lambda f: with_line(f, 6.0, 8.0), "dead_logger"),
}


@pytest.mark.parametrize("case", [pytest.param(case, marks=[pytest.mark.slow] * (case[0] in "13")) for case in SPOILT])
def test_bad_rows_are_refused_dropped_or_gaps(tmp_path, case):
    spoil, name = SPOILT[case]
    truth = imitated(80, "torrente", duration=12)
    bad = spoil(truth)
    spoilt = np.any([bad[column] != truth[column] for column in (*P, *V, "acc_x")], axis=0)
    outcome, flight = imported(tmp_path, bad, vehicle="torrente")
    assert flight is None and name in outcome.cause
    assert any("--bad-rows" in one.advice for one in outcome.findings if one.blocks)
    for how in ("drop", "gap"):
        outcome, flight = imported(tmp_path, bad, vehicle="torrente", bad_rows=how)
        assert flight is not None, outcome.cause
        assert not [one.message for one in outcome.findings if one.blocks]
        assert flight.metadata["source"]["left_out"]["rows"][name] >= 0.9 * spoilt.sum()
        at = np.round(flight.t / 0.01).astype(int)
        kept = ~spoilt[at]
        for column in (*P, *V):
            apart = np.abs(flight[column] - truth[column][at])
            assert apart[kept].max() < 1e-7 and (apart.max() < (1e-9 if how == "gap" else 0.15) or kept.all())
        inside = np.diff(flight["segment"]) == 0
        assert np.allclose(np.diff(flight.t)[inside], 0.01, atol=1e-6)
        assert (flight["segment"][-1] > 0) == (how == "gap" or name == "dead_logger")


@pytest.mark.parametrize(("gyro", "seed"), [(True, 80), (False, 90)])
def test_a_row_is_bridged_across_a_change_of_sign(tmp_path, gyro, seed):
    """q and -q are one attitude: the bridge between them is the short one, and no good row beside it is left out."""
    truth = imitated(seed, "torrente", duration=15)
    bad = with_repeats(truth, 0.01, seed)
    spoilt = bad["p_x"] != truth["p_x"]
    after = np.flatnonzero(spoilt)[::5] + 1
    flipped = np.where(np.cumsum(np.isin(np.arange(len(truth)), after)) % 2, -1.0, 1.0)
    columns = {name: values * flipped if name in Q else values for name, values in bad.columns.items()}
    columns = {name: values for name, values in columns.items() if gyro or not name.startswith("w_")}
    outcome, flight = imported(tmp_path, Flight(columns, {}), bad_rows="drop")
    assert flight is not None, outcome.cause
    assert flight.metadata["source"]["left_out"]["rows"] == {"duplicated_rows": spoilt.sum()}
    dot = np.abs(np.sum(flight.stack(Q) * truth.stack(Q), axis=1))
    assert len(flight) == len(truth) and np.degrees(2 * np.arccos(np.minimum(dot, 1))).max() < 5


@pytest.mark.parametrize(
    ("vehicle", "start", "length"), [("crazyflie", 3.0, 0.8), ("torrente", 6.5, 2.0), ("lei_li", 4.4, 1.3)]
)
def test_the_line_is_named_with_its_time(vehicle, start, length):
    flight = with_line(imitated(81, vehicle, duration=15), start, start + length)
    (found,) = [one for one in check_flight(flight) if one.name == "dead_logger"]
    assert found.blocks and found.span == pytest.approx((start, start + length), abs=0.03)


def test_a_frozen_state_is_named_too():
    flight = changed(at([*P, *V, *Q], slice(500, 700)), imitated(85, "torrente", duration=15))
    found = {one.name: one for one in check_flight(flight)}
    assert found["dead_logger"].span == pytest.approx((5.0, 7.0), abs=0.03)


@pytest.mark.parametrize(
    "name", ["B2_circle_fast_rep2", "B9_trefoil_slow_rep12", "B3_figure8_fast_rep1", "train", "test"]
)
def test_real_flights_hold_no_line_but_one_put_there(name):
    flight = blackbird(name) if name in ("train", "test") else nanobench(name)
    for one, expected in ((flight, 0.0), (with_line(flight, 4.0, 6.0), 2.0)):
        streams = {"p": one.stack(P), "v": one.stack(V), "q": one.stack(Q)}
        found, mask = check_dead(streams, one.t)
        assert len(found) == (expected > 0) and mask.sum() * np.median(np.diff(one.t)) == pytest.approx(
            expected, abs=0.05
        )


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_smooth_simulated_flights_hold_no_line(vehicle):
    flight = imitated(86, vehicle, noise=0.0, busy=0.0)
    assert not check_dead({"p": flight.stack(P), "v": flight.stack(V)}, flight.t)[0]


def test_too_many_bad_rows_are_not_left_out(tmp_path):
    outcome, flight = imported(tmp_path, with_repeats(imitated(87, "torrente", duration=10), 0.3), bad_rows="drop")
    assert flight is None and any("20% is the most" in note for note in outcome.notes)


def test_pasted_rows_are_found_whatever_column_is_first():
    flight = imitated(91, "torrente", duration=15)
    rows = np.arange(len(flight))
    rows[900:1200] = rows[300:600]
    columns = {"status": np.zeros(len(flight)), **{n: x if n == "t" else x[rows] for n, x in flight.columns.items()}}
    (found,) = [one for one in check_flight(Flight(columns, {})) if one.name == "duplicated_rows"]
    assert found.blocks and found.span == pytest.approx((9.0, 12.0), abs=0.03)
