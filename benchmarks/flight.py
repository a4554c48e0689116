"""The flight in C beside the Python loop: a 12 s closed loop at 100 control steps a second, compiled functions.

    python -m benchmarks.flight [CASE ...]

A case is a residual of benchmarks.step: none, drag, gp20, gp100. Processor time in milliseconds, the best of the
rounds, the two loops taking turns; both fly the same numbers. `reference` is what is computed before the flight, with
its residual interpreted and compiled.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks import step
from benchmarks.machine import machine
from quadexp.compile.compiler import required_compiler
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment import rollout
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.rollout import SampledReference
from quadexp.parts.compose import compose
from quadexp.reference.circle import Circle
from quadexp.reference.flatness import flat_reference
from quadexp.world import SimplifiedPlant

CASES = ("none", "gp20")
ROUNDS = 15


def best(works: dict[str, Callable[[], Any]]) -> dict[str, float]:
    """Least processor time (ms) of each, over rounds in which they take turns."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(ROUNDS):
        for name, work in works.items():
            began = time.process_time()
            work()
            times[name].append(1e3 * (time.process_time() - began))
    return {name: min(found) for name, found in times.items()}


def measure(case: str) -> dict[str, float]:
    """Milliseconds by what was done."""
    vehicle = build_vehicle(compose([]).vehicle)
    residual, _ = step.make_residual(case, vehicle)
    controller = ModelPredictiveController(vehicle, residual, MPCSettings(rate=100.0), backend="compiled")
    plant, path = SimplifiedPlant(vehicle, backend="compiled"), Circle(speed=8.0, acceleration=2.0)
    reference, covers = SampledReference(path, controller), rollout.covers

    def flight(in_c: bool) -> Any:
        rollout.covers = covers if in_c else lambda *_: False
        try:
            return rollout.fly(plant, controller, reference, np.random.default_rng(0))
        finally:
            rollout.covers = covers

    one, two = flight(True), flight(False)
    assert all(name == "solve_time" or np.array_equal(one[name], two[name]) for name in one.columns)
    t = np.arange(0.0, path.duration + 1.0, 0.01)
    works: dict[str, Callable[[], Any]] = {
        "reference interpreted": lambda: flat_reference(path, t, vehicle, residual),
        "reference compiled": lambda: flat_reference(path, t, vehicle, residual, backend="compiled"),
        "flight Python": lambda: flight(False),
        "flight C": lambda: flight(True),
    }
    return best(works)


def main() -> None:
    required_compiler()
    print(machine())
    print("| residual | reference, interpreted / compiled | flight, Python / C | all, after / before |")
    print("|---|--:|--:|--:|")
    for case in sys.argv[1:] or CASES:
        found = measure(case)
        before = found["reference interpreted"] + found["flight Python"]
        ratio = (found["reference compiled"] + found["flight C"]) / before
        print(
            f"| {case} | {found['reference interpreted']:.1f} / {found['reference compiled']:.1f}"
            f" | {found['flight Python']:.1f} / {found['flight C']:.1f} | {ratio:.2f} |"
        )


if __name__ == "__main__":
    main()
