"""A control step of the laws in closed form, and what L1 adds, as Python calls them.

    python -m benchmarks.laws

Microseconds a call of `step`, median and 99th percentile, the rounds of all taking turns; MPC beside them. raptor and
rotorpy_se3 need the extra controllers.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from benchmarks.machine import machine
from quadexp.control.base import Controller, Measurement
from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller, build_trajectory, build_vehicle, build_world
from quadexp.experiment.rollout import SampledReference
from quadexp.parts.compose import compose

ROWS = {
    "nominal_mpc": ["controller=nominal_mpc"],
    "nominal_mpc+l1": ["controller=nominal_mpc", "adaptive=l1"],
    "geometric": ["controller=geometric"],
    "geometric, exact rates": ["controller=geometric", "controller.rates=exact"],
    "geometric, the plant's equations": ["controller=geometric", "controller.residual=plant"],
    "geometric+l1": ["controller=geometric", "adaptive=l1"],
    "pid": ["controller=pid"],
    "pid+l1": ["controller=pid", "adaptive=l1"],
    "raptor": ["controller=raptor"],
    "rotorpy_se3": ["controller=rotorpy_se3"],
}
ROUNDS, CALLS = 20, 100


def stepping(overrides: list[str]) -> Callable[[int], float]:
    """From the number of a control instant to the time of the step there (us); the flight is left to the reference."""
    config = compose(overrides)
    vehicle = build_vehicle(config.vehicle)
    controller: Controller = build_controller(config, vehicle, build_world(config, vehicle), None)
    reference = SampledReference(build_trajectory(config.trajectory, vehicle), controller)
    controller.reset(reference.at(0)[0], reference.window(0))

    def once(k: int) -> float:
        k %= len(reference)
        window = reference.window(k)
        measured = Measurement(float(reference.t[k]), reference.at(k)[0] + 1e-3, np.array([0.0, 0.0, 9.81]), None)
        began = time.perf_counter()
        controller.step(measured, window)
        return 1e6 * (time.perf_counter() - began)

    return once


def main() -> None:
    print(f"{machine()}\n\n| controller | median | 99 % |\n|---|---|---|")
    made = {}
    for name, overrides in ROWS.items():
        try:
            made[name] = stepping(overrides)
        except UsageError as error:
            print(f"{name} is left out: {error}")
    times: dict[str, list[float]] = {name: [] for name in made}
    for i in range(ROUNDS):
        for name, once in made.items():
            times[name] += [once(i * CALLS + k) for k in range(CALLS)]
    for name, values in times.items():
        print(f"| {name} | {np.median(values):.1f} | {np.percentile(values, 99):.0f} |")


if __name__ == "__main__":
    main()
