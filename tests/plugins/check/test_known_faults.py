"""Faults of a known size in flights of known truth: scales, headings, angles, biases, late streams, clocks."""

from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight
from quadexp.plugins.check.quality import check_flight
from quadexp.plugins.logs.signal import Stream
from quadexp.plugins.logs.signal.offset import aligned, find_offsets
from tests.log.imitated import imitated
from tests.plugins.check.faults import put, take
from tests.slow import slow

P, V, W, F, Q = (
    [f"{name}_{axis}" for axis in axes]
    for name, axes in (("p", "xyz"), ("v", "xyz"), ("w", "xyz"), ("acc", "xyz"), ("q", "wxyz"))
)
STREAMS = {"position": P, "velocity": V, "rate": W, "acceleration": F, "attitude": Q}


@pytest.fixture(scope="module")
def flight():
    return imitated(5, duration=50)


def with_columns(flight, names, values):
    columns = {key: x.copy() for key, x in flight.columns.items()}
    put(columns, names, values)
    return Flight(columns, flight.metadata)


def named(flight):
    return [one for one in check_flight(flight) if one.severity != "info"]


def late(flight, names, seconds):
    """The streams as they were `seconds` (a number, or (k,)) before."""
    t, columns = flight.t, {key: x.copy() for key, x in flight.columns.items()}
    for key in names:
        columns[key] = np.interp(t - seconds, t, flight[key])
    inner = (t > 0.5) & (t < t[-1] - 0.5)  # where there is something before
    return Flight({key: x[inner] for key, x in columns.items()}, flight.metadata)


def test_nothing_is_found_in_the_flight_itself(flight):
    assert not named(flight)


@pytest.mark.parametrize("factor", [0.9, 8.0, *slow(0.5, 1.1, 2.0, 5.0)])
@pytest.mark.parametrize(("names", "key"), [(W, "rate"), (F, "acceleration")])
def test_a_scale_is_named_with_its_size(flight, names, key, factor):
    (found,) = named(with_columns(flight, names, factor * take(flight.columns, names)))
    assert found.name == "scale" and found.blocks
    assert found.correction[key]["scale"] == pytest.approx(1 / factor, rel=0.02)


@pytest.mark.parametrize("degrees", [5.0, 90.0, *slow(-30.0)])
def test_a_heading_against_the_motion(flight, degrees):
    q = Rotation.from_quat(take(flight.columns, Q), scalar_first=True)
    turned = Rotation.from_euler("z", degrees, degrees=True) * q
    found = named(with_columns(flight, Q, turned.as_quat(scalar_first=True)))
    assert [one.name for one in found] == ["heading"] and found[0].blocks == (abs(degrees) > 8)
    assert found[0].correction["attitude"]["turn"] == pytest.approx(-degrees, abs=0.7)


# One angle and two; the pitch is among those whose sign programs differ in.
SIGNS = [(1, -1, 1), (-1, -1, 1), *slow(((-1, 1, 1),), ((1, 1, -1),), ((1, -1, -1),))]


@pytest.mark.parametrize("signs", SIGNS)
def test_signs_of_angles(flight, signs):
    angles = Rotation.from_quat(take(flight.columns, Q), scalar_first=True).as_euler("ZYX") * signs[::-1]
    found = named(with_columns(flight, Q, Rotation.from_euler("ZYX", angles).as_quat(scalar_first=True)))
    assert [one.name for one in found] == ["sign_flip"]
    assert found[0].correction["attitude"]["angles"] == list(signs)


@pytest.mark.parametrize(("names", "bias"), [(W, [0.1, 0.0, -0.06]), (F, [0.0, 1.2, -0.8])])
def test_a_bias(flight, names, bias):
    (found,) = named(with_columns(flight, names, take(flight.columns, names) + bias))
    ((_, lines),) = found.correction.items()
    assert found.name == "bias" and lines["offset"] == pytest.approx(bias, abs=0.25 * np.abs(bias).max())


WHICH = (("position",), ("position", "velocity"), ("attitude",), ("rate", "acceleration"))
DRIFTS = (0.0, 0.002, 0.005, -0.002)
EACH_ONCE = [*zip(WHICH, (0.005, 0.0, -0.002, 0.002), strict=True)]  # every set of streams, and every drift
OTHERS = [case for case in product(WHICH, DRIFTS) if case not in EACH_ONCE]


@pytest.mark.parametrize(("which", "drift"), [*EACH_ONCE, *slow(*OTHERS)])
def test_late_and_drifting_streams_are_named_and_mended(flight, which, drift):
    """60 ms at the middle of the flight; what is left after the alignment is that of the flight itself."""
    names = [column for stream in which for column in STREAMS[stream]]
    wrong = late(flight, names, 0.06 + drift * (flight.t - flight.t.mean()))
    t = wrong.t
    found = named(wrong)
    assert found and {one.name for one in found} == {"clock_drift" if drift else "time_offset"}
    streams = {key: Stream(t, wrong.stack(columns)) for key, columns in STREAMS.items()}
    mended = aligned(streams, find_offsets(streams))
    for key, stream in mended.items():
        lag = stream.t - t + (0.06 + drift * (t - t.mean()) if key in which else 0.0)
        assert np.abs(lag - lag.mean()).max() < (0.012 if drift else 0.003)  # no clock drifts any more
    rest = find_offsets({key: Stream(x.t, x.values) for key, x in mended.items()})
    assert all(abs(one.seconds) < 0.012 for one in rest.values() if one.certain)
