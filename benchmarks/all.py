"""All benchmarks in one report.

    python -m benchmarks.all [--acados-python PYTHON] [--parts step plant flight waiting commands] [--out FOLDER]

step      one control step against acados where the given interpreter has it (benchmarks.step, N = 10)
plant     60 s of both simulated plants
flight    a 12 s closed loop at 100 control steps a second, both back ends: references, flight, log
waiting   waiting times besides the flights: composition, paths, repeating a finished sweep, empty jobs
commands  collect, fit-gp, a sweep of 16 flights, import, as a user runs them, each twice: the first run compiles

Prints Markdown; --out writes it to FOLDER/report.md and the numbers to FOLDER/report.json. Figures are medians
[quartiles] of wall-clock time, and processor time, which other load on the machine does not increase.
benchmarks.pipeline and benchmarks.scaling measure sweeps at full size; benchmarks.profile shows where the time goes.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import pipeline, step
from benchmarks.machine import machine
from quadexp import __version__
from quadexp.compile.backend import compiler
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.parts.compose import compose, session
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.blade_element import static_coefficients
from quadexp.plugins.papers.lei_li.plant import BladeElementPlant
from quadexp.reference.circle import Circle
from quadexp.reference.random_polynomial import RandomPolynomial
from quadexp.sweeps.engine import Workers
from quadexp.sweeps.sweep import run_sweep
from quadexp.world import SimplifiedPlant

PARTS = ("step", "plant", "flight", "waiting", "commands")
CASES = ("none", "gp20", step.PLAIN)
CONTROL_RATE = 100.0  # Hz
REPEATS = {"compiled": 9, "interpreted": 3}
SWEEP = ["trajectory=circle,lemniscate", "trajectory.speed=4,8", "controller=nominal_mpc,perfect_mpc", "seed=range(2)"]
Row = dict[str, Any]


def backends() -> list[str]:
    """Those that this machine has, the fast one first."""
    return ["compiled", "interpreted"] if compiler() else ["interpreted"]


def timed(name: str, work: Callable[[], Any], repeats: int, limit: float | None = None) -> Row:
    """Quartiles of the seconds that the work takes once it is warm, and its median processor time."""
    work()
    wall, processor = [], []
    for _ in range(repeats):
        began, spent = time.perf_counter(), time.process_time()
        work()
        wall.append(time.perf_counter() - began)
        processor.append(time.process_time() - spent)
    q25, median, q75 = np.percentile(wall, (25, 50, 75))
    return {"what": name, "s": median, "q25": q25, "q75": q75, "cpu": float(np.median(processor)), "limit": limit}


def plants(vehicle: Vehicle) -> Iterator[Row]:
    """60 s of each plant in hover, in periods of 10 ms."""
    rotors = static_coefficients(step.ROTOR, step.COEFFICIENTS).thrust
    for backend in backends():
        blades = replace(vehicle, rotor=step.ROTOR, thrust_coefficient=rotors)
        made = {
            "simplified plant, 0.5 ms": (SimplifiedPlant(vehicle, backend=backend), None),
            "blade-element plant, 0.1 ms": (
                BladeElementPlant(blades, step.COEFFICIENTS, backend=backend),
                0.5 if backend == "compiled" else 3.0,
            ),
        }
        for name, (plant, limit) in made.items():

            def work(plant: Any = plant) -> None:
                plant.reset()
                x, rng = np.r_[np.zeros(3), 1.0, np.zeros(9)], np.random.default_rng(0)
                hover = np.full(4, plant.vehicle.hover_thrust)
                for _ in range(6000):
                    x, _ = plant.advance(x, hover, 0.01, rng)
                    x[:3] = 0.0  # nothing holds it: stay near hover
                    x[3:] = (1.0, *np.zeros(9))

            yield timed(f"60 s of the {name}, {backend}", work, REPEATS[backend] // 3, limit)


def flights(vehicle: Vehicle) -> Iterator[Row]:
    """The closed loop of one process whose functions are compiled already."""
    for backend in backends():
        for case in ("none", "gp20"):
            residual, _ = step.make_residual(case, vehicle)
            settings = MPCSettings(rate=CONTROL_RATE)
            controller = ModelPredictiveController(vehicle, residual, settings, backend=backend)
            plant = SimplifiedPlant(vehicle, backend=backend)

            def work(controller: Any = controller, plant: Any = plant) -> None:
                reference = SampledReference(Circle(speed=8.0, acceleration=2.0), controller)
                fly(plant, controller, reference, np.random.default_rng(0))

            limit = 0.15 if backend == "compiled" else None
            yield timed(f"flight of 12 s at 100 Hz, {case}, {backend}", work, REPEATS[backend], limit)


def waiting() -> Iterator[Row]:
    """What a user waits for beside flying: configurations, paths, data, checkpoints, a finished sweep again."""
    with tempfile.TemporaryDirectory(prefix="quadexp-benchmark-") as name, session() as composer:
        path = RandomPolynomial(speed=1.0, seed=0, extent=12.0)
        t = np.linspace(0, path.duration, 15_000)
        yield timed("a random path at 15,000 times", lambda: path.flat_output(t), 9)
        sweep = ["seed=range(300)", "trajectory.speed=4"]
        yield timed("composition of 300 cells", lambda: composer.expand(sweep), 9)
        cells = composer.expand(["trajectory.duration=2", "trajectory=hover", "seed=range(100)"])
        run_sweep(cells, name)
        yield timed("a finished sweep of 100 flights again", lambda: run_sweep(cells, name), 9)
        jobs = {str(i): (i,) for i in range(300)}
        yield timed("300 empty jobs on 2 workers", lambda: empty_jobs(jobs), 3)


def empty_jobs(jobs: dict[str, tuple[int]]) -> None:
    """Jobs that do nothing, in processes of their own."""
    with Workers(2, preload=()) as processes:
        deque(processes.run(abs, jobs), 0)


def commands() -> Iterator[Row]:
    """Commands of the pipeline in a folder and with a cache of their own."""
    pipeline.adopt_orphans()
    with tempfile.TemporaryDirectory(prefix="quadexp-benchmark-") as name:
        folder = Path(name)
        flight = ["simulate", "trajectory=circle", "trajectory.speed=8"]
        for turn in ("first", "again"):
            steps = {
                "simulate": [*flight, "--out", f"{turn}.parquet"],
                "collect, 60 s": ["collect", "collect.duration=60", "--out", f"{turn}_data.parquet"],
                "fit-gp, 60 s of flight": ["fit-gp", f"{turn}_data.parquet", "--out", f"{turn}_gp"],
                "sweep of 16 flights, 2 workers": [
                    "evaluate", "--sweep", *SWEEP, "evaluate.workers=2", "--no-figures", "--out", f"{turn}_results",
                ],
                "export": ["export", f"{turn}.parquet", "--to", "csv", "--out", f"{turn}.csv"],
                "import": ["import", f"{turn}.csv", "--keep", "--out", f"{turn}_flights"],
            }  # fmt: skip
            for name, command in steps.items():
                print(f"{name}, {turn} ...", file=sys.stderr, flush=True)
                row: Row = {"what": f"quadexp {name} ({turn})", "limit": None}
                try:
                    found = pipeline.run(command, folder)
                    yield row | {"s": found.seconds, "cpu": found.processor, "memory": found.memory}
                except SystemExit as error:
                    yield row | {"missing": str(error)}


def table(rows: list[Row]) -> str:
    """Rows as Markdown."""
    lines = [
        "| what | s [quartiles] | processor s | GB | promised |",
        "| ---- | ------------: | ----------: | --: | -------: |",
    ]
    for row in rows:
        if "missing" in row:
            lines.append(f"| {row['what']} | missing: {row['missing']} | | | |")
            continue
        spread = f" [{row['q25']:.3g}, {row['q75']:.3g}]" if "q25" in row else ""
        memory = f"{row['memory']:.2f}" if "memory" in row else ""
        promised = f"<= {row['limit']:g}" if row["limit"] else ""
        lines.append(f"| {row['what']} | {row['s']:.3g}{spread} | {row['cpu']:.3g} | {memory} | {promised} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--acados-python", default=sys.executable, help="interpreter that can import acados_template")
    parser.add_argument("--parts", nargs="+", choices=PARTS)
    parser.add_argument("--out", type=Path, metavar="FOLDER", help="write report.md and report.json there")
    arguments = parser.parse_args()
    parts = arguments.parts or PARTS
    vehicle = build_vehicle(compose([]).vehicle)
    report: dict[str, Any] = {"quadexp": __version__, "machine": machine()}
    pages = [f"quadexp {__version__}; {report['machine']}"]
    if "step" in parts:
        for case in CASES:
            print(f"step, {case} ...", file=sys.stderr, flush=True)
            compared = step.compare(vehicle, case, 10, 500, 5, arguments.acados_python)
            report.setdefault("step", []).append(compared)
        pages.append("## Control step, N = 10\n\n" + step.table(report["step"]))
    for name, heading, rows in (
        ("plant", "Plants", lambda: plants(vehicle)),
        ("flight", "Closed loop", lambda: flights(vehicle)),
        ("waiting", "Waiting", waiting),
        ("commands", "Commands", commands),
    ):
        if name in parts:
            print(f"{name} ...", file=sys.stderr, flush=True)
            report[name] = list(rows())
            pages.append(f"## {heading}\n\n{table(report[name])}")
    text = "\n\n".join(pages)
    print(text)
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        (arguments.out / "report.md").write_text(text + "\n")
        (arguments.out / "report.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
