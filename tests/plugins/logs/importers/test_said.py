"""What an import says: once for all streams of a clock, and with the unit of a time that cannot be in seconds."""

import numpy as np
import pytest

from quadexp.plugins.logs.importers import said_once
from quadexp.plugins.logs.importers.raw import without_repeats
from quadexp.plugins.logs.signal import Stream
from tests.log.imitated import imitated
from tests.plugins.logs.importers.logs import MAPPING, imported


def test_streams_of_one_clock_say_it_once():
    notes = ["position (x, y): 3 of 9 rows repeat", "attitude (q): 3 of 9 rows repeat", "rate (w): 1 of 9 rows repeat"]
    assert said_once(notes) == ["position, attitude: 3 of 9 rows repeat", "rate (w): 1 of 9 rows repeat"]
    assert said_once(["never moves", "left out: 3 rows"]) == ["never moves", "left out: 3 rows"]


@pytest.mark.parametrize(("unit", "factor"), [("ns", 1e9), ("us", 1e6)])
def test_a_time_that_is_not_in_seconds_names_its_unit(tmp_path, unit, factor):
    """UNIX time, of rows every 10 ms, under a mapping that says nothing of the unit."""
    flight = imitated(5, duration=4)
    flight.columns["t"] = np.round((flight["t"] + 1.7e9) * factor)
    outcome, _ = imported(tmp_path, flight, MAPPING)
    assert f"`unit: {unit}` under `time:`" in outcome.cause and "100 Hz" in outcome.cause


def test_a_pose_that_a_table_repeats_until_the_next_one_comes_has_its_own_clock(rng):
    """20 Hz in rows of 100 Hz; the vehicle stands for a second, which is no gap."""
    t = np.arange(2000) / 100
    slow = rng.normal(size=(400, 3))
    slow[100:120] = slow[100]
    notes = []
    found = without_repeats("position", Stream(t, np.repeat(slow, 5, axis=0)), notes)
    assert np.array_equal(found.t, t[::5]) and np.array_equal(found.values, slow)
    assert notes == ["position: each value stands for 5 rows: taken as a stream of 20 Hz"]


def test_repeats_of_a_coarse_sensor_stay(rng):
    """Steps of 0.5 m: two rows alike are two readings."""
    stream = Stream(np.arange(2000) / 100, np.round(2 * np.cumsum(0.3 * rng.normal(size=(2000, 1)), axis=0)) / 2)
    assert without_repeats("position", stream, []) is stream
