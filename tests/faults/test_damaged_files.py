"""Damaged files: a changed bit or a missing byte ends in the right data or in a clear line, never in other data."""

import os
import shutil

import numpy as np
import pytest

from quadexp.errors import DataError, QuadexpError, UsageError
from quadexp.experiment.collect import collect_dataset
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, write_flight
from quadexp.models.checkpoint import MODEL_FILE, load_model, load_report, save_model
from quadexp.models.linear_drag import LinearDrag
from quadexp.parts.compose import compose
from quadexp.physics.state import STATE_COLUMNS, input_columns
from quadexp.plugins.identification.identify import identify_files, read_recorded

TRIES = 300


@pytest.fixture
def damages(rng):
    """Copies of some bytes, each with one bit changed or with its end missing."""

    def make(content):
        for _ in range(TRIES):
            damaged = bytearray(content)
            if rng.random() < 0.3:
                damaged = damaged[: rng.integers(len(damaged))]
            else:
                damaged[rng.integers(len(damaged))] ^= 1 << int(rng.integers(8))
            yield bytes(damaged)

    return make


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def test_a_flight(tmp_path, rng, damages):
    names = ("t", *STATE_COLUMNS, *input_columns(4))
    columns = {name: rng.normal(size=120) for name in names} | {"status": np.zeros(120, np.int8)}
    path = write_flight(tmp_path / "a.parquet", Flight(columns, {"outcome": "ok", "config": {"mass": 1.25}}))
    whole, refused = read_flight(path), 0
    content = path.read_bytes()
    for damaged in damages(content):
        path.write_bytes(damaged)
        try:
            found = read_flight(path)
        except QuadexpError as error:
            assert str(path) in str(error) and "\n" not in str(error)
            refused += 1
            continue
        assert found.metadata == whole.metadata
        assert list(found.columns) == list(whole.columns)
        assert all(np.array_equal(found[name], whole[name]) for name in whole.columns)
    assert refused > 0.8 * TRIES  # the rest changed what nobody reads, such as statistics of a column


def test_a_checkpoint(tmp_path, rng, damages):
    three = lambda: rng.normal(size=3)  # noqa: E731
    model = LinearDrag(three(), three(), 0.1, three(), three(), 0.01, three(), three(), 99)
    folder = save_model(tmp_path / "model", model)
    file, refused = folder / MODEL_FILE, 0
    content = file.read_bytes()
    for damaged in damages(content):
        file.write_bytes(damaged)
        try:
            found = load_model(folder)
        except QuadexpError as error:
            assert "\n" not in str(error)
            refused += 1
            continue
        np.testing.assert_array_equal(found.parameters, model.parameters)
    assert refused > 0.9 * TRIES


def test_a_flight_under_a_checkpoint_s_name_and_the_reverse(tmp_path, rng):
    columns = {name: rng.normal(size=9) for name in ("t", *STATE_COLUMNS, *input_columns(4))}
    flight = write_flight(tmp_path / "a.parquet", Flight(columns, {}))
    (tmp_path / "m").mkdir()
    shutil.copy(flight, tmp_path / "m" / MODEL_FILE)
    with pytest.raises(QuadexpError, match="damaged, or not a model of quadexp"):
        load_model(tmp_path / "m")
    (tmp_path / "b.parquet").write_text('{"kind": "linear_drag"}')
    with pytest.raises(QuadexpError, match="not a Parquet file, or damaged"):
        read_flight(tmp_path / "b.parquet")


def test_a_checkpoint_nested_beyond_reason(tmp_path):
    for name in (MODEL_FILE, "report.json"):
        (tmp_path / name).write_text("[" * 200_000)
    with pytest.raises(QuadexpError, match="damaged, or not a model"):
        load_model(tmp_path)
    with pytest.raises(QuadexpError, match="damaged"):
        load_report(tmp_path)


def test_what_a_killed_process_left(tmp_path, rng):
    """It is removed by the next one that writes a model there, a day later: until then its writer may be at work."""
    left, young = (tmp_path / f".quadexp-{digit * 16}.tmp" for digit in "12")
    for folder in (left, young):
        folder.mkdir()
        (folder / MODEL_FILE).write_text("half")
    os.utime(left, (0, 0))
    three = lambda: rng.normal(size=3)  # noqa: E731
    model = LinearDrag(three(), three(), 0.1, three(), three(), 0.01, three(), three(), 99)
    np.testing.assert_array_equal(load_model(save_model(tmp_path / "model", model)).parameters, model.parameters)
    assert {path.name for path in tmp_path.iterdir()} == {"model", young.name}


def test_a_flight_that_is_given_twice(tmp_path, rng):
    """Its rows would be fitted while they are held out, and the report would praise the fit."""
    columns = {name: rng.normal(size=9) for name in ("t", *STATE_COLUMNS, *input_columns(4))}
    flight = write_flight(tmp_path / "a.parquet", Flight(columns, {}))
    (tmp_path / "b").mkdir()
    (tmp_path / "link.parquet").symlink_to(flight)
    other = write_flight(tmp_path / "b" / "a.parquet", Flight(columns, {}))
    config, out = compose([]), tmp_path / "r.parquet"
    with pytest.raises(UsageError, match="given twice"):
        collect_dataset(config, out, flights=[flight, tmp_path / "link.parquet"])
    with pytest.raises(UsageError, match="two flights named a"):
        collect_dataset(config, out, flights=[flight, other], save_flights=tmp_path / "flights")
    assert not out.exists()


@pytest.mark.parametrize("fault", ["goes back", "stands still", "is reversed"])
def test_time_that_does_not_go_on(tmp_path, fault):
    """Derivatives over such rows would be learned as air."""
    t = 0.02 * np.arange(200)
    t = {"goes back": np.where(t > 2, t - 1, t), "stands still": np.minimum(t, 2), "is reversed": t[::-1]}[fault]
    columns = {name: np.ones(200) for name in (*STATE_COLUMNS, *input_columns(4))} | {"t": t}
    path = write_flight(tmp_path / "a.parquet", Flight(columns, {"recorded": True}))
    for learn in (
        lambda: collect_dataset(compose([]), tmp_path / "r.parquet", flights=[path]),
        lambda: read_recorded(path),
        lambda: identify_files([path], tmp_path / "e"),
    ):
        with pytest.raises(DataError, match="time does not go on from row"):
            learn()


def test_a_quaternion_of_zeros(tmp_path):
    """What a log has before its estimator has an answer."""
    columns = {name: np.ones(9) for name in (*STATE_COLUMNS, *input_columns(4))} | {"t": np.arange(9.0)}
    for axis in "wxyz":
        columns[f"q_{axis}"][4] = 0.0
    path = write_flight(tmp_path / "a.parquet", Flight(columns, {"recorded": True}))
    for read in (read_flight, read_recorded):
        with pytest.raises(DataError, match="quaternion is zero at row 4"):
            read(path)
    assert len(read_flight(path, check=False)) == 9
