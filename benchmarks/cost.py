"""How the cost grows: of a control step with nodes, inducing points and rotors, of a sweep with its cells.

    python -m benchmarks.cost [--parts nodes points rotors cells] [--figure docs/figures/cost.svg] [--json]

Each part is a size against the time of the median step (compiled, as called from Python, no model of the air except in
`points`: three one-dimensional GPs with so many points each; 0.1 s a node), or against the processor time of a whole
sweep of flights of 0.1 s in one process, written with its table. Rounds alternate between the sizes of a part (sweeps:
one round). Printed are the medians over the rounds, their ratios to the smallest size, and the exponent between
neighbouring sizes (1: proportional).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.machine import cores, machine, pin
from benchmarks.step import Log, fly_circle, make_plant, make_residual, measure
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.build import build_vehicle
from quadexp.parts.compose import compose, session
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.drawing.style import BLUE, styled
from quadexp.sweeps.sweep import SweepRequest, run_sweep

SIZES = {"nodes": (5, 10, 20, 40, 80), "points": (5, 20, 100, 300, 1000), "rotors": (4, 5, 6, 7, 8)}
SIZES["cells"] = (50, 500, 5000)
LABELS = {"nodes": "nodes N", "points": "inducing points M of each GP", "rotors": "rotors", "cells": "cells of a sweep"}
NODE = 0.1  # s
STEPS = 200  # of a round
Measured = Callable[[], float]  # processor seconds of one round


def ring(vehicle: Vehicle, rotors: int) -> Vehicle:
    """The vehicle with its thrust on so many rotors, on a circle; an odd one has a neighbour of its own spin."""
    angles = 2 * np.pi * (np.arange(rotors) + 0.5) / rotors
    arm = float(np.linalg.norm(np.array(vehicle.rotor_position)[0]))
    place = tuple((float(arm * np.cos(a)), float(arm * np.sin(a)), 0.0) for a in angles)
    spin = tuple(1.0 if i % 2 else -1.0 for i in range(rotors))
    largest = vehicle.thrust_max * vehicle.n_rotors / rotors
    return replace(vehicle, rotor_position=place, rotor_spin=spin, thrust_max=largest)


def step_of(vehicle: Vehicle, case: str, nodes: int = 10) -> Measured:
    """The median step of a flight on the circle."""
    settings = MPCSettings(nodes=nodes, horizon=NODE * nodes)
    controller = ModelPredictiveController(vehicle, make_residual(case, vehicle)[0], settings, backend="compiled")
    log: Log = fly_circle(make_plant(case, vehicle), controller, STEPS)
    return lambda: float(np.median(measure(controller, log)[0]))


def sweep_of(cells: int) -> Measured:
    """A whole sweep, composed, flown in this process and written."""

    def work() -> float:
        with tempfile.TemporaryDirectory(prefix="quadexp-benchmark-") as folder, session() as composer:
            began = time.process_time()
            keys = ["trajectory=hover", "trajectory.duration=0.1", "controller=nominal_mpc", f"seed=range({cells})"]
            run_sweep(composer.expand(keys), folder, SweepRequest(isolate=False))
            return time.process_time() - began

    return work


def part(name: str, vehicle: Vehicle) -> dict[int, Measured]:
    """A part's contestants by size."""
    if name == "cells":
        sweep_of(min(SIZES[name]))()  # compiles, and imports what a sweep needs
        return {size: sweep_of(size) for size in SIZES[name]}
    if name == "nodes":
        return {size: step_of(vehicle, "none", size) for size in SIZES[name]}
    if name == "points":
        return {size: step_of(vehicle, f"gp{size}") for size in SIZES[name]}
    return {size: step_of(ring(vehicle, size), "none") for size in SIZES[name]}


def growth(name: str, vehicle: Vehicle, rounds: int) -> dict[str, Any]:
    """Seconds by size, ratios to the smallest, and exponents between neighbours."""
    contestants = part(name, vehicle)
    every = cores()
    pin(0, {min(every)})
    seconds: dict[int, list[float]] = {size: [] for size in contestants}
    for _ in range(1 if name == "cells" else rounds):  # in turn, so that a slow moment of the machine meets all sizes
        for size, work in contestants.items():
            seconds[size].append(work())
    pin(0, every)
    sizes, medians = np.array([*seconds]), np.array([np.median(times) for times in seconds.values()])
    exponents = np.diff(np.log(medians)) / np.diff(np.log(sizes))
    return {
        "part": name,
        "sizes": sizes.tolist(),
        "seconds": medians.tolist(),
        "ratios": (medians / medians[0]).tolist(),
        "exponents": exponents.tolist(),
    }


def table(rows: list[dict[str, Any]]) -> str:
    """A part a table, as Markdown."""
    lines = []
    for row in rows:
        unit, scale = ("s a sweep", 1.0) if row["part"] == "cells" else ("us a step", 1e6)
        exponents = [None, *row["exponents"]]
        lines += [f"| {LABELS[row['part']]} | {unit} | ratio | exponent |", "|--:|--:|--:|--:|"]
        for size, seconds, ratio, exponent in zip(row["sizes"], row["seconds"], row["ratios"], exponents, strict=True):
            said = "" if exponent is None else f"{exponent:.2f}"
            lines.append(f"| {size} | {scale * seconds:.3g} | {ratio:.2f} | {said} |")
        lines.append("")
    return "\n".join(lines)


@styled
def figure(rows: list[dict[str, Any]]) -> Figure:
    """Ratio to the smallest size against size, a panel a part; the dashed line is proportional."""
    drawn = Figure(figsize=(2.6 * len(rows), 2.6), layout="constrained")
    for axes, row in zip(np.atleast_1d(drawn.subplots(1, len(rows))), rows, strict=True):
        sizes = np.array(row["sizes"], float)
        axes.loglog(sizes, row["ratios"], "o-", color=BLUE, label="measured")
        axes.loglog(sizes, sizes / sizes[0], "--", color="#777777", label="proportional")
        axes.set_xticks(sizes, [f"{size:g}" for size in sizes])
        axes.minorticks_off()
        axes.set_xlabel(LABELS[row["part"]])
        axes.set_title("sweep" if row["part"] == "cells" else "control step")
    drawn.axes[0].set_ylabel("cost relative to the smallest")
    drawn.axes[0].legend()
    return drawn


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", nargs="+", choices=[*SIZES], default=[*SIZES])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--figure", type=Path, metavar="FILE", help="draw it there (.svg, .png, .pdf)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the tables")
    arguments = parser.parse_args()
    vehicle, rows = build_vehicle(compose([]).vehicle), []
    for name in arguments.parts:
        print(f"{name} ...", file=sys.stderr, flush=True)
        rows.append(growth(name, vehicle, arguments.rounds))
    if arguments.figure is not None:
        figure(rows).savefig(arguments.figure, metadata={"Date": None} if arguments.figure.suffix == ".svg" else None)
    print(json.dumps(rows) if arguments.json else f"{machine()}\n\n{table(rows)}")


if __name__ == "__main__":
    main()
