"""The same sweep once more, after its files were damaged, its disk was full, or it was ended between two writes."""

import errno
import fcntl
import shutil

import pytest

from quadexp.errors import UsageError
from quadexp.log.cell_store import CellStore
from quadexp.parts.compose import expand
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.sweeps.cells import quick_cell


def fly(out, seeds=2, **options):
    cells = expand([f"seed=range({seeds})", "trajectory.speed=2", "controller=nominal_mpc"])
    return run_sweep(cells, out, SweepRequest(isolate=False, function=quick_cell, **options))


@pytest.fixture
def again(tmp_path):
    fly(tmp_path / "r")
    return tmp_path / "r"


def table(out):
    return (out / "results.csv").read_text()


@pytest.mark.parametrize("damage", [b"", b"hello", "cut", "another kind"])
def test_a_damaged_table_is_made_anew_from_the_flights(again, damage):
    path, before = again / "results.parquet", table(again)
    if damage == "another kind":
        shutil.copy(again / "statistics.parquet", path)
    else:
        path.write_bytes(path.read_bytes()[:-30] if damage == "cut" else damage)
    result = fly(again)
    assert result.flown == 0 and table(again) == before
    assert fly(again).flown == 0


def test_what_a_full_disk_leaves_is_no_folder_of_other_things(tmp_path):
    """No flight could be written, nor the table, but the few lines of results.csv."""
    store = CellStore(tmp_path / "r")
    store.open()
    with pytest.raises(OSError), store.emptied():
        (store.root / "results.csv").write_text("key\n")
        raise OSError(errno.ENOSPC, "No space left on device")
    assert fly(store.root).flown == 2


def test_a_file_system_without_locks(again, monkeypatch):
    def refuse(file, operation):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    assert fly(again).flown == 0


def test_a_lock_that_was_removed_by_the_one_who_held_it(again, monkeypatch):
    """Two sweeps would hold a lock each: one of a file that is no longer there."""
    store, flock = CellStore(again), fcntl.flock

    def late(file, operation):
        flock(file, operation)
        (store.folder / ".lock").unlink()

    monkeypatch.setattr(fcntl, "flock", late)
    with pytest.raises(UsageError, match="another sweep is running there"), store.lock():
        pass
