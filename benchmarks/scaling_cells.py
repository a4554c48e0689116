"""Cell functions of benchmarks/scaling.py, importable by worker processes."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

from quadexp.experiment import build
from quadexp.experiment.evaluate import fly_one
from quadexp.flight.store import write_flight


def timed_cell(config: Any, model: Any, path: str, key: str) -> dict[str, Any]:
    """Fly and write; the row says how long each took (s), how much memory the process has (MB) and what it built."""
    builds = _count_builds()
    began, spent = time.perf_counter(), time.process_time()
    flight = fly_one(config, model)
    flown, spent = time.perf_counter(), time.process_time() - spent
    flight.metadata["row"]["key"] = key
    write_flight(Path(path), flight, key=key)
    row = flight.metadata["row"]
    return {
        **row,
        "flight_seconds": flown - began,
        "flight_cpu": spent,
        "write_seconds": time.perf_counter() - flown,
        "resident": resident(),
        "builds": _built[0] - builds,
        "process": os.getpid(),
    }


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
    }


def resident(pid: int | str = "self", name: str = "VmRSS") -> float:
    """Resident memory of a process, MB."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1]) / 1e3
    return float("nan")


_built = [0]


def _count_builds() -> int:
    """Controllers built by this process so far; begins to count when called first."""
    if not hasattr(build, "uncounted"):
        build.uncounted = build._keep  # type: ignore[attr-defined]

        def counted(record: Any, make: Any) -> Any:
            def made() -> Any:
                _built[0] += record[0] == "controller"
                return make()

            return build.uncounted(record, made)  # type: ignore[attr-defined]

        build._keep = counted
    return _built[0]
