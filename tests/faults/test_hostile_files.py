"""Files made to harm: a few kilobytes that fill the memory, models that are none, names that a terminal would obey."""

import copy
import hashlib
import json
import os
import pty
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from quadexp.errors import DataError
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, read_table, write_flight, write_table
from quadexp.messages import clean
from quadexp.models.checkpoint import MODEL_FILE, load_model, load_report, save_model
from quadexp.physics.state import STATE_COLUMNS, input_columns
from quadexp.plugins.gaussian_process.gaussian_process import GPConfig, fit_gp
from quadexp.plugins.logs.importers.table import open_table
from tests.faults.command import ROOT, START, apart, one_line, run
from tests.models.by_hand import make_checkpoint
from tests.models.synthetic import synthetic_dataset

MEMORY = """
import atexit
def peak():
    line = next(line for line in open("/proc/self/status") if line.startswith("VmHWM"))
    open({path!r}, "w").write(line.split()[1])
atexit.register(peak)
"""
LIMIT = 500_000  # kB


def flight(rows=9, **metadata):
    columns = {name: np.ones(rows) for name in (*STATE_COLUMNS, *input_columns(4))} | {"t": 0.01 * np.arange(rows)}
    return Flight(columns, {"outcome": "ok", **metadata})


def declaring(path, like, rows, groups):
    """A file with the columns and the record of `like` that declares groups * rows rows: a dictionary of one value and
    runs of its index are all there is."""
    schema = pq.read_schema(like)
    zeros = pa.array(np.zeros(rows, np.int32))
    values = ["x" * 20 if pa.types.is_string(field.type) else 1 for field in schema]
    shared = [pa.array([value], field.type) for value, field in zip(values, schema, strict=True)]
    table = pa.table(
        {f.name: pa.DictionaryArray.from_arrays(zeros, one) for f, one in zip(schema, shared, strict=True)}
    )
    with pq.ParquetWriter(path, table.schema, store_schema=False, compression="zstd") as writer:
        for _ in range(groups):
            writer.write_table(table, row_group_size=rows)
        writer.add_key_value_metadata(schema.metadata)
    assert pq.read_schema(path).types == schema.types
    return path


@pytest.fixture(scope="module")
def bombs(tmp_path_factory):
    """Small files that declare 96 million rows (a flight), or 40 million of several columns."""
    folder = tmp_path_factory.mktemp("bombs")
    record = {"outcome": "ok", "recorded": True}
    made = {}
    for kind, columns in (
        ("flight", {"t": np.arange(3.0)}),
        ("residuals", {"flight": np.zeros(3, int), "v_x": np.ones(3)}),
        ("results", {"key": np.array(["a"] * 3, object), "mean_error": np.ones(3)}),
    ):
        like = write_table(folder / "like.parquet", columns, record, kind)
        made[kind] = declaring(folder / f"{kind}.parquet", like, 8_000_000, 12 if kind == "flight" else 5)
    return made


READS = {  # what reads each of them
    "flight": (
        ("show",), ("check",), ("collect", "--out", "{out}", "--flight"), ("identify", "--out", "{out}"),
        ("export", "--to", "csv", "--out", "{out}"),
    ),
    "residuals": (("show",), ("fit-gp", "--out", "{out}"), ("fit-drag", "--out", "{out}")),
    "results": (("results",), ("report", "--out", "{out}")),
}  # fmt: skip


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc")
@pytest.mark.parametrize("kind", READS)
def test_what_declares_many_millions_of_rows_is_not_loaded(bombs, kind, tmp_path):
    """The memory is that of the first command, in a process of its own."""
    rows, path = 96_000_000 if kind == "flight" else 40_000_000, bombs[kind]
    assert path.stat().st_size < 5_000_000 and pq.read_metadata(path).num_rows == rows
    if kind == "results":
        (tmp_path / "r" / "cells").mkdir(parents=True)
        (tmp_path / "r" / "results.parquet").symlink_to(path)
        path = tmp_path / "r"
    first, *others = ([*(word.format(out=tmp_path / "out") for word in command), path] for command in READS[kind])
    measured = apart(*first, before=MEMORY.format(path=str(tmp_path / "peak")))
    for done in (measured, *(run(*words) for words in others)):
        line = one_line(done)
        assert done.returncode == 1 and f"declares {rows} rows" in line and path.name in line, done
    assert int((tmp_path / "peak").read_text()) < LIMIT and not (tmp_path / "out").exists()


def test_text_that_many_rows_share(tmp_path):
    """A megabyte once in the dictionary, a terabyte in the rows; and much ordinary text, which is read."""
    long = "x" * 1_000_000
    like = write_table(
        tmp_path / "a.parquet", {"key": np.array(["a"], object), "mean_error": np.ones(1)}, {}, "results"
    )
    schema = pq.read_schema(like)
    texts = pa.DictionaryArray.from_arrays(pa.array(np.zeros(100_000, np.int32)), pa.array([long]))
    table = pa.table({"key": texts, "mean_error": pa.array(np.ones(100_000))})
    with pq.ParquetWriter(tmp_path / "b.parquet", table.schema, store_schema=False) as writer:
        writer.write_table(table)
        writer.add_key_value_metadata(schema.metadata)
    assert pq.read_schema(tmp_path / "b.parquet").types == schema.types
    with pytest.raises(DataError, match=r"declares 100000 rows of 2 columns, 1000\d\d MB"):
        read_table(tmp_path / "b.parquet", "results")
    keys = np.array([f"{i:020d}" for i in range(200_000)], object)
    columns = {
        "key": keys,
        "cause": np.array(["the same words " * 8] * len(keys), object),
        "seed": np.arange(len(keys)),
    }
    write_table(tmp_path / "c.parquet", columns, {}, "results")
    assert read_table(tmp_path / "c.parquet", "results")[0]["key"][-1] == keys[-1]


@pytest.mark.parametrize("moving", [True, False])
def test_a_long_flight_is_no_bomb(tmp_path, moving):
    """A quarter of an hour at 1 kHz in forty columns, and one in which only time and the time of a step go on."""
    rows = 900_000 if moving else 400_000
    rng = np.random.default_rng(0)
    columns = {"t": 1e-3 * np.arange(rows), "solve_time": rng.normal(1e-4, 1e-5, rows)}
    noise = rng.normal(size=rows)
    columns |= {f"x_{i}": np.roll(noise, 997 * i) if moving else np.ones(rows) for i in range(38 if not moving else 14)}
    path = write_table(tmp_path / "a.parquet", columns, {}, "flight")
    assert 8 * rows * len(columns) > 1e8
    assert len(read_table(path, "flight")[0]["t"]) == rows


def test_hdf5_that_declares_what_it_does_not_hold(tmp_path):
    h5py = pytest.importorskip("h5py", reason="the extra `logs` is not installed")
    path = tmp_path / "log.h5"
    with h5py.File(path, "w") as file:
        for name in ("t", "x", "y", "z", "qw", "qx", "qy", "qz"):
            file.create_dataset(name, shape=(100_000_000,), dtype="f8", chunks=(1_000_000,), fillvalue=1.0)
    assert path.stat().st_size < 100_000
    with pytest.raises(DataError, match=r"log.h5: . declares 100000000 rows: too many to be a log, or damaged"):
        open_table(path).read(["t", "x"], [])
    done = apart("import", "--describe", path, before=MEMORY.format(path=str(tmp_path / "peak")))
    assert "Traceback" not in done.stderr and int((tmp_path / "peak").read_text()) < LIMIT


@pytest.mark.parametrize("column", ["t", "v_x", "u_0"])
def test_a_column_of_text_where_numbers_belong(tmp_path, column):
    found = flight()
    found.columns[column] = np.array(["1.0"] * 9, object)
    path = write_flight(tmp_path / "a.parquet", found)
    with pytest.raises(DataError, match=rf"column '{column}' holds text, or nothing in some rows; numbers are needed"):
        read_flight(path)


@pytest.mark.parametrize(("name", "value"), [("config", [1]), ("row", "x"), ("vehicle", 3), ("outcome", {"a": 1})])
def test_a_record_of_wrong_types(tmp_path, name, value):
    path = write_flight(
        tmp_path / "a.parquet", flight(**{name: value} | ({"outcome": "ok"} if name != "outcome" else {}))
    )
    done = run("show", path)
    assert done.returncode == 1 and f"{path}: damaged, '{name}' of its record is" in one_line(done)


def edited(folder, change):
    """The checkpoint with its payload changed and its hash made anew, as anybody can."""
    document = json.loads((folder / MODEL_FILE).read_text())
    payload = copy.deepcopy(document["payload"])
    payload = change(payload) or payload
    text = json.dumps(payload, sort_keys=True, separators=(",", ":"))
    document |= {"payload": payload, "sha256": hashlib.sha256(text.encode()).hexdigest()}
    (folder / MODEL_FILE).write_text(json.dumps(document))


def put(*places):
    """Set what stands at a place of the payload."""
    *path, last, value = places

    def change(payload):
        for key in path:
            payload = payload[key]
        payload[last] = value

    return change


@pytest.fixture(scope="module")
def gp_folder(tmp_path_factory):
    model = fit_gp(synthetic_dataset(400, 4), GPConfig(inducing=5, features={"a_x": ("v_x",)}))
    return save_model(tmp_path_factory.mktemp("gp") / "gp", model)


NAN, INFINITE = float("nan"), float("inf")
FIRST = ("outputs", 0)
GP_FAULTS = [
    (put(*FIRST, "lengthscale", [0.0]), r"lengthscale above 0 are needed.*outputs\[0\]"),
    (put(*FIRST, "lengthscale", [-1.0]), r"lengthscale.*outputs\[0\]"),
    (put(*FIRST, "lengthscale", [NAN]), "damaged"),
    (put(*FIRST, "lengthscale", ["long"]), r"numbers are needed .*outputs\[0\].lengthscale"),
    (put(*FIRST, "lengthscale", [1.0, 2.0]), r"lengthscale is of shape .*outputs\[0\]"),
    (put(*FIRST, "alpha", [[1.0]] * 5), r"alpha is of shape .*outputs\[0\]"),
    (put(*FIRST, "alpha", "many"), r"holds many; numbers are needed .*outputs\[0\].alpha"),
    (put(*FIRST, "alpha", None), "."),
    (put(*FIRST, "alpha", [1.0] * 200_000), r"inducing is of shape .*outputs\[0\]"),
    (put(*FIRST, "inducing", [1.0, INFINITE]), "."),
    (put(*FIRST, "signal_variance", 0.0), r"`float` > 0.0 .*outputs\[0\].signal_variance"),
    (put(*FIRST, "noise_variance", -1.0), r"outputs\[0\].noise_variance"),
    (put(*FIRST, "noise_variance", True), r"Expected `float`, got `bool` .*outputs\[0\].noise_variance"),
    (put(*FIRST, "signal_variance", "1"), r"Expected `float`, got `str` .*outputs\[0\].signal_variance"),
    (put(*FIRST, "output", "a_q"), r"regex.*outputs\[0\].output"),
    (put(*FIRST, "features", [3]), r"Expected `str`, got `int` .*outputs\[0\].features\[0\]"),
    (put(*FIRST, "features", []), "."),
    (put("outputs", []), "length >= 1 .*outputs"),
    (put("outputs", None), "."),
    (put("outputs", 3), "."),
    (put("vehicle", "mine"), "Expected `object`, got `str` .*vehicle"),
    (put("dataset", []), "Expected `object`, got `array` .*dataset"),
    (put("feature_range", {"v_x": [1.0]}), "feature_range"),
    (put("linear_drag", "drag", [1.0, 2.0]), r"drag is of shape .*linear_drag"),
    (put("linear_drag", "drag", [NAN, 1.0, 1.0]), "damaged"),
    (put("linear_drag", 7), "."),
    (put("kind", ["gaussian_process"]), "."),
    (lambda payload: [1, 2], "."),
    (lambda payload: "text", "."),
]


@pytest.mark.parametrize(("change", "says"), GP_FAULTS)
def test_a_gaussian_process_that_is_none(gp_folder, change, says, tmp_path):
    folder = tmp_path / "gp"
    folder.mkdir()
    (folder / MODEL_FILE).write_bytes((gp_folder / MODEL_FILE).read_bytes())
    assert load_model(folder).outputs
    edited(folder, change)
    with pytest.raises(DataError, match=rf"{MODEL_FILE}: .*{says}") as error:
        load_model(folder)
    assert "\n" not in str(error.value) and len(str(error.value)) < 600


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (put("drag", [1.0, 2.0, "x"]), "numbers are needed .*drag"),
        (put("drag", {"x": 1.0}), "."),
        (put("thrust_gain", None), "Expected `float`, got `null` .*thrust_gain"),
        (put("n", 1.5), r"Expected `int`, got `float` .*\.n"),
        (put("vehicle", ["torrente"]), "Expected `object`, got `array` .*vehicle"),
    ],
)
def test_a_linear_drag_that_is_none(change, says, tmp_path):
    make_checkpoint(tmp_path / "drag")
    edited(tmp_path / "drag", change)
    for words in (
        ("show", tmp_path / "drag"),
        ("simulate", "controller=linear_drag_mpc", f"model={tmp_path / 'drag'}"),
    ):
        done = run(*words)
        assert done.returncode == 1 and "not a valid model" in one_line(done)
        assert "TypeError" not in done.stderr
    with pytest.raises(DataError, match=says):
        load_model(tmp_path / "drag")


def test_a_report_that_is_no_mapping(tmp_path):
    make_checkpoint(tmp_path / "drag")
    for text in ("[1, 2]", '{"rows": 3}', '{"rows": [{"output": 1}]}'):
        (tmp_path / "drag" / "report.json").write_text(text)
        done = run("compare", tmp_path / "drag", tmp_path / "drag")
        assert done.returncode == 0 and "drag_x" in done.stdout, done.stderr
    (tmp_path / "drag" / "report.json").write_text("[1, 2]")
    with pytest.raises(DataError, match=r"report.json: damaged.*`object`, got `array`"):
        load_report(tmp_path / "drag")


EVIL = "\x1b]0;owned\x07\x1b[2J\x1b[31mred\x9b1m\x7f\x08\u202egpj"


def obeyed(text):
    """Characters that a terminal would act upon, but for line ends and tabs."""
    return [c for c in text if (ord(c) < 32 and c not in "\n\t\r") or 127 <= ord(c) < 160 or c in "\u202e\u2028"]


def on_a_terminal(*words, patience=3.0, width=180):
    """What a command sends to a terminal. patience: s, after which it says what it does."""
    ours, theirs = pty.openpty()
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TERM": "xterm-256color", "COLUMNS": str(width)}
    waits = f"quadexp.progress.PATIENCE = {patience}; quadexp.progress.AGAIN = {min(patience, 1)}"
    start = f"import quadexp.progress; {waits}; {START}"
    command = [sys.executable, "-c", start, *map(str, words)]
    process = subprocess.Popen(command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment)
    os.close(theirs)
    out = b""
    while True:
        try:
            part = os.read(ours, 65536)
        except OSError:
            break
        if not part:
            break
        out += part
    process.wait(timeout=600)
    os.close(ours)
    return out.decode(errors="surrogateescape")


@pytest.fixture
def evil(tmp_path):
    """Files whose names, columns and records hold what a terminal would obey."""
    record = {
        "config": {"controller": {"name": EVIL}}, "controller": EVIL, "trajectory": EVIL, "plant": EVIL,
        "vehicle": {"name": EVIL}, "versions": {EVIL: EVIL}, "provenance": {"cpu": EVIL}, "cause": EVIL,
        "recorded": True, "name": EVIL,
    }  # fmt: skip
    found = flight(200, **record)
    found.columns[EVIL] = np.ones(200)
    path = write_flight(tmp_path / f"{EVIL.replace('/', '')}.parquet", found)
    make_checkpoint(tmp_path / "drag")
    edited(tmp_path / "drag", put("vehicle", {"name": EVIL, "fingerprint": EVIL}))
    table = tmp_path / "log.csv"
    table.write_text(f"t,{EVIL},x\n1,2,3\n2,3,4\n")
    results = tmp_path / "results"
    (results / "cells").mkdir(parents=True)
    texts = ("plant", "vehicle", "trajectory", "controller", "model", "variant", "outcome", "backend", "cause", "key")
    row = {name: np.array([EVIL] * 2, object) for name in texts}
    write_table(results / "results.parquet", row | {"seed": np.arange(2), "mean_error": np.ones(2)}, {}, "results")
    model, absent = tmp_path / "drag", tmp_path / EVIL.replace("/", "")
    return [
        ("show", path),
        ("show", "--json", path),
        ("check", path),
        ("results", results),
        ("simulate", "controller=linear_drag_mpc", f"model={model}"),
        ("simulate", f"controller={EVIL}"),
        (EVIL,),
        ("export", path, "--to", "csv", "--out", tmp_path / "o"),
        ("compare", path, path),
        ("show", model),
        ("import", table, "--out", tmp_path / "flights"),
        ("import", path, "--out", tmp_path / "flights2"),
        ("show", results),
        ("show", absent),
        ("show", f"--{EVIL}"),
        ("identify", path, "--out", tmp_path / "id"),
    ]


def test_no_terminal_obeys_what_a_file_says(evil):
    shown = 0
    for words in evil:
        done = run(*words)
        text = done.stdout + done.stderr
        assert obeyed(text) == [], (words, text)
        assert "Traceback" not in text, (words, text)
        shown += "\\x1b]0;owned\\x07" in text
    assert shown > 8, "the names are not in what is printed, so nothing was shown"


def test_a_terminal_gets_colours_and_nothing_else(evil):
    """On a real terminal, where the program itself sends escape sequences."""
    for words in (evil[0], evil[2], evil[3], evil[5]):
        text = on_a_terminal(*words)
        assert "\x1b[31mred" not in text, "a colour that the file asked for"
        own = r"\x1b\[[0-9;]*m|\r[^\x1b\r\n]*\x1b\[K"  # colours, and the line of who waits
        assert obeyed(re.sub(own, "", text)) == [], (words, text)


def test_clean_keeps_what_people_write():
    assert clean("Übung é 漢字 ±3 µm\n\ttab") == "Übung é 漢字 ±3 µm\n\ttab"
    assert clean("\x1b[31m\x9b\r\u202e") == "\\x1b[31m\\x9b\\r\\u202e"
