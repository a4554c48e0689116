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
    state = (lock._semlock.handle, lock._semlock.kind, lock._semlock.maxvalue, {name})
    lock.__setstate__(state) if {name!r} != "raise" else 1 / 0
except Exception:
    sys.excepthook(*sys.exc_info())
"""


@pytest.mark.parametrize(
    ("name", "said"), [("'/none'", ""), ("lock._semlock.name", ""), ("raise", "ZeroDivisionError")]
)
def test_only_semaphores_that_are_gone_are_not_reported(name, said):
    text = SCRIPT.format(name=name) if name != "raise" else SCRIPT.replace("{name!r}", "'raise'").replace("{name}", "0")
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert (said in done.stderr) if said else not done.stderr
