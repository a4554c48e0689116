"""Memory of the commands whose data may be long, at three sizes each, and how it grows.

    python -m benchmarks.memory [--only delays export ...]

delays    `identify --method delays` of a flight at 200 Hz
export    `export --to csv` of a flight with all that is given, at 50 Hz
fit       `fit-gp` with 200 points in every GP, without figures
figures   `evaluate` of one long flight, with its figure of the path; also the largest file that it draws (MB)
nodes     the first step of an MPC with so many nodes, which is compiled

Memory is the largest resident set of any process of the command (MB). exponent: slope, from the first size to the last,
of the logarithm of what is taken beyond BASE: 1 where twice the data take twice as much, 0 where they take the same.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Callable
from pathlib import Path

from benchmarks.machine import machine
from benchmarks.pipeline import adopt_orphans, run

BASE = 70.0  # MB, of a process that has imported what every command imports
PATH = ("trajectory=ellipse", "trajectory.speed=5", "trajectory.acceleration=8", "world=only_wind")
Made = tuple[list[str], Path | None]  # the command, and where it writes what is to be small


def simulated(folder: Path, seconds: int, *overrides: str) -> str:
    """A flight of so many seconds."""
    out = f"runs/{seconds}.parquet"
    run(["simulate", *PATH, f"trajectory.duration={seconds}", *overrides, "--out", out], folder)
    return out


def delays(folder: Path, seconds: int) -> Made:
    flight = simulated(folder, seconds, "controller.rate=200", "link=latency", "link.latency=0.02")
    return ["identify", flight, "--method", "delays"], None


def export(folder: Path, seconds: int) -> Made:
    return ["export", simulated(folder, seconds), "--to", "csv"], None


def fit(folder: Path, seconds: int) -> Made:
    data = f"data/{seconds}.parquet"
    run(["collect", f"collect.duration={seconds}", "--out", data], folder)
    few = ("gp.inducing=200", "gp.max_iterations=2", "gp.refit=false", "--no-figures")
    return ["fit-gp", data, *few, "--out", f"models/{seconds}"], None


def figures(folder: Path, seconds: int) -> Made:
    out = f"results/{seconds}"
    return ["evaluate", "--sweep", *PATH, f"trajectory.duration={seconds}", "--out", out], Path(out)


def nodes(folder: Path, count: int) -> Made:
    horizon = f"controller.horizon={0.02 * count}"
    path = ("trajectory=hover", "trajectory.duration=0.2", "--out", f"runs/{count}.parquet")
    return ["simulate", f"controller.nodes={count}", horizon, *path], None


PARTS: dict[str, tuple[Callable[[Path, int], Made], tuple[int, ...], str]] = {
    "delays": (delays, (60, 180, 540), "s"),
    "export": (export, (300, 900, 2700), "s"),
    "fit": (fit, (100, 300, 900), "s of flights"),
    "figures": (figures, (60, 300, 1500), "s"),
    "nodes": (nodes, (25, 50, 100), "nodes"),
}


def exponent(sizes: tuple[int, ...], memory: list[float]) -> float:
    """Of what each size takes beyond BASE, from the first to the last."""
    first, last = (max(one - BASE, 1.0) for one in (memory[0], memory[-1]))
    return math.log(last / first) / math.log(sizes[-1] / sizes[0])


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=[*PARTS], choices=[*PARTS], metavar="PART")
    options = parser.parse_args()
    adopt_orphans()
    print(machine(), flush=True)
    print("\n| command | sizes | memory (MB) | exponent | largest file (MB) |\n|---|---|---|---|---|", flush=True)
    for name in options.only:
        make, sizes, unit = PARTS[name]
        memory, files = list[float](), list[str]()
        for size in sizes:
            with tempfile.TemporaryDirectory(prefix="quadexp-memory-") as place:
                command, written = make(Path(place), size)
                memory.append(1e3 * run(command, Path(place)).memory)
                if written is not None:
                    found = (path for path in (Path(place) / written).rglob("*.svg"))
                    files.append(f"{max((path.stat().st_size for path in found), default=0) / 1e6:.2f}")
        shown = " / ".join(f"{one:.0f}" for one in memory)
        of = " / ".join(map(str, sizes))
        print(f"| {name} | {of} {unit} | {shown} | {exponent(sizes, memory):.2f} | {' / '.join(files)} |", flush=True)


if __name__ == "__main__":
    main()
