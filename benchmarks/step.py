"""Time of one control step called from Python, compared with acados where it is importable.

    python -m benchmarks.step [--acados-python PYTHON] [--nodes 10 20] [--cases none gp20 ...]
    python -m benchmarks.step --bounded [...]              # with bounds active, see bounded.py

Both sides solve the same problem along the same states and references, taken from a closed loop of our controller on a
circle at 8 m/s with an exact model of the air and no active bound: set the measured state and the references, iterate
once, read the first input. (blade_element: our model contains the rotors' aerodynamics, acados uses the plain model
along the same states.) One core, garbage collector off, rounds alternating between the solvers; printed are the
quartiles of all steps, and the medians over the rounds of a round's 99th percentile and of its ratio of medians, which
are robust to speed changes of the machine between rounds. acados runs in separate processes (its libraries conflict
with CasADi's); options: acados_step.py.

"step" is what a user calls, ControlLoop.step along the reference of the loop; "answer" is the same after
ControlLoop.prepare. "compiled" and "interpreted" are ModelPredictiveController.command on both back ends, with the
reference as an argument; "prepare" and "feedback" are its two phases; beside them stand acados's, of its best options
through Python (rti_phase 1 and 2). Only feedback needs the measurement. "strongest call" is the shortest of acados's
own times in its C call (time_tot) over its options.

Two checks accompany the times. "same problem": some steps iterated to convergence by both solvers, largest difference
of the first input. "left by one iteration": difference between the first input after one iteration per step and the
converged one, median over the same steps. It depends on the warm start: ours shifts the last solution by the control
period, acados's does not.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.machine import cores, machine, pin
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.controller import as_controller
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.rollout import SampledReference
from quadexp.loop import ControlLoop
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.models.residual import Residual, no_residual
from quadexp.parts.compose import compose
from quadexp.physics.rotor import RotorGeometry
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.blade_element import static_coefficients
from quadexp.plugins.aerodynamics.coefficients import BladeCoefficients
from quadexp.plugins.gaussian_process.posterior import gaussian_process_residual, mean_only
from quadexp.plugins.papers.lei_li.blade_element import blade_element_residual
from quadexp.plugins.papers.lei_li.plant import BladeElementPlant
from quadexp.reference.circle import Circle
from quadexp.world import PlantEffects, SimplifiedPlant
from quadexp.world.base import Plant

CASES = ("none", "drag", "gp20", "gp100", "blade_element")
PLAIN = "blade_element"  # acados gets the plain model here: what does knowing the rotors cost?
BACKENDS = ("interpreted", "compiled")
ACADOS_OPTIONS = ("default", "best", "tuned", "expert")
SKIPPED = 50  # steps of the closed loop before the first that is measured
CONVERGE_EVERY = 25  # as in acados_step.py
CIRCLE = Circle(speed=8.0, acceleration=1.0)
DRAG = np.array([0.3, 0.3, 0.1])  # 1/s
QUADRATIC_DRAG = 0.012  # 1/m, in the cases with a GP
LENGTHSCALE = np.array([3.0, 3.0, 2.0])  # m/s
ROTOR = RotorGeometry(radius=0.12, chord=0.025, twist=np.pi / 12, air_density=1.205, reference_area=np.pi * 0.225**2)
COEFFICIENTS = BladeCoefficients(lift_slope=3.32, profile_drag=0.22, body_drag=(0.01, 0.01, 0.02))

# ratio and its limit; for the blade-element residual the second one is 0.6 and the others do not apply
RATIOS = {
    ("step", "acados best"): 0.065,
    ("step", "acados strongest call"): 0.35,
    ("answer", "acados feedback"): 0.1,
    ("compiled", "acados default"): 0.25,
    ("compiled", "acados best"): 0.15,
    ("interpreted", "acados default"): 1.0,
    ("compiled", "acados tuned"): None,
    ("compiled", "acados expert"): None,
    ("feedback", "acados feedback"): 0.5,
    ("feedback", "compiled"): None,
}
PHASES = ("prepare", "feedback")
LOOP = ("step", "answer")

Log = list[tuple[np.ndarray, np.ndarray, np.ndarray]]  # measured state (13,), references (N + 1, 13) and (N, n)


def gp_points(m: int) -> tuple[np.ndarray, np.ndarray]:
    """Inducing points (3, M) and weights (3, M) of three 1-D GPs on body velocity that model a smooth drag."""
    rng = np.random.default_rng(0)
    points = np.tile(np.linspace(-14, 14, m), (3, 1))
    weights = np.zeros((3, m))
    for axis, length in enumerate(LENGTHSCALE):
        v = points[axis]
        kernel = np.exp(-0.5 * ((v[:, None] - v) / length) ** 2)
        target = -DRAG[axis] * v - QUADRATIC_DRAG * v * np.abs(v) + 1e-2 * rng.standard_normal(m)
        weights[axis] = np.linalg.solve(kernel + 1e-2 * np.eye(m), target)
    return points, weights


def make_residual(case: str, vehicle: Vehicle, *, weighed: bool = False) -> tuple[Residual, dict[str, Any]]:
    """Residual of a case, and its numbers for the other side. weighed: a GP by its variance."""
    if case == "none":
        return no_residual(vehicle), {"kind": "none"}
    if case == "drag":
        return linear_drag_residual(vehicle, DRAG), {"kind": "linear_drag", "drag": DRAG.tolist()}
    if case == PLAIN:
        return blade_element_residual(vehicle, COEFFICIENTS), {"kind": "none"}
    points, weights = gp_points(int(case.removeprefix("gp")))
    outputs = [
        mean_only(f"a_{axis}", (f"v_{axis}",), points[i][:, None], weights[i], LENGTHSCALE[i : i + 1])
        for i, axis in enumerate("xyz")
    ]
    numbers = {"kind": "gp", "Z": points.tolist(), "alpha": weights.tolist(), "lengthscale": LENGTHSCALE.tolist()}
    return gaussian_process_residual(vehicle, outputs, weighed=weighed), numbers


def make_plant(case: str, vehicle: Vehicle) -> Plant:
    """The simulation whose air the residual of a case describes, without noise."""
    if case == PLAIN:
        return BladeElementPlant(vehicle, COEFFICIENTS, backend="auto")
    effects = PlantEffects.none()
    if case != "none":
        effects = replace(effects, linear_drag=tuple(vehicle.mass * DRAG))
    if case.startswith("gp"):
        effects = replace(effects, quadratic_drag=(vehicle.mass * QUADRATIC_DRAG,) * 3)
    return SimplifiedPlant(vehicle, effects, backend="auto")


def fly_circle(
    plant: Plant, controller: ModelPredictiveController, steps: int, *, jump: float = 0.0, every: int = 1
) -> Log:
    """What the controller was asked in each step of a closed loop on the circle, the quaternions on one hemisphere.

    jump: standard deviation (m) of a displacement of the vehicle in every `every`-th step; without it, no bound may be
    active.
    """
    reference = SampledReference(CIRCLE, controller)
    x, rng, log = reference.along()[0][0], np.random.default_rng(0), []
    plant.reset()
    controller.reset(x, *reference.horizon(0))
    for k in range(min(SKIPPED + steps, len(reference))):
        states, inputs = reference.horizon(k)
        if jump and k >= SKIPPED and k % every == 0:
            x = x + np.r_[jump * rng.normal(size=3), np.zeros(10)]
        if states[0, 3:7] @ x[3:7] < 0:
            states = states * np.r_[np.ones(3), -np.ones(4), np.ones(6)]
        u, record = controller.command(x, states, inputs)
        if k >= SKIPPED:
            if record.status != Status.OK and not jump:
                raise SystemExit(f"step {k}: a bound is active, the times would not compare")
            log.append((x, states, inputs))
        x, _ = plant.advance(x, u, controller.settings.control_period, rng)
    return log


def measure(controller: ModelPredictiveController, log: Log) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Seconds of each step, the first inputs, (K, n), and how many inputs of the horizon were at a bound, (K,)."""
    controller.reset(*log[0])
    for _ in range(100):
        controller.command(*log[0])
    controller.reset(*log[0])
    controller.command(*log[0])
    seconds, inputs, active = [], [], []
    gc.collect()
    gc.disable()
    for x, states, thrusts in log:
        began = time.perf_counter()
        u, record = controller.command(x, states, thrusts)
        seconds.append(time.perf_counter() - began)
        inputs.append(u)
        active.append(record.active)
    gc.enable()
    return np.array(seconds), np.array(inputs), np.array(active)


def measure_phases(controller: ModelPredictiveController, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Seconds of each step's preparation and of its feedback."""
    controller.reset(*log[0])
    controller.command(*log[0])
    for x, states, thrusts in log[:50]:
        controller.prepare(states, thrusts)
        controller.feedback(x)
    controller.reset(*log[0])
    controller.command(*log[0])
    seconds: tuple[list[float], list[float]] = [], []
    gc.collect()
    gc.disable()
    for x, states, thrusts in log:
        began = time.perf_counter()
        controller.prepare(states, thrusts)
        between = time.perf_counter()
        controller.feedback(x)
        seconds[1].append(time.perf_counter() - between)
        seconds[0].append(between - began)
    gc.enable()
    return np.array(seconds[0]), np.array(seconds[1])


def measure_loop(loop: ControlLoop, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Seconds of each step of a loop, and of each step that has been prepared."""
    seconds = []
    for prepare in (False, True):
        loop.reset(log[0][0])
        took = []
        gc.collect()
        gc.disable()
        for k, (x, _, _) in enumerate(log):
            t = (SKIPPED + k) * loop.period
            if prepare:
                loop.prepare(t)
            began = time.perf_counter()
            loop.step(x, t)
            took.append(time.perf_counter() - began)
        gc.enable()
        seconds.append(np.array(took))
    return seconds[0], seconds[1]


def converge(controller: ModelPredictiveController, log: Log) -> np.ndarray:
    """First inputs of every CONVERGE_EVERY-th step, each iterated to convergence from its reference."""
    inputs = []
    for step in log[::CONVERGE_EVERY]:
        controller.reset(*step)
        inputs.append(controller.command(*step)[0])
    return np.array(inputs)


def problem(controller: ModelPredictiveController, numbers: dict[str, Any], log: Log) -> dict[str, Any]:
    """The same problem for acados, as JSON."""
    settings, vehicle = controller.settings, controller.vehicle
    place = np.array(vehicle.rotor_position)
    states, xref, uref = (np.array(part).tolist() for part in zip(*log, strict=True))
    return {
        "mass": vehicle.mass,
        "inertia": np.diag(vehicle.inertia_matrix).tolist(),
        "rotor_x": place[:, 0].tolist(),
        "rotor_y": place[:, 1].tolist(),
        "torque_sign": list(vehicle.rotor_spin),
        "c_tau": vehicle.torque_coefficient,
        "u_min": vehicle.thrust_min,
        "u_max": vehicle.thrust_max,
        "Q": settings.state_weight().tolist(),
        "R": settings.thrust_weight(vehicle).tolist(),
        "terminal_weight": settings.terminal_weight,
        "horizon": settings.horizon,
        "nodes": settings.nodes,
        "residual": numbers,
        "states": states,
        "xref": xref,
        "uref": uref,
    }


class Acados:
    """acados_step.py at work on a problem, one process; `missing` says why there is none."""

    def __init__(self, process: subprocess.Popen, errors: Path) -> None:
        self._process, self._errors = process, errors
        self.missing = ""
        self.version = ""

    def wait_until_built(self, chosen: set[int]) -> None:
        """Returns when the solver is there, bound to the chosen cores (building it may take all of them)."""
        self.version = (self._read() or {}).get("acados", "")
        if not self.missing:
            pin(self._process.pid, chosen)

    def ask(self, question: str) -> dict[str, Any] | None:
        """The answer to "measure" or "converge"."""
        if self.missing:
            return None
        print(question, file=self._process.stdin, flush=True)
        return self._read()

    def _read(self) -> dict[str, Any] | None:
        line = self._process.stdout.readline()
        if line:
            return json.loads(line)
        self.missing = (self._errors.read_text().strip().splitlines() or ["no message"])[-1]
        return None


@contextmanager
def acados(python: str, folder: Path, options: str) -> Iterator[Acados]:
    """A process that builds acados's solver for folder/problem.json."""
    errors = folder / f"{options}.err"
    script = Path(__file__).with_name("acados_step.py")
    command = [python, str(script), "--problem", str(folder / "problem.json"), "--options", options]
    one_thread = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
    with errors.open("w") as stderr:
        process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            cwd=folder,
            env=os.environ | one_thread,
        )
    try:
        yield Acados(process, errors)
    finally:
        process.communicate()


def compare(vehicle: Vehicle, case: str, nodes: int, steps: int, rounds: int, acados_python: str) -> dict[str, Any]:
    """One row of the table: times of every contestant, ratios, differences of the first input."""
    if case == PLAIN:
        vehicle = replace(vehicle, rotor=ROTOR, thrust_coefficient=static_coefficients(ROTOR, COEFFICIENTS).thrust)
    residual, numbers = make_residual(case, vehicle)
    settings = MPCSettings(nodes=nodes)
    own = {name: ModelPredictiveController(vehicle, residual, settings, backend=name) for name in BACKENDS}
    plant = make_plant(case, vehicle)
    log = fly_circle(plant, own["compiled"], steps)
    looped = ModelPredictiveController(vehicle, residual, settings, backend="compiled")
    loop = ControlLoop(as_controller(looped), CIRCLE, plant)
    every = cores()
    one = {min(every)}
    seconds: dict[str, list[np.ndarray]] = {}
    inside: dict[str, list[np.ndarray]] = {}
    inputs, missing = {}, {}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        (folder / "problem.json").write_text(json.dumps(problem(own["compiled"], numbers, log)))
        others = {}
        for options in ACADOS_OPTIONS:
            other = others[f"acados {options}"] = stack.enter_context(acados(acados_python, folder, options))
            other.wait_until_built(one)
        pin(0, one)
        for _ in range(rounds):
            for name, controller in own.items():
                times, inputs[name], _ = measure(controller, log)
                seconds.setdefault(name, []).append(times)
            ours = *measure_loop(loop, log), *measure_phases(own["compiled"], log)
            for name, times in zip((*LOOP, *PHASES), ours, strict=True):
                seconds.setdefault(name, []).append(times)
            if answer := others["acados best"].ask("phases"):
                for name in PHASES:
                    seconds.setdefault(f"acados {name}", []).append(np.array(answer[name]))
            for name, other in others.items():
                if answer := other.ask("measure"):
                    if answer["failed"]:
                        raise SystemExit(f"{name}: cannot solve steps {answer['failed']}")
                    seconds.setdefault(name, []).append(np.array(answer["seconds"]))
                    inside.setdefault(name, []).append(np.array(answer["internal"]))
                    inputs[name] = np.array(answer["u0"])
        converged = {name: converge(controller, log) for name, controller in own.items()}
        for name, other in others.items():
            if answer := other.ask("converge"):
                converged[name] = np.array(answer["u0"])
            if other.missing:
                missing[name] = other.missing
        version = next((other.version for other in others.values() if other.version), "")
        pin(0, every)

    if inside:
        seconds["acados strongest call"] = min(inside.values(), key=lambda times: float(np.median(times)))
    micro = {name: 1e6 * np.array(times) for name, times in seconds.items()}  # (rounds, K)
    medians = {name: np.median(times, axis=1) for name, times in micro.items()}
    left = {name: np.abs(inputs[name][::CONVERGE_EVERY] - u).max(axis=1) for name, u in converged.items()}
    p99 = {name: np.median(np.percentile(times, 99, axis=1)) for name, times in micro.items()}
    return {
        "case": case,
        "nodes": nodes,
        "acados": version,
        "times_us": {
            name: dict(zip(("q25", "median", "q75"), np.percentile(micro[name], (25, 50, 75)).tolist(), strict=True))
            | {"p99": float(p99[name])}
            for name in medians
        },
        "ratios": {
            f"{a} / {b}": float(np.median(medians[a] / medians[b])) for a, b in RATIOS if a in medians and b in medians
        },
        "same_problem_N": {name: float(np.abs(u - converged["compiled"]).max()) for name, u in converged.items()},
        "left_by_one_iteration_N": {name: float(np.median(errors)) for name, errors in left.items()},
        "missing": missing,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown: times, then ratios, then agreement."""
    contestants, every = [*BACKENDS, *(f"acados {options}" for options in ACADOS_OPTIONS)], rows
    parts = ["Microseconds a step, median [quartiles] (99th percentile):", ""]
    parts += markdown(contestants, rows, lambda row, name: time_cell(row["times_us"].get(name)))
    called = [*LOOP, "acados strongest call"]
    parts += ["", "What a user calls, ControlLoop.step, and the shortest of acados's C calls:", ""]
    parts += markdown(called, rows, lambda row, name: time_cell(row["times_us"].get(name)))
    phases = [*PHASES, *(f"acados {name}" for name in PHASES)]
    parts += ["", "Phases of the compiled step and of acados best, before and after the measurement:", ""]
    parts += markdown(phases, rows, lambda row, name: time_cell(row["times_us"].get(name)))
    if any(row["ratios"] for row in rows):
        limits = ["-" if limit is None else f"<= {limit:g}" for limit in RATIOS.values()]
        ratios = [f"{a} / {b}" for a, b in RATIOS]
        parts += ["", "Ratios, with the limit promised:", ""]
        parts += markdown(ratios, rows, lambda row, name: number_cell(row["ratios"].get(name), ".3f"), limits)
    if any(row["case"] == PLAIN for row in rows):
        parts += ["", f"({PLAIN}: acados solves the plain model; compiled / acados best is to be <= 0.6)"]
    rows = [row for row in rows if row["case"] != PLAIN]  # not the same problem
    names = ["compiled", "acados default", "acados best"]
    parts += ["", "First input, same problem: largest difference of the converged ones (N):", ""]
    parts += markdown(names[1:], rows, lambda row, name: number_cell(row["same_problem_N"].get(name), ".0e"))
    parts += ["", "First input, left by one iteration: median distance to the converged one (N):", ""]
    parts += markdown(names, rows, lambda row, name: number_cell(row["left_by_one_iteration_N"].get(name), ".0e"))
    return "\n".join([*parts, "", *acados_lines(every)])


def acados_lines(rows: list[dict[str, Any]]) -> list[str]:
    """Which acados it was, or why there was none."""
    lines = [f"acados {version}" for version in sorted({row["acados"] for row in rows} - {""})]
    return lines + [f"acados is missing: {why}" for why in sorted({w for row in rows for w in row["missing"].values()})]


def markdown(
    columns: list[str], rows: list[dict[str, Any]], cell: Callable[[dict, str], str], limits: list[str] | None = None
) -> list[str]:
    cells = [[row["case"], str(row["nodes"]), *(cell(row, name) for name in columns)] for row in rows]
    lines = [["correction", "N", *columns], *([["limit", "", *limits]] if limits else []), *cells]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    lines.insert(1, ["-" * width for width in widths])
    return ["| " + " | ".join(text.ljust(w) for text, w in zip(line, widths, strict=True)) + " |" for line in lines]


def time_cell(figures: dict[str, float] | None) -> str:
    if figures is None:
        return "missing"
    return f"{figures['median']:.1f} [{figures['q25']:.1f}, {figures['q75']:.1f}] ({figures['p99']:.0f})"


def number_cell(value: float | None, form: str) -> str:
    return "missing" if value is None else format(value, form)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--acados-python", default=sys.executable, help="interpreter that can import acados_template")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--nodes", type=int, nargs="+", default=[10, 20])
    parser.add_argument("--cases", nargs="+", choices=CASES, help="default: all; with --bounded none and gp20")
    parser.add_argument("--bounded", action="store_true", help="steps with bounds active")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the tables")
    arguments = parser.parse_args()
    vehicle = build_vehicle(compose([]).vehicle)
    row, pages, cases = compare, table, CASES
    if arguments.bounded:
        from benchmarks import bounded

        row, pages, cases = bounded.compare, bounded.table, bounded.CASES
    rows = []
    for nodes in arguments.nodes:
        for case in arguments.cases or cases:
            print(f"{case}, N = {nodes} ...", file=sys.stderr, flush=True)
            rows.append(row(vehicle, case, nodes, arguments.steps, arguments.rounds, arguments.acados_python))
    print(json.dumps(rows) if arguments.json else f"{machine()}\n\n{pages(rows)}")


if __name__ == "__main__":
    main()
