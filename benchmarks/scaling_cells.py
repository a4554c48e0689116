"""Cell functions of benchmarks/scaling.py, importable by worker processes."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from quadexp.experiment import build
from quadexp.experiment.evaluate import fly_one, program_record
from quadexp.log.store import write_flight


def timed_cell(config: Any, model: Any, path: str, key: str) -> dict[str, Any]:
    """Fly and write; the row has the time of each, the memory of the process (MB) and the controllers that it built.

    `*_seconds`: wall-clock time. `*_own`: minus the thread's waiting time for a core. between: time since the end of
    the previous cell in this process.
    """
    builds = _count_builds()
    began = clocks()
    between = {} if _ended[0] is None else spent("between", _ended[0], began)
    flight = fly_one(config, model)
    flown = clocks()
    flight.metadata["row"]["key"] = key
    write_flight(Path(path), flight, key=key, durable=False)
    _ended[0] = clocks()
    return {
        **flight.metadata["row"],
        "between_seconds": 0.0,
        "between_own": 0.0,
        "between_cpu": 0.0,
        **between,
        **spent("flight", began, flown),
        **spent("write", flown, _ended[0]),
        "resident": resident(),
        "builds": _built[0] - builds,
        "process": os.getpid(),
    }


def clocks() -> tuple[float, float, float]:
    """Wall clock, processor time of this thread, and time for which it waited for a core (s; 0 where not given)."""
    try:
        waited = float(Path("/proc/thread-self/schedstat").read_text().split()[1]) / 1e9
    except OSError:
        waited = 0.0
    return time.perf_counter(), time.thread_time(), waited


def spent(name: str, began: tuple[float, float, float], ended: tuple[float, float, float]) -> dict[str, float]:
    wall, cpu, waited = (b - a for a, b in zip(began, ended, strict=True))
    return {f"{name}_seconds": wall, f"{name}_cpu": cpu, f"{name}_own": wall - waited}


def processor_seconds(pid: int) -> float:
    """Of a process and all that it started and that still run."""
    tick = os.sysconf("SC_CLK_TCK")
    parents: dict[int, list[int]] = {}
    used: dict[int, float] = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        child = int(entry.parent.name)
        parents.setdefault(int(fields[1]), []).append(child)
        used[child] = sum(map(int, fields[11:13])) / tick
    waiting, total = [pid], 0.0
    while waiting:
        one = waiting.pop()
        total += used.get(one, 0.0)
        waiting += parents.get(one, [])
    return total


def trivial_cell(config: Any, model: Any, path: str, key: str) -> dict[str, Any]:
    """No flight and no file."""
    return {
        "plant": "none",
        "vehicle": "none",
        "trajectory": "none",
        "controller": config.controller.name,
        "seed": config.seed,
        "rmse": 0.001 * (config.seed % 97),
        "mean_error": 0.001 * (config.seed % 89),
        "max_error": 0.002,
        "outcome": "ok",
        **program_record(),
    }


def resident(pid: int | str = "self", name: str = "VmRSS") -> float:
    """Resident memory of a process, MB."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) / 1e3
    return float("nan")


_keep = build.keep  # as it is without counting
_built = [0]
_ended: list[Any] = [None]  # clocks at the end of this process's last cell


def _count_builds() -> int:
    """Controllers built by this process so far; begins to count when called first."""
    build.keep = _counted_keep
    return _built[0]


def _counted_keep(record: Any, make: Any) -> Any:
    def made() -> Any:
        _built[0] += record[0] == "controller"
        return make()

    return _keep(record, made)
