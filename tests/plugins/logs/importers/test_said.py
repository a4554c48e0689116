"""What an import says: once for all streams of a clock, and with the unit of a time that cannot be in seconds."""

import numpy as np
import pytest

from quadexp.plugins.logs.importers import said_once
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
