"""A control period of 20 ms on the plants of other programs, beside the programs themselves.

    python -m benchmarks.foreign

RotorPy: its Multirotor.step, as it comes (RK45 of SciPy, relative error 1e-3). drone-models has derivatives only: they
are stepped by RK4 at the step of the plant. Processor time in microseconds, the best of the rounds, taking turns.
Needs the extras rotorpy and drone-models.
"""

from __future__ import annotations

import os

os.environ["SCIPY_ARRAY_API"] = "1"  # drone-models wants it before SciPy is imported

import time
from collections.abc import Callable
from typing import Any

import drone_models
import numpy as np
from drone_models.first_principles import dynamics
from rotorpy.vehicles.hummingbird_params import quad_params
from rotorpy.vehicles.multirotor import Multirotor

from benchmarks.machine import machine
from quadexp.experiment.build import build_plant, build_vehicle, unshared
from quadexp.parts.compose import compose

PERIOD, CALLS, ROUNDS = 0.02, 20, 5


def ours(plant: str, vehicle: str, backend: str) -> tuple[Callable[[], Any], float]:
    """A period of the plant, and its step (s)."""
    config = compose([f"plant={plant}", f"vehicle={vehicle}", f"plant.backend={backend}"])
    with unshared():
        truth = build_plant(build_vehicle(config.vehicle), config.plant)
    x, u = np.r_[np.zeros(3), 1.0, np.zeros(9)], np.full(4, 1.1 * truth.vehicle.hover_thrust)
    return lambda: truth.advance(x, u, PERIOD), config.plant.step


def rotorpy() -> Callable[[], Any]:
    vehicle = Multirotor(quad_params, control_abstraction="cmd_motor_thrusts")
    hover = quad_params["mass"] * 9.81 / 4
    state = {name: np.zeros(3) for name in ("x", "v", "w", "wind")} | {"q": np.array([0.0, 0.0, 0.0, 1.0])}
    state["rotor_speeds"] = np.full(4, np.sqrt(hover / quad_params["k_eta"]))
    return lambda: vehicle.step(state, {"cmd_motor_thrusts": np.full(4, 1.1 * hover)}, PERIOD)


def drone_models_rk4(name: str, step: float) -> Callable[[], Any]:
    model, cmd = drone_models.parametrize(dynamics, drone_model=name), np.full(4, 20_000.0)
    start = [np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), np.full(4, 19_000.0)]

    def slope(s: list[np.ndarray]) -> list[np.ndarray]:
        pos, quat, vel, ang_vel, rotor_vel = s
        return list(model(pos, quat, vel, ang_vel, cmd, rotor_vel))

    def moved(s: list[np.ndarray], k: list[np.ndarray], h: float) -> list[np.ndarray]:
        return [a + h * b for a, b in zip(s, k, strict=True)]

    def work() -> None:
        s = start
        for _ in range(round(PERIOD / step)):
            k_1 = slope(s)
            k_2 = slope(moved(s, k_1, step / 2))
            k_3 = slope(moved(s, k_2, step / 2))
            k_4 = slope(moved(s, k_3, step))
            s = [a + step / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in zip(s, k_1, k_2, k_3, k_4, strict=True)]

    return work


def best(works: dict[str, Callable[[], Any]]) -> dict[str, float]:
    """Least processor time (us) of a call of each."""
    found = dict.fromkeys(works, np.inf)
    for _ in range(ROUNDS):
        for name, work in works.items():
            work()
            calls = CALLS if "package" in name else 50 * CALLS
            began = time.process_time()
            for _ in range(calls):
                work()
            found[name] = min(found[name], 1e6 * (time.process_time() - began) / calls)
    return found


def main() -> None:
    print(machine())
    for plant, vehicle in (("rotorpy", "hummingbird"), ("drone_models", "cf2x_L250")):
        works: dict[str, Callable[[], Any]] = {}
        for backend in ("compiled", "interpreted"):
            works[backend], step = ours(plant, vehicle, backend)
        works["the package"] = rotorpy() if plant == "rotorpy" else drone_models_rk4(vehicle, step)
        times = best(works)
        for name, value in times.items():
            print(f"{plant:14s} {name:12s} {value:9.1f} us   package / this {times['the package'] / value:8.1f}")


if __name__ == "__main__":
    main()
