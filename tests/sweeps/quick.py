"""A sweep of four quick cells, the bytes of its files, and a sweep by a process of its own that does not end by
itself."""

import os
import subprocess
import sys
from pathlib import Path

from quadexp.parts.compose import expand
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.sweeps.cells import quick_cell

SWEEP = ["trajectory.speed=2", "controller=nominal_mpc,perfect_mpc", "seed=0,1"]


def fly(out, overrides=SWEEP, **options):
    return run_sweep(expand(overrides), out, SweepRequest(isolate=False, function=quick_cell, **options))


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


ROOT = Path(__file__).resolve().parents[2]
SCRIPT = """
import os
import sys
from quadexp.errors import QuadexpError
from quadexp.parts.compose import expand
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.sweeps import cells

if __name__ == "__main__":
    out, address, *overrides = sys.argv[1:]
    engine, function = None, cells.HeldCell(os.path.dirname(out), (8, 9))
    if address:
        from tests.plugins.cluster.test_dask import at
        engine, function = at(address), cells.slow_cell
    say = lambda done, total: os.write(1, b"%d\\n" % done)  # a line is whole also where it is interrupted
    try:
        run_sweep(
            expand(overrides), out, SweepRequest(workers=2, function=function, engine=engine, progress=say)
        )
    except QuadexpError as error:
        print("error:", error, flush=True)
        sys.exit(error.exit_code)
"""


def start(folder: Path, *overrides: str, address: str = "") -> subprocess.Popen:
    """A sweep into folder/r; the process leads a group of its own. address: of a scheduler, which flies slow cells; ""
    for two processes of this machine, which stop after eight cells and wait for their end (HeldCell)."""
    (folder / "driver.py").write_text(SCRIPT)
    return subprocess.Popen(
        [sys.executable, str(folder / "driver.py"), str(folder / "r"), address, *overrides],
        env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip


def wait_for(process: subprocess.Popen, count: int) -> None:
    """Until that many cells are done."""
    for line in process.stdout:
        if line.strip().isdigit() and int(line) >= count:
            return


def kill(process: subprocess.Popen) -> None:
    """By kill -9, without what it has started."""
    process.kill()
    process.wait()
    process.stdout.close()
