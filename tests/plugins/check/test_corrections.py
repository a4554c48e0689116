"""What check prints mends the import: a fault goes into a sound log, its correction into the mapping, and all is well.

The fault of a candidate is the inverse of its correction, found numerically: every one of them is affine in the values
of a stream. The correction takes the way of a user back: through the printed text, the YAML reader and the importer.
"""

import re
from collections.abc import Callable

import numpy as np
import pytest
import yaml

from quadexp.log.schema import Flight
from quadexp.plugins.check.candidates import Candidate, candidates, clock_candidate, flow, scale_candidates
from quadexp.plugins.logs.signal.windows import STREAMS, Windows
from tests.log.imitated import imitated
from tests.plugins.check.faults import FRD, NED, P, V, W, inject, put, take
from tests.plugins.logs.importers.logs import MAPPING, imported

EVERY = [
    *candidates(frozenset("pqvwf")),
    *map(clock_candidate, (1e3, 1.05, 0.5)),  # microseconds are refused by the import itself
    *scale_candidates(1.3, "vp"),
]
TURNS = [one for one in EVERY if one.fault in ("axis_swap", "sign_flip", "z_down") and one.streams != "q"]
# One of every fault and stream; all of them are in the slow test.
OTHERS = list({(one.fault, one.streams): one for one in EVERY if one not in TURNS}.values())


def named(one: Candidate) -> str:
    return f"{one.fault}-{one.streams}-{one.text}"


def broken(flight: Flight, one: Candidate) -> Flight:
    """The flight that the hypothesis's transformation makes this one of."""
    columns = {key: values.copy() for key, values in flight.columns.items()}
    streams = {name: flight.stack(names)[None] for name, names in STREAMS.items()}
    t = flight.t[None]
    if one.streams == "t":
        gain = t[0, -1] / one.apply(Windows(t, streams)).t[0, -1]
        return Flight({**columns, "t": gain * columns["t"]}, flight.metadata)
    fixed = {name: values for name, values in streams.items() if name not in one.streams}
    for name in one.streams:
        width = streams[name].shape[-1]
        # of vectors, the attitude as it is found may be made use of
        beside = fixed | {"q": streams["q"]}

        def made(x: np.ndarray, name: str = name, beside: dict = beside) -> np.ndarray:
            probe = {key: beside.get(key, np.zeros_like(values)) for key, values in streams.items()}
            probe[name] = np.broadcast_to(x, streams[name].shape).copy()
            return one.apply(Windows(t, probe)).streams[name][0]

        offset = made(np.zeros(width)) if name != "q" else 0.0
        matrix = np.stack([made(axis) - offset for axis in np.eye(width)], axis=-1)
        put(columns, list(STREAMS[name]), np.linalg.solve(matrix, (streams[name][0] - offset)[..., None])[..., 0])
    return Flight(columns, flight.metadata)


def blocking(folder, flight: Flight, mapping: str = MAPPING) -> list:
    return [one for one in imported(folder, flight, mapping)[0].findings if one.blocks]


def printed(message: str) -> list[dict]:
    """The lines of a mapping that a finding's message has, one dict each."""
    return [yaml.safe_load(line) for line in re.findall(r"`([^`]*)`", message.split("correct the mapping")[1])]


def corrected(mapping: str, findings: list) -> str:
    """The mapping with the printed lines under `corrections`, those of one finding together."""
    steps = [{key: value for line in printed(one.message) for key, value in line.items()} for one in findings]
    assert steps == [one.correction for one in findings]
    return f"{mapping}\ncorrections: {flow(steps)}\n"


def mends(folder, flight: Flight, one: Candidate, change: Callable[[str, list], str] = corrected) -> None:
    wrong = broken(flight, one)
    found = [x for x in blocking(folder, wrong) if x.correction]  # the others are symptoms, and go
    assert found, "not noticed"
    outcome, mended = imported(folder, wrong, change(MAPPING, found))
    assert mended is not None, ([x.message for x in found], outcome.lines())
    if [x.correction for x in found] == [one.correction]:
        for names in STREAMS.values():
            np.testing.assert_allclose(mended.stack(names), flight.stack(names), atol=3e-3)


@pytest.fixture(scope="module")
def flights():
    return [imitated(seed, vehicle, duration=12) for vehicle, seed in (("torrente", 300), ("crazyflie", 301))]


@pytest.mark.parametrize("one", OTHERS[::2], ids=named)
def test_the_printed_correction_mends_the_import(flights, tmp_path, one):
    mends(tmp_path, flights[0], one)


@pytest.mark.parametrize("k", range(2))
def test_so_do_those_of_axes(flights, tmp_path, k):
    """Axes swapped and reversed, drawn at random, on two vehicles."""
    for i in np.random.default_rng(k).choice(len(TURNS), 2, replace=False):
        mends(tmp_path, flights[k], TURNS[i])


@pytest.mark.slow
@pytest.mark.parametrize("one", EVERY, ids=named)
def test_every_candidate_on_one_of_three_vehicles(tmp_path, one):
    k = EVERY.index(one) % 3
    mends(tmp_path, imitated(310 + k, ("blackbird", "lei_li", "crazyflie")[k], duration=12), one)


def test_lines_that_the_mapping_has_not_are_its_own(flights, tmp_path):
    """Where the mapping says nothing of a key yet, the printed lines may as well be put into it as they stand."""

    def in_place(mapping: str, findings: list) -> str:
        made = yaml.safe_load(mapping)
        for one in findings:
            for key, value in ((key, value) for lines in printed(one.message) for key, value in lines.items()):
                made[key] = {**made.get(key, {}), **value} if isinstance(value, dict) else value
        return flow(made)

    for one in OTHERS[1::14]:
        mends(tmp_path, flights[1], one, in_place)


def test_a_late_sensor_is_moved_by_the_option_that_is_offered(flights, tmp_path):
    late = inject(flights[0], "imu_50_ms_late")
    found = [one for one in imported(tmp_path, late)[0].findings if one.severity != "info"]
    assert {one.name for one in found} == {"time_offset"} and "`import --align`" in found[0].advice
    left = imported(tmp_path, late, align=True)[0].findings
    assert not [one.message for one in left if one.severity != "info"]


def test_two_faults_under_a_mapping_with_frames_and_units(flights, tmp_path):
    """The mapping knows that the log is in NED, FRD and degrees a second; it knows nothing of g and a flipped y."""
    columns = {key: values.copy() for key, values in flights[0].columns.items()}
    for names, matrix, factor in ((P, NED, 1), (V, NED, 1), (W, FRD, 180 / np.pi)):
        put(columns, names, factor * take(columns, names) @ matrix.T)
    acc = ["acc_x", "acc_y", "acc_z"]
    put(columns, acc, take(columns, acc) @ FRD * [1, -1, 1] / 9.80665)
    words = MAPPING.replace("v_z]}", "v_z], frame: NED}").replace("p_z]}", "p_z], frame: NED}")
    words = words.replace("w_z]}", "w_z], frame: FRD, unit: deg/s}").replace("acc_z]}", "acc_z], frame: FRD}")
    wrong = Flight(columns, flights[0].metadata)
    found = blocking(tmp_path, wrong, words)
    assert {one.name for one in found} == {"units", "sign_flip"}
    _, mended = imported(tmp_path, wrong, corrected(words, found))
    for names in STREAMS.values():
        np.testing.assert_allclose(mended.stack(names), flights[0].stack(names), atol=1e-5)
