"""Damaged files: a changed bit or a missing byte ends in the right data or in a clear line, never in other data."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from quadexp.errors import QuadexpError
from quadexp.flight.schema import Flight
from quadexp.flight.store import read_flight, write_flight
from quadexp.identify.checkpoint import MODEL_FILE, load_model, save_model
from quadexp.identify.linear_drag import LinearDrag
from quadexp.state import STATE_COLUMNS, input_columns

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
    with pytest.raises(QuadexpError, match="damaged, or no model of quadexp"):
        load_model(tmp_path / "m")
    (tmp_path / "b.parquet").write_text('{"kind": "linear_drag"}')
    with pytest.raises(QuadexpError, match="not a Parquet file, or damaged"):
        read_flight(tmp_path / "b.parquet")
