"""What the remedies cost a control step: ratios to the step of the same controller without them.

    python -m benchmarks.remedies [--rounds 20] [--json]

Each contestant is the whole step of a controller in a loop of the user's own (ControlLoop.step: one call into C), on
what it was given in a flight on the circle, in wind and with the delays that it knows; a round is one pass of each over
its own record, so that a slow moment of the machine meets all. Of every step of a record the least over the rounds is
taken, which other work on the machine does not touch; printed are the medians and means over the steps, and their
ratios to the first row, in one run. The two differ where a few steps cost more, such as those of
remedies=auto in which a posterior is looked for.
"""

from __future__ import annotations

import argparse
import gc
import json
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from benchmarks.machine import cores, machine, pin
from benchmarks.step import make_residual
from quadexp.control.base import Controller, Measurement
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.build import build_vehicle, build_world
from quadexp.loop import ControlLoop
from quadexp.parts.compose import compose
from quadexp.parts.sensor_spec import SensorSpec
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.terms import adapting_terms
from quadexp.plugins.auto.around_mpc import AutoMPC
from quadexp.plugins.remedies.delay.prediction import Prediction
from quadexp.plugins.remedies.delay.strapdown import KnownDelay, Strapdown
from quadexp.plugins.remedies.observers.disturbance import DisturbanceObserver
from quadexp.plugins.remedies.observers.wind import WindObserver
from quadexp.plugins.remedies.online_mpc import AdaptingController, AdaptKeys
from quadexp.reference.circle import Circle

CASE = "gp20"
STEPS = 200  # of a round
Log = list[Measurement]


def contestants(vehicle: Vehicle) -> dict[str, Controller]:
    """By what is around the MPC; the first is the one that ratios refer to."""

    def mpc(*, disturbed: bool = True, weighed: bool = False, **settings: Any) -> PredictiveController:
        form = MPCSettings(first_node=0.02, horizon=0.6, **settings)
        residual = make_residual(CASE, vehicle, weighed=weighed)[0]
        return PredictiveController(
            ModelPredictiveController(vehicle, residual, form, backend="compiled", disturbed=disturbed)
        )

    disturbance, wind = DisturbanceObserver(name="disturbance"), WindObserver(name="wind")
    still = WindObserver(name="wind", targets=False)
    strapdown, prediction = Strapdown(time=0.02).around, Prediction(time=0.02, dead_time=0.0, motor_lag=0.0).around
    return {
        f"{CASE}": mpc(disturbed=False),
        f"{CASE}, controller.fallback=true": mpc(disturbed=False, weighed=True),
        f"{CASE}, dead time predicted": mpc(disturbed=False, dead_time=0.02),
        f"{CASE} and terms that adapt": AdaptingController(
            vehicle,
            [make_residual(CASE, vehicle)[0]],
            adapting_terms(vehicle, AdaptKeys().deviation),
            MPCSettings(first_node=0.02, horizon=0.6),
            AdaptKeys(),
            backend="compiled",
        ),
        f"{CASE}, observer=disturbance": disturbance.around(mpc()),
        f"{CASE}, observer=disturbance, dead time predicted": disturbance.around(mpc(dead_time=0.02)),
        f"{CASE}, observer=disturbance, delay=strapdown": strapdown(disturbance.around(mpc())),
        f"{CASE}, observer=disturbance, delay=prediction": prediction(disturbance.around(mpc())),
        f"{CASE}, observer=wind without targets": still.around(mpc()),
        f"{CASE}, observer=wind": wind.around(mpc()),
        f"{CASE}, observer=wind without targets, dead time predicted": still.around(mpc(dead_time=0.02)),
        f"{CASE}, observer=wind, dead time predicted": wind.around(mpc(dead_time=0.02)),
        f"{CASE}, delay=strapdown (20 ms)": strapdown(mpc(disturbed=False)),
        f"{CASE}, delay=prediction (20 ms)": prediction(mpc(disturbed=False)),
        f"{CASE}, motor=lead": mpc(disturbed=False, motor_lead=0.03),
        f"{CASE}, motor=states": mpc(disturbed=False, motor_lag=0.03),
        f"{CASE}, observer=wind without targets, delay=strapdown": strapdown(still.around(mpc())),
        f"{CASE}, observer=wind without targets, delay=prediction": Prediction(
            time=0.02, dead_time=0.0, motor_lag=0.0
        ).around(still.around(mpc())),
        f"{CASE}, observer=wind, delay=strapdown": strapdown(wind.around(mpc())),
        f"{CASE}, observer=wind, delay=prediction": prediction(wind.around(mpc())),
        f"{CASE}, remedies=auto": AutoMPC(mpc(input_hold="deviation"), SensorSpec()),
    }


def flown(loop: ControlLoop) -> Log:
    """What a controller is given on the circle in a gusty wind."""
    controller, world = loop.controller, loop.plant
    x, reading, rng = loop.start, None, np.random.default_rng(0)
    noise = world.begin(x, loop.period, float(loop.times[-1]) + 1.0, rng)
    log: Log = []
    for k in range(STEPS + 100):
        log.append(Measurement(float(loop.times[k]), world.measured.copy(), reading, None))
        x, reading = world.advance(x, loop.step(log[-1]), controller.control_period, noise)
    return log


def in_wind(vehicle: Vehicle, controller: Controller) -> ControlLoop:
    """A loop on the circle; its plant has the delays that the controller knows."""
    late, remedy = controller.node_times[0], getattr(controller, "part", None)
    age = remedy.time if isinstance(remedy, KnownDelay) else 0.0
    link = [f"link.latency={late}", "link=latency"] if late else []
    if age:
        gyro = "fresh" if isinstance(remedy, Strapdown) else "late"
        link += ["estimator=late", f"estimator.delay={age}", f"estimator.gyro={gyro}"]
    return ControlLoop(controller, Circle(speed=8.0), build_world(compose(["world=only_wind", *link]), vehicle))


def steps(loop: ControlLoop, log: Log) -> np.ndarray:
    """Seconds of every step."""
    seconds = []
    loop.reset(log[0].state)
    gc.collect()
    gc.disable()
    for told in log:
        began = time.perf_counter()
        loop.step(told)
        seconds.append(time.perf_counter() - began)
    gc.enable()
    return np.array(seconds[100:])


def measure(rounds: int) -> dict[str, tuple[float, float]]:
    """Seconds of a step by contestant: median and mean."""
    vehicle = build_vehicle(compose([]).vehicle)
    works: dict[str, Callable[[], np.ndarray]] = {}
    for name, controller in contestants(vehicle).items():
        loop = in_wind(vehicle, controller)
        works[name] = partial(steps, loop, flown(loop))
    every = cores()
    pin(0, {min(every)})
    seconds: dict[str, list[np.ndarray]] = {name: [] for name in works}
    for _ in range(rounds):
        for name, work in works.items():
            seconds[name].append(work())
    pin(0, every)
    least = {name: np.min(times, axis=0) for name, times in seconds.items()}
    return {name: (float(np.median(times)), float(times.mean())) for name, times in least.items()}


def table(seconds: dict[str, tuple[float, float]]) -> str:
    """As Markdown."""
    first, mean = next(iter(seconds.values()))
    lines = ["| step | us | ratio | of the means |", "|---|--:|--:|--:|"]
    rows = (f"| {name} | {1e6 * a:.0f} | {a / first:.2f} | {b / mean:.2f} |" for name, (a, b) in seconds.items())
    return "\n".join([*lines, *rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the table")
    arguments = parser.parse_args()
    seconds = measure(arguments.rounds)
    print(json.dumps(seconds) if arguments.json else f"{machine()}\n\n{table(seconds)}")


if __name__ == "__main__":
    main()
