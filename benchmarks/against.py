"""Steps and flights of this tree beside those of another one, taking turns in one run.

    python -m benchmarks.against FOLDER [--rounds 7]

FOLDER: another checkout, for example of an earlier version. Each tree has one process. A step is the median of a pass
over the circle at 8 m/s (wall clock, us), as Python calls it: `command` of the MPC; `step` of a ControlLoop along its
own reference, then along a reference that is given to it; `answer`, the same after `prepare`. With bounds as in
bounded.py. Flights: simulated seconds per second of processor time, without the reference. Printed are the best of the
rounds, and the median of the rounds' ratios.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

BOUND, JUMP, EVERY = 2.0, 1.0, 15  # of the hover thrust; m; steps
FLIGHTS = {
    "nominal": "controller=nominal_mpc",
    "perfect": "controller=perfect_mpc",
    "perfect, wind": "controller=perfect_mpc remedies=wind",
    "geometric": "controller=geometric",
}
CASES = ("none 10", "none 20", "gp20 10", "gp20 20", "none 10 bounded", "none 20 bounded")


def works() -> Iterator[tuple[str, Callable[[], float]]]:
    """What is measured, by name, on the tree that is first on the path; only names that both trees have."""
    import quadexp as qx
    from benchmarks import step
    from quadexp.control.mpc.controller import as_controller
    from quadexp.experiment.rollout import SampledReference, fly
    from quadexp.reference.circle import Circle

    vehicle = step.build_vehicle(step.compose([]).vehicle)
    for name in CASES:
        case, nodes, *bounded = name.split()
        flown = replace(vehicle, thrust_max=BOUND * vehicle.hover_thrust) if bounded else vehicle
        residual, settings = step.make_residual(case, flown)[0], step.MPCSettings(nodes=int(nodes))
        mpc = step.ModelPredictiveController(flown, residual, settings, backend="compiled")
        plant = step.make_plant(case, flown)
        log = step.fly_circle(plant, mpc, 300, **({"jump": JUMP, "every": EVERY} if bounded else {}))
        loop = qx.ControlLoop(as_controller(mpc), Circle(speed=8.0, acceleration=1.0), plant)
        yield from ((f"{name}: {work.func.__name__}", work) for work in _steps(mpc, loop, log, qx.Window))
    for name, words in FLIGHTS.items():
        loop = qx.controller(*words.split(), "trajectory=circle", "trajectory.speed=8", "controller.rate=50")
        reference = SampledReference(loop.trajectory, loop.controller)

        def flight(loop: Any = loop, reference: Any = reference) -> float:
            began = time.process_time()
            flight = fly(loop.plant, loop.controller, reference, np.random.default_rng(0))
            return float(flight.t[-1]) / (time.process_time() - began)

        yield name, flight


def _steps(mpc: Any, loop: Any, log: Any, window: Any) -> list[Any]:
    """Median us of a pass over the log: see the module."""
    times = [(k + 50) * loop.period for k in range(len(log))]  # fly_circle leaves out the first 50
    windows = [window(states, inputs, np.zeros((5, 3)), np.zeros(3)) for _, states, inputs in log]

    def median(call: Callable[[int], Any], before: Callable[[int], Any] = lambda k: None) -> float:
        spent = []
        for k in range(len(log)):
            before(k)
            began = time.perf_counter_ns()
            call(k)
            spent.append(time.perf_counter_ns() - began)
        return float(np.median(spent)) / 1e3

    def command() -> float:
        mpc.reset(*log[0])
        return median(lambda k: mpc.command(*log[k]))

    def step() -> float:
        loop.reset(log[0][0])
        return median(lambda k: loop.step(log[k][0], times[k]))

    def given() -> float:
        loop.reset(log[0][0])
        return median(lambda k: loop.step(log[k][0], times[k], windows[k]))

    def answer() -> float:
        loop.reset(log[0][0])
        return median(lambda k: loop.step(log[k][0], times[k]), lambda k: loop.prepare(times[k]))

    return [partial(work) for work in (command, step, given, answer)]


def serve() -> None:
    """Build all and measure once, then say so; then measure all once for each line that comes in."""
    measured = dict(works())
    for work in measured.values():
        work()
    print("{}", flush=True)
    for _ in sys.stdin:
        print(json.dumps({name: work() for name, work in measured.items()}), flush=True)


def measure(folders: list[Path], rounds: int) -> list[dict[str, np.ndarray]]:
    """Of each tree, by what was measured, the results of all rounds."""
    command, environment = [sys.executable, __file__, "--serve"], os.environ | {"OMP_NUM_THREADS": "1"}
    pipe: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    trees = [
        subprocess.Popen(command, env=environment | {"PYTHONPATH": str(folder)}, cwd=folder, **pipe)
        for folder in folders
    ]
    for tree in trees:
        assert tree.stdout.readline().strip() == "{}", "a tree could not be built"
    found: list[list[dict[str, float]]] = [[] for _ in trees]
    for _ in range(rounds):
        for tree, results in zip(trees, found, strict=True):
            print("round", file=tree.stdin, flush=True)
            results.append(json.loads(tree.stdout.readline()))
    for tree in trees:
        tree.communicate()
    return [{name: np.array([one[name] for one in results]) for name in results[0]} for results in found]


def table(now: dict[str, np.ndarray], before: dict[str, np.ndarray]) -> str:
    """Lines of Markdown."""
    lines = ["| step (us) | before | now | ratio |", "|---|--:|--:|--:|"]
    for name, found in now.items():
        ratio = float(np.median(found / before[name]))
        if ":" in name:
            lines.append(f"| {name} | {before[name].min():.1f} | {found.min():.1f} | {ratio:.2f} |")
            continue
        if name == next(iter(FLIGHTS)):
            lines += ["", "| flight (s/s) | before | now | ratio |", "|---|--:|--:|--:|"]
        lines.append(f"| {name} | {before[name].max():.0f} | {found.max():.0f} | {ratio:.2f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="the other tree")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        return serve()
    if arguments.folder is None:
        parser.error("FOLDER is missing: another checkout of this program")
    from benchmarks.machine import machine

    trees = [Path(__file__).resolve().parents[1], arguments.folder.resolve()]
    now, before = measure(trees, arguments.rounds)
    print(f"{machine()}\n\n{table(now, before)}")


if __name__ == "__main__":
    main()
