"""An hour of log: what is identified is right, and the commands take little memory."""

import json
import os
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from quadexp.log import store
from quadexp.log.store import read_table, write_flight
from quadexp.models.checkpoint import load_model
from quadexp.models.dataset import BATCH, evaluate_rows
from tests.models.logged_flights import CURVE, DRAG, logged_flight

ROOT = Path(__file__).resolve().parents[2]
MOST = 1.0  # GB


@pytest.mark.parametrize("rows", [0, 1, 7, BATCH, BATCH + 1, 2 * BATCH + 3])
def test_a_function_of_rows_is_that_of_every_row_to_the_last_bit(rng, rows):
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u", 2)
    function = ca.Function("f", [x, u], [ca.vertcat(ca.sin(x) * u[0], ca.sqrt(u[1] ** 2 + ca.dot(x, x)))])
    given = rng.standard_normal((rows, 3)), rng.standard_normal((rows, 2))
    found = np.full((rows, 4), np.nan)
    evaluate_rows(function, given, found)
    expected = function(given[0].T, given[1].T).full().T if rows else found
    np.testing.assert_array_equal(found, expected)


def test_a_table_that_is_read_column_by_column_is_the_same(tmp_path, monkeypatch):
    path = write_flight(tmp_path / "a.parquet", logged_flight(0, rate=50))
    whole, record = read_table(path, "flight")
    monkeypatch.setattr(store, "LONG", 10)
    again, same = read_table(path, "flight")
    assert same == record and list(again) == list(whole)
    for name in whole:
        np.testing.assert_array_equal(again[name], whole[name])


def test_a_long_table_that_was_edited_is_refused(tmp_path, monkeypatch):
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = write_flight(tmp_path / "a.parquet", logged_flight(0, rate=50))
    table = pq.read_table(path)
    values = table.column("v_x").to_numpy().copy()
    values[3] += 1e-9
    place = table.column_names.index("v_x")
    pq.write_table(table.set_column(place, table.field("v_x"), pa.array(values)), path)
    monkeypatch.setattr(store, "LONG", 10)
    with pytest.raises(store.DataError, match="its columns do not match their hash"):
        read_table(path, "flight")


# VmHWM is of the program alone; ru_maxrss begins with what the process that started it had.
USED = """
import sys
from quadexp.cli.app import main
sys.argv = ["quadexp", *sys.argv[1:]]
try: main()
except SystemExit as end: assert not end.code, end.code
lines = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(int(lines["VmHWM"].split()[0]) * 1024 / 1e9, file=sys.stderr)
"""


def used(*words):
    """GB that a command takes at most."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", USED, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment)
    assert done.returncode == 0, done.stderr
    return float(done.stderr.splitlines()[-1])


@pytest.mark.slow
def test_an_hour_at_250_hz_takes_less_than_a_gigabyte(tmp_path):
    log = write_flight(tmp_path / "hour.parquet", logged_flight(0, seconds=3600, rate=250))
    model = tmp_path / "model"
    assert used("identify", log, "--out", model) < MOST
    rows = json.loads((model / "report.json").read_text())["models"]["linear"]
    found = {row["axis"]: row for row in rows if row["term"] == "linear"}
    for axis, true in zip("xyz", DRAG, strict=True):
        assert found[axis]["value"] == pytest.approx(true, rel=0.01)
    np.testing.assert_allclose(load_model(model).thrust.coefficients, CURVE, rtol=0.02)
    data = tmp_path / "data.parquet"
    assert used("collect", "--flight", log, "--out", data, f"collect.identified={model}") < MOST
