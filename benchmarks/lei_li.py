"""Time of Lei & Li's system: the plant, a closed-loop Example 1, and a control step with the blade-element model.

    python -m benchmarks.lei_li [--rounds 5] [--acados-python PYTHON] [--json]

plant: 60 s of the blade-element plant in forward flight, commands at 100 Hz, Euler at 1e-4 s as in the paper and RK4 at
2.5e-3 s. closed loop: the whole of Example 1, identification and feedback included, as `quadexp simulate` flies it.
Both in processor time of this process, minimum over the rounds, so that other load on the machine has little effect.

step: one step of `rls_mpc` (identification, then one iteration with the blade-element model) and of `nominal_mpc` along
the same closed loop, in rounds that alternate between them and acados's step for the plain model where the interpreter
given can import it (benchmarks/step.py; N = 10 on both sides). Percentiles in processor time of the thread; ratios of
medians in wall time, round by round.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import cores, machine
from benchmarks.step import Acados, acados, fly_circle, make_plant, make_residual, problem
from quadexp.control.base import Measurement, Window
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.build import build_controller, build_plant, build_trajectory, build_vehicle, build_world
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.parts.compose import compose

BACKENDS = ("compiled", "interpreted")
BENCH = ("vehicle=lei_li", "plant=blade_element", "sensor=lei_li")
LIMITS = {  # s of processor time for 60 s of flight
    ("plant, Euler 1e-4 s", "compiled"): 0.5,
    ("plant, Euler 1e-4 s", "interpreted"): 3.0,
    ("closed loop, Example 1", "interpreted"): 3.0,
}
RATIO_LIMIT = 0.6
FLIGHT, PERIOD = 60.0, 0.01  # s
STEPS = 1000  # of the closed loop that the control step is timed along

Asked = list[tuple[Measurement, Window]]


def processor_time(action: Callable[[], Any], rounds: int) -> float:
    """Least processor time of the action (s), once run to warm up."""
    action()
    seconds = []
    for _ in range(rounds):
        gc.collect()
        began = time.process_time()
        action()
        seconds.append(time.process_time() - began)
    return min(seconds)


def plant_flight(method: str, step: float, backend: str) -> Callable[[], None]:
    """60 s of the plant from hover into forward flight."""
    config = compose([*BENCH, f"plant.method={method}", f"plant.step={step}", f"plant.backend={backend}"])
    vehicle = build_vehicle(config.vehicle)
    plant = build_plant(vehicle, config.plant)
    thrust = np.full(vehicle.n_rotors, vehicle.hover_thrust)
    start = np.zeros(13)
    start[3], start[7] = 1.0, 5.0

    def flight() -> None:
        plant.reset()
        for _ in range(round(FLIGHT / PERIOD)):  # always from the same state: nothing stabilises the vehicle here
            plant.advance(start, thrust, PERIOD)

    return flight


def closed_loop(backend: str) -> Callable[[], None]:
    """Example 1 with identification, 60 s."""
    overrides = (f"plant.backend={backend}", f"controller.backend={backend}")
    config = compose([*BENCH, "trajectory=rectangle", "controller=rls_feedback", *overrides])
    vehicle = build_vehicle(config.vehicle)
    plant = build_world(config, vehicle)
    controller = build_controller(config, vehicle, plant, None)
    trajectory = build_trajectory(config.trajectory)

    def flight() -> None:
        reference = SampledReference(trajectory, controller)
        start = trajectory.start_state
        flown = fly(plant, controller, reference, np.random.default_rng(0), start=start, lost_distance=100.0)
        assert flown.outcome == "ok"

    return flight


def asked_along_a_circle() -> Asked:
    """What `rls_mpc` is asked in the first steps of a circle at 8 m/s."""
    config = compose([*BENCH, "trajectory=circle", "trajectory.speed=8", "controller=rls_mpc"])
    vehicle = build_vehicle(config.vehicle)
    plant = build_world(config, vehicle)
    controller = build_controller(config, vehicle, plant, None)
    reference = SampledReference(build_trajectory(config.trajectory), controller)
    x, asked = reference.at(0)[0].copy(), []
    noise = plant.begin(x, controller.control_period, float(reference.t[-1]), np.random.default_rng(0))
    controller.reset(x, reference.window(0))
    reading, speed = None, None
    for k in range(min(STEPS, len(reference))):
        measurement = Measurement(reference.t[k], x, reading, speed)
        asked.append((measurement, reference.window(k)))
        u, _ = controller.step(*asked[-1])
        x, reading = plant.advance(x, u, controller.control_period, noise)
        speed = plant.rotor_speed
    return asked


def step_times(rounds: int, acados_python: str) -> tuple[dict[tuple[str, str], np.ndarray], str]:
    """(contestant, back end) -> seconds (rounds, steps, 2), wall and processor; and why acados is missing, if it is."""
    asked, contestants = asked_along_a_circle(), {}
    for backend in BACKENDS:
        for name in ("nominal_mpc", "rls_mpc"):
            config = compose([*BENCH, f"controller={name}", f"controller.backend={backend}"])
            vehicle = build_vehicle(config.vehicle)
            contestants[name, backend] = build_controller(config, vehicle, build_plant(vehicle, config.plant), None)
    times: dict[tuple[str, str], list[np.ndarray]] = {}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        others = _plain_acados(Path(name), stack, acados_python)
        for _ in range(rounds + 1):
            for key, controller in contestants.items():
                times.setdefault(key, []).append(_timed(controller, asked))
            for options, other in others.items():
                if answer := other.ask("measure"):
                    times.setdefault((f"acados {options}", "compiled"), []).append(np.array(answer["seconds"])[:, None])
        missing = next((other.missing for other in others.values() if other.missing), "")
    return {key: np.array(values[1:]) for key, values in times.items()}, missing  # the first round warms up


def _plain_acados(folder: Path, stack: ExitStack, python: str) -> dict[str, Acados]:
    """acados at work on the plain model, by options."""
    vehicle = build_vehicle(compose([]).vehicle)
    residual, numbers = make_residual("none", vehicle)
    controller = ModelPredictiveController(vehicle, residual, MPCSettings(), backend="auto")
    asked = fly_circle(make_plant("none", vehicle), controller, 500)
    (folder / "problem.json").write_text(json.dumps(problem(controller, numbers, asked)))
    others = {options: stack.enter_context(acados(python, folder, options)) for options in ("default", "best")}
    for other in others.values():
        other.wait_until_built(cores())
    return others


def _timed(controller: Any, asked: Asked) -> np.ndarray:
    """Wall and processor seconds of every step, (steps, 2)."""
    controller.reset(asked[0][0].state, asked[0][1])
    seconds = np.empty((len(asked), 2))
    gc.collect()
    gc.disable()
    for k, (measurement, window) in enumerate(asked):
        began = time.perf_counter(), time.thread_time()
        controller.step(measurement, window)
        seconds[k] = time.perf_counter() - began[0], time.thread_time() - began[1]
    gc.enable()
    return seconds


def measure(rounds: int, acados_python: str) -> dict[str, Any]:
    """Everything, by name and back end."""
    flights: dict[str, dict[str, float]] = {}
    for backend in BACKENDS:
        for name, action in (
            ("plant, Euler 1e-4 s", plant_flight("euler", 1e-4, backend)),
            ("plant, RK4 2.5e-3 s", plant_flight("rk4", 2.5e-3, backend)),
            ("closed loop, Example 1", closed_loop(backend)),
        ):
            flights.setdefault(name, {})[backend] = processor_time(action, rounds)
    times, missing = step_times(rounds, acados_python)
    steps = {
        f"{name}, {backend}": {
            "median": float(np.median(seconds[..., -1]) * 1e6),
            "p99": float(np.percentile(seconds[..., -1], 99) * 1e6),
            "p99.9": float(np.percentile(seconds[..., -1], 99.9) * 1e6),
        }
        for (name, backend), seconds in times.items()
        if not name.startswith("acados")
    }
    medians = {key: np.median(seconds[..., 0], axis=1) for key, seconds in times.items()}
    ours = medians["rls_mpc", "compiled"]
    ratios = {
        f"{name}, {backend}": float(np.median(ours / values))
        for (name, backend), values in medians.items()
        if backend == "compiled" and name != "rls_mpc"
    }
    return {"machine": machine(), "flights_s": flights, "step_us": steps, "ratios": ratios, "missing": missing}


def table(found: dict[str, Any]) -> str:
    """The measurement as Markdown."""
    lines = [found["machine"], "", "Processor seconds for 60 s of flight (limit):", ""]
    lines += ["| | " + " | ".join(BACKENDS) + " |", "|---|" + "---:|" * len(BACKENDS)]
    for name, seconds in found["flights_s"].items():
        cells = [f"{seconds[b]:.2f}" + (f" (< {LIMITS[name, b]:g})" if (name, b) in LIMITS else "") for b in BACKENDS]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    heads = ("median", "p99", "p99.9")
    lines += ["", "Microseconds of processor time a control step (a 100 Hz period has 10 000):", ""]
    lines += ["| step | " + " | ".join(heads) + " |", "|---|" + "---:|" * len(heads)]
    for name, figures in found["step_us"].items():
        lines.append(f"| {name} | " + " | ".join(f"{figures[h]:.0f}" for h in heads) + " |")
    lines += [
        "",
        f"Step of rls_mpc, compiled, over that of (limit {RATIO_LIMIT:g} for acados with the plain model):",
        "",
    ]
    lines += ["| step | ratio |", "|---|---:|"]
    lines += [f"| {name} | {ratio:.2f} |" for name, ratio in found["ratios"].items()]
    return "\n".join(lines + (["", f"acados is missing: {found['missing']}"] if found["missing"] else []))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--acados-python", default=sys.executable, help="interpreter that can import acados_template")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the tables")
    arguments = parser.parse_args()
    found = measure(arguments.rounds, arguments.acados_python)
    print(json.dumps(found) if arguments.json else table(found))


if __name__ == "__main__":
    main()
