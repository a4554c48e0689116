"""Overhead of a sweep besides its flights, with local processes and with a local Dask cluster.

    python -m benchmarks.scaling [--parts overhead dask driver rerun order store] [--cells 2000] [--json]

overhead, dask   short flights on one and on two workers, in turns: time per cell beside the flight itself, in which
                 the file is written; efficiency of the second worker; memory of a worker
driver           20 000 cells without a flight: time for planning, flying and tables, and memory of the driver
rerun            the command again, when all is flown: seconds of the whole process
order            flights whose controllers must all be built, in the order of the plan and shuffled: builds, seconds
store            finding the cells and recalling one

All files are removed afterwards. Wall-clock times depend on other load on the machine. Times called `own` are
wall-clock times minus the waiting time of runnable threads for a core (/proc/*/schedstat): an estimate for an otherwise
idle machine, to be compared with the limits in docs/scaling.md.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.scaling_cells import processor_seconds, resident, timed_cell, trivial_cell
from quadexp.log.cell_store import CellStore
from quadexp.parts.compose import compose, expand, session
from quadexp.sweeps.engine import Engine, LocalEngine, Task
from quadexp.sweeps.plan import Job, flying_order, plan_cells
from quadexp.sweeps.sweep import SweepRequest, run_sweep

SHORT = ["trajectory=step", "trajectory.duration=0.4", "trajectory.step_time=0.2"]
CONTROLLERS = "controller=nominal_mpc,perfect_mpc"
Record = dict[str, Any]


@contextmanager
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="quadexp-scaling-") as name:
        yield Path(name)


def tasks(jobs: list[Job], out: Path) -> Iterator[Task]:
    store = CellStore(out)
    for job in jobs:
        path = store.path(job.key)
        path.parent.mkdir(parents=True, exist_ok=True)
        yield Task(job.key, job.cell.config, job.model, str(path))


def fly(engine: Engine, jobs: list[Job]) -> Record:
    """Fly everything; means over the cells whose controller was there already, and what building one took.

    all_cpu: processor time of every process of the sweep a cell, driver_cpu: of the driver's, both after the first
    result.
    """
    with folder() as out:
        began, rows = time.perf_counter(), []
        last = len(jobs)
        for _, row in engine.fly(timed_cell, tasks(jobs, out)):
            if not isinstance(row, dict):
                raise SystemExit(f"a cell failed: {row.cause}")
            rows.append({name: row[name] for name in (*TIMES, "builds", "resident", "process")})
            if len(rows) == 1:
                first, everyone, driver = time.perf_counter(), processor_seconds(os.getpid()), time.process_time()
            if len(rows) == last:
                everyone, driver = processor_seconds(os.getpid()) - everyone, time.process_time() - driver
        ended = time.perf_counter()
    built = [row for row in rows if row["builds"]]
    settled = [row for row in rows if not row["builds"]]
    mean = {f"{name}_ms": 1e3 * float(np.mean([row[name] for row in settled])) for name in TIMES}
    builds = sum(row["builds"] for row in built)
    building = sum(row["flight_own"] for row in built) - 1e-3 * mean["flight_own_ms"] * len(built)
    return {
        "cells": len(rows),
        "wall": ended - began,
        "wall_after_first": ended - first,
        **mean,
        "driver_cpu_ms": 1e3 * driver / len(rows),
        "all_cpu_ms": 1e3 * everyone / len(rows),
        "builds": builds,
        "build_own_ms": 1e3 * building / builds if builds else 0.0,
        "resident": max(row["resident"] for row in rows),
        "processes": len({row["process"] for row in rows}),
    }


TIMES = tuple(f"{part}_{kind}" for part in ("flight", "write", "between") for kind in ("seconds", "cpu", "own"))
TURNS = 4  # of one worker and of two


def overhead(engine: Callable[[int], Engine], cells: int) -> Record:
    """One and two workers in turns, each on a part of the cells.

    The efficiency is that of two cores of one's own, on which the driver would take its time from the workers, and of
    one sweep, in which every worker builds every controller once.
    """
    jobs = list(plan_cells(expand([*SHORT, CONTROLLERS, f"seed=range({cells // 2})"])).values())
    runs: dict[int, list[Record]] = {1: [], 2: []}
    for turn in range(TURNS):
        for workers, made in runs.items():
            made.append(fly(engine(workers), flying_order(jobs[turn::TURNS])))
    found: Record = {}
    for workers, made in runs.items():
        mean = {name: float(np.mean([run[name] for run in made])) for name in made[0]}
        mean |= {"cells": sum(run["cells"] for run in made), "resident": max(run["resident"] for run in made)}
        mean["beside_own_ms"] = mean["write_own_ms"] + mean["between_own_ms"]
        found[f"{workers} workers"] = mean
    pairs = list(zip(runs[1], runs[2], strict=True))
    found["efficiency, wall clock, by turn"] = [a["wall_after_first"] / b["wall_after_first"] / 2 for a, b in pairs]
    found["efficiency, own, by turn"] = [_efficiency(a, b, cells) for a, b in pairs]
    found["efficiency, own"] = _efficiency(found["1 workers"], found["2 workers"], cells)
    found["load after"] = os.getloadavg()[0]
    return found


def _efficiency(one: Record, two: Record, cells: int) -> float:
    alone, shared = (sum(run[f"{part}_own_ms"] for part in ("flight", "write", "between")) for run in (one, two))
    built = len(CONTROLLERS.split(",")) * one["build_own_ms"]
    return (cells * alone + built) / (cells * (shared + two["driver_cpu_ms"]) + 2 * built)


def driver(cells: int) -> Record:
    """Memory of the driver, in a process of its own."""
    code = f"from benchmarks.scaling import driver_memory; driver_memory({cells})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


class NoFlights:
    """An engine that calls the cell function in this process, so that the driver alone is measured."""

    def fly(self, function: Any, tasks: Any) -> Iterator[tuple[str, Any]]:
        for task in tasks:
            yield task.key, function(task.config, task.model, task.path, task.key)


def driver_memory(cells: int) -> None:
    """Print seconds of processor time and memory (MB) as a sweep without flights goes on."""
    seen: dict[str, Any] = {}

    def mark(name: str) -> None:
        seen[name] = {"cpu_s": time.process_time() - began, "resident_MB": resident()}

    def progress(done: int, total: int) -> None:
        if done in (0, total):
            mark("planned" if done == 0 else "all rows in")

    with session() as composer, folder() as out:
        began, before = time.process_time(), resident()
        grid = composer.expand([*SHORT, CONTROLLERS, f"seed=range({cells // 2})"], check=False)
        run_sweep(grid, out / "r", SweepRequest(engine=NoFlights(), function=trivial_cell, progress=progress))
        mark("tables written")
    print(json.dumps({"cells": cells, "before_MB": before, **seen, "peak_MB": resident(name="VmHWM")}))


def rerun(cells: int) -> Record:
    """The whole command on a finished sweep, three times."""
    overrides = [*SHORT, CONTROLLERS, f"seed=range({cells // 2})"]
    with folder() as out:
        run_sweep(expand(overrides), out / "r", SweepRequest(engine=LocalEngine(2)))
        command = [sys.executable, "-m", "quadexp", "evaluate", "--sweep", *overrides, "--out", str(out / "r")]
        seconds, used = [], []
        for _ in range(3):
            began, before = time.perf_counter(), os.times()
            subprocess.run([*command, "--no-figures"], capture_output=True, check=True)
            seconds.append(time.perf_counter() - began)
            used.append(os.times().children_user - before.children_user)
        began = time.perf_counter()
        run_sweep(expand(overrides), out / "r")
        own = time.perf_counter() - began
    return {"cells": cells, "seconds": seconds, "cpu_seconds": used, "own_seconds": own}


def order() -> Record:
    """Eighty controllers of two flights each: more than a worker keeps."""
    masses = ",".join(f"{0.01 * i:g}" for i in range(1, 81))
    cells = expand([*SHORT, "controller=perfect_mpc", f"plant.lift={masses}", "seed=range(4)"])
    jobs = list(plan_cells(cells).values())
    found = {}
    for name, chosen in (("as planned", flying_order(jobs)), ("shuffled", random.Random(0).sample(jobs, len(jobs)))):
        run = fly(LocalEngine(2), chosen)
        found[name] = {key: run[key] for key in ("cells", "builds", "build_own_ms", "wall", "resident")}
    return found


def store(cells: int) -> Record:
    """Finding the cells of a folder, and taking the row of one from its file."""
    with folder() as out:
        flown = run_sweep(expand([*SHORT, "seed=range(20)"]), out / "few", SweepRequest(engine=LocalEngine(2)))
        few = CellStore(out / "few")
        keys = [row["key"] for row in flown.rows]
        began = time.perf_counter()
        for key in keys:
            few.row(key)
        recall = time.perf_counter() - began
        size = int(np.mean([few.path(key).stat().st_size for key in keys]))
        many = CellStore(out / "many")
        for i in range(cells):
            path = many.path(f"{i * 2654435761 % 2**64:020x}")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        began = time.perf_counter()
        assert len(many.done()) == cells
        scan = time.perf_counter() - began
    return {"recall_ms": 1e3 * recall / len(keys), "bytes_per_cell": size, f"scan of {cells} files, s": scan}


def dask_engine(workers: int) -> Engine:
    from quadexp.sweeps.sweep import build_engine

    return build_engine(compose(["engine=dask", f"evaluate.workers={workers}"]))


PARTS: dict[str, Callable[[int], Record]] = {
    "overhead": lambda cells: overhead(LocalEngine, cells),
    "dask": lambda cells: overhead(dask_engine, cells),
    "driver": lambda cells: driver(10 * cells),
    "rerun": rerun,
    "order": lambda cells: order(),
    "store": lambda cells: store(10 * cells),
}


def lines(record: Record, indent: str = "  ") -> Iterator[str]:
    for name, value in record.items():
        if isinstance(value, dict):
            yield f"{indent}{name}"
            yield from lines(value, indent + "  ")
        elif isinstance(value, list):
            yield f"{indent}{name:<26}{', '.join(f'{item:.3g}' for item in value)}"
        else:
            yield f"{indent}{name:<26}{value:.4g}" if isinstance(value, float) else f"{indent}{name:<26}{value}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--cells", type=int, default=2000)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    found: Record = {}
    for part in arguments.parts:
        found[part] = {"load before": os.getloadavg()[0], **PARTS[part](arguments.cells)}
        if not arguments.json:
            print("\n".join([part, *lines(found[part])]), flush=True)
    if arguments.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
