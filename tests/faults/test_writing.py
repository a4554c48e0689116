"""Files that cannot be written, or not to their end: nothing half, nothing lost, one clear line."""

import json
import os
import resource
import subprocess

import pytest

from quadexp.errors import QuadexpError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_flight
from quadexp.parts.compose import compose, expand
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.faults.command import FLY, apart, one_line, run
from tests.sweeps.cells import CountedCell, built_engine


def files(folder):
    return sorted(path.name for path in folder.rglob("*") if path.is_file())


def test_a_file_may_not_grow(tmp_path):
    """The limit is met in the middle of writing."""
    path = tmp_path / "a.parquet"
    assert run(*FLY, "--out", path).returncode == 0
    whole = path.read_bytes()

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))

    # SIGXFSZ is ignored by Python: the write itself fails
    done = apart(*FLY, "--out", path, "--force", limit=limit)
    line = one_line(done)
    assert str(path) in line and "too large" in line and done.returncode == 1
    assert path.read_bytes() == whole and files(tmp_path) == ["a.parquet"]


MANY = ("evaluate", "--sweep", "--no-figures", *FLY[1:], "seed=range(40)", "evaluate.workers=2")


def ended_at_the_first_failed_write(done, out, says):
    """What a sweep must do whose disk is full: one line, exit code 1; what is done is there and whole, nothing else."""
    line = one_line(done)
    assert done.returncode == 1 and says in line and "run the same command to continue" in line
    cells = [path for path in out.rglob("*") if path.is_file() and path.parent.parent.name == "cells"]
    assert f"{len(cells)} of 40 done" in line and all(path.suffix == ".parquet" for path in cells)
    assert all(read_flight(path).outcome == "ok" for path in cells)
    assert set(files(out)) - {"asked.json"} == {path.name for path in cells}  # `prune` reads which were asked for
    return cells


@pytest.fixture
def disk(tmp_path):
    """A file system with room for a few flights."""
    place = tmp_path / "disk"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "tmpfs", place], capture_output=True).returncode:
        pytest.skip("no file system can be mounted here")
    yield place
    subprocess.run(["umount", place], check=True)


@pytest.mark.slow
def test_a_sweep_ends_where_the_disk_is_full(disk):
    """At the first failed write, not after all the rest was flown for nothing; with room again the rest is flown."""
    command = (*MANY, "--out", disk / "results")
    cells = ended_at_the_first_failed_write(run(*command), disk / "results", "No space left on device")
    assert 3 <= len(cells) < 12, "a cell has some 30 kB"
    subprocess.run(["mount", "-o", "remount,size=8m", disk], check=True)
    again = run(*command, "--json")
    assert again.returncode == 0, again.stderr
    assert json.loads(again.stdout)["flown"] == 40 - len(cells)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["local", "dask"])
def test_how_many_are_flown_for_a_full_disk(disk, tmp_path, engine):
    """One that fails, and those that were in the air or handed out when it did."""
    if engine == "dask":
        pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    counted = CountedCell(str(tmp_path / "flown"))  # where there is room
    started = built_engine(compose([f"engine={engine}", "evaluate.workers=2"]))
    with pytest.raises(QuadexpError, match="No space left on device.* of 400 done; run the same command") as error:
        run_sweep(expand(["seed=range(400)"]), disk / "results", SweepRequest(function=counted, engine=started))
    assert error.value.exit_code == 1
    done = len(CellStore(disk / "results").done())
    assert done > 3 and done < len((tmp_path / "flown").read_text()) <= done + 12


def test_a_sweep_ends_where_no_file_may_grow(tmp_path):
    """The same without a file system of its own: every flight is larger than a file may be."""

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (16384, 16384))

    out = tmp_path / "results"
    done = apart(*MANY, "trajectory.duration=2.0", "--out", out, limit=limit)
    assert ended_at_the_first_failed_write(done, out, "too large") == []


@pytest.fixture
def closed(tmp_path):
    """A folder that takes no files, not even from the superuser where that one runs the tests."""
    folder = tmp_path / "closed"
    folder.mkdir()
    if os.getuid():
        folder.chmod(0o555)
        yield folder, "Permission denied"
        folder.chmod(0o755)
        return
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "ro", "tmpfs", folder], capture_output=True)
    if done.returncode:
        pytest.skip("no file system can be mounted here")
    yield folder, "Read-only file system"
    subprocess.run(["umount", folder], check=True)


@pytest.mark.slow
def test_a_folder_that_takes_no_files(closed):
    """Said before the flight, not after it; in a folder below it too."""
    folder, cause = closed
    for path in (folder / "a.parquet", folder / "deeper" / "a.parquet"):
        done = run(*FLY, "--out", path)
        assert f"{path}: cannot be written there ({cause})" in one_line(done) and done.returncode == 2
    sweep = run("evaluate", "--sweep", "--no-figures", *FLY[1:], "--out", folder / "results")
    assert str(folder / "results") in one_line(sweep) and cause in sweep.stderr
    assert files(folder) == []


KILL = """
import os, signal
replace = os.replace
def kill(source, target):
    if str(target).endswith({name!r}):
        os.kill(os.getpid(), signal.SIGKILL)
    return replace(source, target)
os.replace = kill
"""


def test_killed_between_write_and_rename(tmp_path):
    """What was there is there still; the next run writes as if nothing had been."""
    path = tmp_path / "a.parquet"
    assert run(*FLY, "--out", path).returncode == 0
    before = read_flight(path)
    done = apart(*FLY, "seed=3", "--out", path, "--force", before=KILL.format(name="a.parquet"))
    assert done.returncode == -9
    assert read_flight(path).metadata["seed"] == before.metadata["seed"] == 0
    assert run(*FLY, "seed=3", "--out", path, "--force").returncode == 0
    assert read_flight(path).metadata["seed"] == 3


def test_a_sweep_killed_between_write_and_rename(tmp_path):
    """Every cell once, and no temporary file, after the same command again."""
    out = tmp_path / "results"
    sweep = ("evaluate", "--sweep", "--no-figures", *FLY[1:], "seed=0,1", "evaluate.workers=1", "--out", out)
    done = apart(*sweep, before=KILL.format(name="results.parquet"))
    assert done.returncode == -9
    again = run(*sweep)
    assert again.returncode == 0, again.stderr
    assert not [name for name in files(out) if name.endswith(".tmp")]
    rows = (out / "results.csv").read_text().strip().splitlines()
    assert len(rows) == 3
