"""The command line in this process, and in one of its own in whatever environment and under whatever limits."""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from tests.cli.command import run_main as run

__all__ = ["FLY", "ROOT", "START", "apart", "one_line", "run"]
ROOT = Path(__file__).resolve().parents[2]
START = "from quadexp.__main__ import main; main()"
FLY = (
    "simulate", "trajectory=hover", "trajectory.duration=0.4", "controller=nominal_mpc", "plant=ideal",
    "controller.backend=interpreted", "plant.backend=interpreted",
)  # fmt: skip


def apart(
    *words: object,
    environment: Mapping[str, str | None] | None = None,
    before: str = "",
    limit: Callable[[], None] | None = None,
) -> subprocess.CompletedProcess:
    """Run `quadexp words...` in a process of its own, where that is what is tested; otherwise there is `run`.

    environment: changes, None takes a variable away. before: Python that runs first. limit: called in the new process
    before anything else."""
    known = {**os.environ, "PYTHONPATH": str(ROOT), **(environment or {})}
    return subprocess.run(
        [sys.executable, "-c", f"{before}\n{START}", *map(str, words)],
        capture_output=True,
        text=True,
        env={name: value for name, value in known.items() if value is not None},
        preexec_fn=limit,
        timeout=1800,
    )


def one_line(done: subprocess.CompletedProcess) -> str:
    """What a command that failed says: one line that begins with `error:`, and no traceback."""
    assert done.returncode in (1, 2), (done.returncode, done.stdout, done.stderr)
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    assert lines and lines[-1].startswith("error: ") and "Traceback" not in done.stderr, done.stderr
    return lines[-1]
