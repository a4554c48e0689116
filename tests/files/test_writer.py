"""Attacks on files that are written: links planted beside them, two writers of one name, what a cleaner may remove."""

import ast
import errno
import os
import re
import subprocess
import sys
import threading

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_flight, write_flight
from quadexp.models.checkpoint import load_model, save_model
from quadexp.models.linear_drag import LinearDrag
from quadexp.writer import clean
from tests.faults.command import FLY, ROOT, START, run
from tests.house import modules
from tests.log.flights import straight_flight

PRECIOUS = "written by hand"


@pytest.fixture
def precious(tmp_path):
    """A file of somebody's that links are to lead to."""
    path = tmp_path / "private" / "thesis"
    path.parent.mkdir()
    path.write_text(PRECIOUS)
    return path


def drag():
    three = np.zeros(3)
    return LinearDrag(three, three, 0.1, three, three, 0.01, three, three, 99)


def test_links_planted_beside_an_output_are_not_followed(tmp_path, precious):
    """Under every name that can be guessed: of this process, and of the next ones."""
    shared = tmp_path / "shared"
    shared.mkdir()
    for name in ("a.parquet", "model", "report.html"):
        for end in ("tmp", "probe"):
            (shared / f".{name}.{os.getpid()}.{end}").symlink_to(precious)
    assert run(*FLY, "--out", shared / "a.parquet").returncode == 0
    assert precious.read_text() == PRECIOUS
    save_model(shared / "model", drag())
    assert read_flight(shared / "a.parquet").outcome == "ok" and load_model(shared / "model").n == 99
    assert precious.read_text() == PRECIOUS


@pytest.mark.parametrize("kind", ["link", "dangling", "file", "folder"])
def test_a_temporary_name_that_is_guessed_all_the_same(tmp_path, precious, monkeypatch, kind):
    monkeypatch.setattr("secrets.token_hex", lambda size: "0" * 2 * size)
    planted = tmp_path / f".quadexp-{'0' * 16}.tmp"
    {
        "link": lambda: planted.symlink_to(precious),
        "dangling": lambda: planted.symlink_to(tmp_path / "private" / "new"),
        "file": lambda: planted.write_text("theirs"),
        "folder": planted.mkdir,
    }[kind]()
    with pytest.raises(UsageError, match="cannot be written"):
        write_flight(tmp_path / "a.parquet", straight_flight())
    assert precious.read_text() == PRECIOUS and os.listdir(precious.parent) == ["thesis"]
    assert not (tmp_path / "a.parquet").exists() and os.path.lexists(planted)


@pytest.mark.parametrize("target", ["a.parquet", "model"])
def test_force_replaces_a_link_and_not_what_it_leads_to(tmp_path, precious, target):
    (tmp_path / target).symlink_to(precious)
    if target == "a.parquet":
        write_flight(tmp_path / target, straight_flight(), force=True)
        assert not (tmp_path / target).is_symlink()
    else:
        with pytest.raises(UsageError):
            save_model(tmp_path / target, drag(), force=True)
    assert precious.read_text() == PRECIOUS


def test_two_programs_that_write_one_new_file(tmp_path):
    """One is refused with one line; what the other wrote is there."""
    command = [sys.executable, "-c", START, *FLY, "--out", str(tmp_path / "same.parquet")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    both = [
        subprocess.Popen([*command, f"seed={seed}"], env=environment, stdout=-1, stderr=-1, text=True)
        for seed in (1, 2)
    ]
    said = [process.communicate(timeout=600)[1] for process in both]
    codes = [process.returncode for process in both]
    assert sorted(codes) == [0, 2]
    (refused,) = [text for text, code in zip(said, codes, strict=True) if code]
    assert refused.count("\n") == 1 and "same.parquet: exists already; pass --force" in refused
    assert read_flight(tmp_path / "same.parquet").metadata["seed"] == 1 + codes.index(0)
    assert os.listdir(tmp_path) == ["same.parquet"]


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("what", ["file", "folder"])
def test_many_writers_of_one_new_name(tmp_path, monkeypatch, links, what):
    """Also on a file system without hard links."""
    if not links:

        def refused(*_, **__):
            raise OSError(errno.EPERM, "Operation not permitted")

        monkeypatch.setattr(os, "link", refused)
    start, ended = threading.Barrier(8), []

    def writer(seed):
        start.wait()
        try:
            if what == "file":
                write_flight(tmp_path / "a", straight_flight(seed=seed), force=False)
            else:
                save_model(tmp_path / "a", drag(), force=False)
            ended.append(seed)
        except UsageError as error:
            assert "exists already; pass --force" in str(error)

    threads = [threading.Thread(target=writer, args=(seed,)) for seed in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    (seed,) = ended
    assert os.listdir(tmp_path) == ["a"]
    assert what == "folder" or read_flight(tmp_path / "a").metadata["seed"] == seed


def test_cleaning_removes_what_killed_writers_left_and_nothing_else(tmp_path):
    store = CellStore(tmp_path / "results")
    store.open()
    cell = store.path("ab12").parent
    cell.mkdir()
    kept = [store.root / ".mine.tmp", cell / "thesis.tmp", cell / ".quadexp-draft.tmp"]
    left = cell / f".quadexp-{'2' * 16}.tmp"
    for path in (*kept, left):
        path.write_text(PRECIOUS)
    (cell / f".quadexp-{'3' * 16}.tmp").symlink_to(kept[0])
    clean(cell, older=60.0)
    assert left.exists()  # its writer may be at work
    store.clean()
    assert not left.exists() and all(path.read_text() == PRECIOUS for path in kept)


# Modules that make files in another way, and which.
ELSEWHERE = {
    "quadexp.writer": "the writer",
    "quadexp.compile.backend": "a lock, and what is compiled, in a private folder",
    "quadexp.log.cell_store": "a lock",
    "quadexp.plugins.exchange.flights": "in a private folder",
    "quadexp.plugins.drawing.style": "hands what it is given on to matplotlib",
}
WAYS = re.compile(
    r"open\([^)]*, '[rb]*[wax+]|.*\.(write_text|write_bytes|touch|to_parquet|to_csv)\(|os\.(replace|rename|link)\("
    r"|shutil\.(move|copyfileobj)|.*\.savefig\((?!file|stream)"
)


def test_nothing_but_the_writer_makes_files():
    wanted = set(re.findall(r"\w{4,}", WAYS.pattern))
    found = {}
    for name, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            called = isinstance(node, ast.Call) and (getattr(node.func, "attr", "") or getattr(node.func, "id", ""))
            if called in wanted and WAYS.match(text := ast.unparse(node)):
                found.setdefault(name, []).append(text)
    assert found.keys() == ELSEWHERE.keys(), {name: found.get(name) for name in found.keys() ^ ELSEWHERE.keys()}
