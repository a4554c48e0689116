"""The flight in C beside the Python loop, with compiled functions: controllers with what is around them.

    python -m benchmarks.flight

Simulated seconds per second of processor time of a circle at 8 m/s with its reference, the best of the rounds, the two
loops taking turns; both fly the same numbers.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.machine import machine
from quadexp.compile.compiler import required_compiler
from quadexp.experiment import rollout
from quadexp.experiment.build import build_trajectory
from quadexp.experiment.evaluate import build_loop, generator
from quadexp.parts.compose import compose

ROUNDS = 15
NOISE = "sensor.accelerometer_noise=[0.05,0.05,0.05]"
SPEEDS = "vehicle.thrust_coefficient=1.2e-5 actuator=speed_lag_30ms controller.allow_unstable=true"
SCALES = (
    "observer=disturbance observer.scale_walk=0.005 observer.air_walk=0.01 observer.torque_bandwidth=0 rate_loop=indi"
)
LOOPS = (
    "controller=nominal_mpc",
    f"controller=nominal_mpc remedies=offset_free {NOISE}",
    "controller=perfect_mpc",
    "controller=perfect_mpc horizon=stiff",
    f"controller=perfect_mpc remedies=wind {NOISE}",
    f"controller=perfect_mpc {SCALES} {SPEEDS}",
    "controller=geometric",
    "controller=geometric adaptive=l1",
    "controller=pid",
    "controller=dfbc",
    "controller=dfbc rate_loop=indi rate_loop.rate=300",
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


def loops(words: str) -> str:
    """A line of the table."""
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
    print("| controller | Python | C | C / Python |")
    print("|---|--:|--:|--:|")
    for words in LOOPS:
        print(loops(words), flush=True)


if __name__ == "__main__":
    main()
