"""Time and memory of the pipeline's commands, as a user runs them.

    python -m benchmarks.pipeline [--keep FOLDER]

Every line of the table is one command of the command line, in a folder of its own. Time is wall clock from start to
exit, with the processor time of all its processes (to detect other load on the machine); memory is the largest resident
set of any of them. The cache of compiled functions is empty at the start; commands that compile are run again, into
another folder. The sweep has 15 conditions with four models each, on two processes: circle and lemniscate
at 4 .. 12 m/s with an acceleration of a quarter of the speed per second, random paths at five speeds, flights of about
12 s.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.machine import machine

PR_SET_CHILD_SUBREAPER = 36  # <linux/prctl.h>
MEMORY_LIMIT = 1.0  # GB a process
CONTROLLERS = "nominal_mpc,linear_drag_mpc,gp_mpc,perfect_mpc"
SPEEDS = (4, 6, 8, 10, 12)  # m/s, nominal
RANDOM_SPEEDS = (2, 2.7, 3, 3.2, 3.5)  # m/s, nominal
CELLS = 15 * 4


@dataclass(frozen=True)
class Measured:
    """A command that completed: wall clock and processor time (s), GB of its largest process, its JSON object."""

    seconds: float
    processor: float
    memory: float
    answer: dict[str, Any]


def run(command: Sequence[str], folder: Path) -> Measured:
    """Run `quadexp COMMAND --json` in a folder; ends the benchmark with its last line where it fails."""
    environment = os.environ | {
        "QUADEXP_CACHE": str(folder / "cache"),
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join(filter(None, [str(Path.cwd()), os.environ.get("PYTHONPATH", "")])),
    }
    with open(folder / "stdout", "w+") as stdout, open(folder / "stderr", "w+") as stderr:
        began = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "quadexp", *command, "--json"],
            cwd=folder,
            env=environment,
            stdout=stdout,
            stderr=stderr,
        )
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - began
        process.returncode = os.waitstatus_to_exitcode(status)
        usages = [usage, *orphans()]
        stdout.seek(0)
        stderr.seek(0)
        if process.returncode != 0:
            reason = (stderr.read().strip().splitlines() or ["no message"])[-1]
            raise SystemExit(f"quadexp {' '.join(command)}: {reason}")
        unit = 1 if sys.platform == "darwin" else 1024  # bytes of ru_maxrss
        processor = sum(usage.ru_utime + usage.ru_stime for usage in usages)
        memory = max(usage.ru_maxrss for usage in usages) * unit / 1e9
        return Measured(seconds, processor, memory, json.loads(stdout.read()))


def adopt_orphans() -> None:
    """Become the parent of processes that outlive theirs, as the workers' server of a sweep does: to see their use."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def orphans() -> Iterator[Any]:
    """Resource usage of the adopted processes, as they end."""
    while True:
        try:
            yield os.wait4(-1, 0)[2]
        except ChildProcessError:
            return


def write_sweep(folder: Path) -> Path:
    """A configuration folder with the sweep as an experiment."""
    grids = [
        {
            "trajectory": "circle,lemniscate",
            "trajectory.speed": f"{speed:g}",
            "trajectory.acceleration": f"{speed / 4:g}",
            "controller": CONTROLLERS,
        }
        for speed in SPEEDS
    ]
    grids.append(
        {
            "trajectory": "random",
            "trajectory.speed": ",".join(f"{speed:g}" for speed in RANDOM_SPEEDS),
            "controller": CONTROLLERS,
        }
    )
    lines = ["# @package _global_", f"sweep: {json.dumps(grids)}"]
    path = folder / "conf" / "experiment" / "pipeline_sweep.yaml"
    path.parent.mkdir(parents=True)
    path.write_text("\n".join(lines) + "\n")
    return folder / "conf"


def measure(folder: Path) -> list[tuple[str, Measured, float | None]]:
    """What was run, what it took, and the seconds promised for it."""
    conf = write_sweep(folder)
    sweep = ["evaluate", "--sweep", "experiment=pipeline_sweep", "evaluate.workers=2", "--conf", str(conf)]
    sweep += ["model=models/gp"]
    steps = [
        ("300 s collected", ["collect", "collect.duration=300", "--out", "data/short.parquet"], 5.0),
        ("300 s collected again", ["collect", "collect.duration=300", "--out", "data/again.parquet"], 5.0),
        ("440 s (22 000 rows) collected", ["collect", "collect.duration=440", "--out", "data/long.parquet"], None),
        ("GP fitted to 22 000 rows", ["fit-gp", "data/long.parquet", "--out", "models/gp"], 30.0),
        (f"sweep of {CELLS} flights", [*sweep, "--out", "results/first"], 20.0),
        (f"sweep of {CELLS} flights again", [*sweep, "--out", "results/second"], 20.0),
    ]
    measured = []
    for name, command, limit in steps:
        print(f"{name} ...", file=sys.stderr, flush=True)
        found = run(command, folder)
        if command[0] == "evaluate":
            outcomes = [row["outcome"] for row in found.answer["rows"]]
            if outcomes != ["ok"] * CELLS:
                raise SystemExit(f"{name}: {len(outcomes)} flights with outcomes {sorted(set(outcomes))}")
        measured.append((name, found, limit))
    return measured


def table(measured: list[tuple[str, Measured, float | None]]) -> str:
    """The figures as Markdown."""
    lines = [
        f"| {'command':30} | {'s':>5} | {'promised':>8} | {'CPU s':>5} | {'GB':>4} | {'promised':>8} |",
        f"| {'-' * 30} | {'-' * 4}: | {'-' * 7}: | {'-' * 4}: | {'-' * 3}: | {'-' * 7}: |",
    ]
    for name, found, limit in measured:
        promised = ["" if value is None else f"<= {value:g}" for value in (limit, MEMORY_LIMIT)]
        lines.append(
            f"| {name:30} | {found.seconds:5.1f} | {promised[0]:>8} | {found.processor:5.1f} |"
            f" {found.memory:4.2f} | {promised[1]:>8} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="work here, and leave what is made")
    arguments = parser.parse_args()
    adopt_orphans()
    if arguments.keep:
        arguments.keep.mkdir(parents=True)
        measured = measure(arguments.keep.resolve())
    else:
        with tempfile.TemporaryDirectory() as folder:
            measured = measure(Path(folder))
    print(f"{machine()}\n\n{table(measured)}")


if __name__ == "__main__":
    main()
