"""A worker that outlives its pool while it starts says nothing; every other error of a worker is printed."""

from __future__ import annotations

import subprocess
import sys

import pytest

SCRIPT = """
import multiprocessing, sys
import quadexp.sweeps.orphans
try:
    lock = multiprocessing.get_context("spawn").Lock()
    semaphore = lock._semlock
    {what}
except Exception:
    sys.excepthook(*sys.exc_info())
"""
REBUILT = "lock.__setstate__((semaphore.handle, semaphore.kind, semaphore.maxvalue, {name}))"


@pytest.mark.parametrize(
    ("what", "said"),
    [
        (REBUILT.format(name="semaphore.name"), ""),
        (REBUILT.format(name="'/none'"), ""),
        ("open('/none')", "FileNotFoundError"),
        ("1 / 0", "ZeroDivisionError"),
    ],
)
def test_only_semaphores_that_are_gone_are_not_reported(what, said):
    command = [sys.executable, "-c", SCRIPT.format(what=what)]
    error = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    assert said in error and bool(error) == bool(said)
