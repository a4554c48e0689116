"""The flight in C beside the Python loop: a 12 s closed loop at 100 control steps a second, compiled functions.

    python -m benchmarks.flight [CASE ...]
    python -m benchmarks.flight loops

A case is a residual of benchmarks.step: none, drag, gp20, gp100. Processor time in milliseconds, the best of the
rounds, the two loops taking turns; both fly the same numbers. `reference` is what is computed before the flight, with
its residual interpreted and compiled. `loops`: simulated seconds per second of processor time of a circle at 8 m/s, for
controllers with what is around them, by both loops.
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
from quadexp.experiment.build import build_trajectory, build_vehicle
from quadexp.experiment.evaluate import build_loop, generator
from quadexp.experiment.rollout import SampledReference
from quadexp.parts.compose import compose
from quadexp.reference.circle import Circle
from quadexp.reference.flatness import flat_reference
from quadexp.world import SimplifiedPlant

CASES = ("none", "gp20")
ROUNDS = 15
NOISE = "sensor.accelerometer_noise=[0.05,0.05,0.05]"
SPEEDS = "vehicle.thrust_coefficient=1.2e-5 actuator=speed_lag_30ms controller.allow_unstable=true"
LOOPS = (
    "controller=nominal_mpc",
    f"controller=nominal_mpc remedies=offset_free {NOISE}",
    "controller=perfect_mpc",
    "controller=perfect_mpc horizon=stiff",
    f"controller=perfect_mpc remedies=wind {NOISE}",
    f"controller=perfect_mpc remedies=unknown_vehicle {SPEEDS}",
    "controller=geometric",
    "controller=geometric adaptive=l1",
    "controller=pid",
    "controller=dfbc",
    "controller=dfbc inner=indi inner.rate=300",
)


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


def loops(words: str) -> str:
    """A line of the table of `loops`."""
    config = compose(["trajectory=circle", "trajectory.speed=8", *words.split()])
    loop, covers = build_loop(config, None), rollout.covers
    path = build_trajectory(config.trajectory, loop.vehicle)

    def flight(in_c: bool) -> Any:
        rollout.covers = covers if in_c else lambda *_: False
        try:
            return loop.fly(path, generator(config))
        finally:
            rollout.covers = covers

    one, two = flight(True), flight(False)
    assert all(name == "solve_time" or np.array_equal(one[name], two[name]) for name in one.columns)
    times = best({"Python": lambda: flight(False), "C": lambda: flight(True)})
    python, compiled = (1e3 * float(one.t[-1]) / times[name] for name in ("Python", "C"))
    return f"| `{words.removeprefix('controller=')}` | {python:.0f} | {compiled:.0f} | {compiled / python:.1f} |"


def main() -> None:
    required_compiler()
    print(machine())
    if sys.argv[1:] == ["loops"]:
        print("| controller | Python | C | C / Python |")
        print("|---|--:|--:|--:|")
        for words in LOOPS:
            print(loops(words), flush=True)
        return
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
