"""A sweep of four quick cells, and the bytes of its files."""

from __future__ import annotations

from quadexp.parts.compose import expand
from quadexp.sweeps.sweep import run_sweep
from tests.sweeps.cells import quick_cell

SWEEP = ["trajectory.speed=2", "controller=nominal_mpc,perfect_mpc", "seed=0,1"]


def fly(out, overrides=SWEEP, **options):
    return run_sweep(expand(overrides), out, isolate=False, function=quick_cell, **options)


def contents(folder):
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
