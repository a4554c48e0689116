"""Processor time of commands from start to end, beside another checkout of this program in the same run.

    python -m benchmarks.startup --against CHECKOUT [--rounds 7] [--fits 2]

Each checkout makes its own inputs with its own commands, in a folder, a cache and a folder of byte code of its own.
Then rounds alternate between both, and the least user time of a command is taken: other work on the machine only adds
to it. `fit-gp` takes a data set of 300 s; it is fitted --fits times.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from benchmarks.machine import machine
from quadexp.report.table import Table

FLY = ("simulate", "trajectory=circle", "trajectory.speed=4", "--force")
SWEEP = ("experiment=quick", "controller=nominal_mpc,linear_drag_mpc,gp_mpc,perfect_mpc", "seed=0")
FIT = ("fit-gp", "data.parquet", "--out", "gp", "--force")
INPUTS = (
    ("collect", "plant=simplified", "collect.duration=300", "--out", "data.parquet"),
    FIT,
    ("simulate", "controller=nominal_mpc", "trajectory=circle", "trajectory.speed=4", "--out", "flight.parquet"),
    ("evaluate", "--sweep", *SWEEP, "model={folder}/gp", "--out", "results"),
)
COMMANDS = {
    "--help": ("--help",),
    "simulate": (*FLY, "controller=nominal_mpc", "--out", "a.parquet"),
    "simulate model=/PATH": (*FLY, "controller=gp_mpc", "model={folder}/gp", "--out", "b.parquet"),
    "show FLIGHT": ("show", "flight.parquet"),
    "report RESULTS": ("report", "results", "--out", "report.html", "--force"),
    "fit-gp of 300 s": FIT,
}


def user_time(command: Sequence[str], checkout: Path, folder: Path) -> float:
    """User time of a command and its processes (s); ends the benchmark where it fails."""
    environment = os.environ | {
        "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1", "QUADEXP_CACHE": f"{folder}/cache",
        "PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": f"{folder}/bytecode",
    }  # fmt: skip
    words = [word.format(folder=folder) for word in command]
    with open(folder / "output", "w+") as output:
        program = [sys.executable, "-m", "quadexp", *words]
        process = subprocess.Popen(program, cwd=folder, env=environment, stdout=output, stderr=output)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            output.seek(0)
            raise SystemExit(f"{checkout}: quadexp {' '.join(words)}: {output.read().strip()[-500:]}")
    return usage.ru_utime


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--against", type=Path, required=True, help="another checkout")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--fits", type=int, default=2)
    given = parser.parse_args()
    checkouts = (Path(__file__).resolve().parents[1], given.against.resolve())
    with tempfile.TemporaryDirectory() as scratch:
        folders = [Path(scratch) / name for name in ("here", "other")]
        for checkout, folder in zip(checkouts, folders, strict=True):
            (folder / "cache").mkdir(mode=0o700, parents=True)
            for command in (*INPUTS, *COMMANDS.values()):
                if command is not FIT or not (folder / "gp").exists():
                    user_time(command, checkout, folder)
        rows = []
        for name, command in COMMANDS.items():
            rounds = given.fits if command is FIT else given.rounds
            if not rounds:
                continue
            times = [
                [user_time(command, *place) for place in zip(checkouts, folders, strict=True)] for _ in range(rounds)
            ]
            here, other = (min(column) for column in zip(*times, strict=True))
            rows.append([name, f"{here:.3f}", f"{other:.3f}", f"{here / other:.2f}"])
    table = Table(("command", "here, s", "there, s", "ratio"), rows, f"user time, least of {given.rounds} rounds")
    print(table.markdown(), machine(), sep="\n")


if __name__ == "__main__":
    main()
