"""Description of the machine in one line: processor, cores, versions."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path

import casadi as ca

from quadexp.compile.backend import compiler


def cores() -> set[int]:
    """Cores this process may use."""
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


def pin(pid: int, chosen: set[int]) -> None:
    """Bind a process (0: this one) to cores, where the system can."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(pid, chosen)


def machine() -> str:
    """One line for the record."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    model = next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine()
    )
    version = "no C compiler"
    if compiler():
        said = subprocess.run([compiler(), "--version"], check=True, capture_output=True, text=True).stdout
        version = said.splitlines()[0]
    return f"{model}, {len(cores())} cores; Python {platform.python_version()}, CasADi {ca.__version__}, {version}"
