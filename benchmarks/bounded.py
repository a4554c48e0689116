"""Time of a control step with bounds active, for `benchmarks.step --bounded`.

The hard case: the circle at 8 m/s with a thrust limit of twice the hover thrust, and a position disturbance of a metre
(standard deviation on each axis) every 15 steps. All else is as in step.py: the same states and references for all
solvers, separate processes, alternating rounds. Only steps in which our controller has an active bound are counted; the
first 50 steps of the circle, before the first disturbance, are not measured.

`inside` is acados's own time in its C call (time_tot); all other times are measured in Python. `unbounded` is our
compiled step along the same circle without disturbances and limit, in the same run.
"""

from __future__ import annotations

import json
import tempfile
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import step
from benchmarks.machine import cores, pin
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.physics.vehicle import Vehicle

CASES = ("none", "gp20")
LIMIT = 2.0  # of the hover thrust
JUMP, EVERY = 1.0, 15  # m, steps
OPTIONS = ("default", "best", "tuned", "expert", "hpipm")
PYTHON = [f"acados {option}" for option in OPTIONS]
INSIDE = [f"{name}, inside" for name in PYTHON]
RATIOS = [
    ("compiled", "median", "acados best", 0.25),
    ("compiled", "median", "strongest inside", 0.9),
    ("compiled", "p99", "acados best", 1.0),
    ("compiled", "median", "unbounded", None),
    ("interpreted", "median", "compiled", None),
]


def compare(vehicle: Vehicle, case: str, nodes: int, steps: int, rounds: int, acados_python: str) -> dict[str, Any]:
    """One row of the table: times of every contestant over the steps with bounds active, ratios, differences."""
    settings = MPCSettings(nodes=nodes)

    def controller(vehicle: Vehicle, backend: str) -> ModelPredictiveController:
        return ModelPredictiveController(vehicle, step.make_residual(case, vehicle)[0], settings, backend=backend)

    limited = replace(vehicle, thrust_max=LIMIT * vehicle.hover_thrust)
    own = {name: controller(limited, name) for name in step.BACKENDS}
    free = controller(vehicle, "compiled")
    plant, numbers = step.make_plant(case, limited), step.make_residual(case, limited)[1]
    log = step.fly_circle(plant, own["compiled"], steps, jump=JUMP, every=EVERY)
    calm = step.fly_circle(step.make_plant(case, vehicle), free, steps)
    every = cores()
    one = {min(every)}
    micro: dict[str, list[np.ndarray]] = {}
    first, failed, missing = {}, {}, {}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        (folder / "problem.json").write_text(json.dumps(step.problem(own["compiled"], numbers, log)))
        others = {}
        for options in OPTIONS:
            other = others[f"acados {options}"] = stack.enter_context(step.acados(acados_python, folder, options))
            other.wait_until_built(one)
        pin(0, one)
        for _ in range(rounds):
            micro.setdefault("unbounded", []).append(1e6 * step.measure(free, calm)[0])
            for name, contestant in own.items():
                seconds, first[name], active = step.measure(contestant, log)
                micro.setdefault(name, []).append(1e6 * seconds[active > 0])
            for name, other in others.items():
                if answer := other.ask("measure"):
                    first[name], failed[name] = np.array(answer["u0"]), len(answer["failed"])
                    for key, part in ((name, "seconds"), (f"{name}, inside", "internal")):
                        micro.setdefault(key, []).append(1e6 * np.array(answer[part])[active > 0])
        missing = {name: other.missing for name, other in others.items() if other.missing}
        version = next((other.version for other in others.values() if other.version), "")
        pin(0, every)

    figures = {
        "median": {name: np.array([np.median(times) for times in rounds]) for name, rounds in micro.items()},
        "p99": {name: np.array([np.percentile(times, 99) for times in rounds]) for name, rounds in micro.items()},
    }
    medians = figures["median"]
    if inside := [name for name in INSIDE if name in medians]:
        medians["strongest inside"] = medians[min(inside, key=lambda name: np.median(medians[name]))]
    return {
        "case": case,
        "nodes": nodes,
        "acados": version,
        "steps": int(np.count_nonzero(active)),
        "active": float(np.median(active[active > 0])),
        "times_us": {
            name: dict(zip(("q25", "median", "q75"), np.percentile(times, (25, 50, 75)).tolist(), strict=True))
            | {"p99": float(np.median(figures["p99"][name]))}
            for name, times in micro.items()
        },
        "ratios": {
            f"{a} ({kind}) / {b}": float(np.median(figures[kind][a] / medians[b]))
            for a, kind, b, _ in RATIOS
            if b in medians
        },
        "first_input_N": {
            name: float(np.nanmedian(np.abs(u - first["compiled"])[active > 0].max(axis=1)))
            for name, u in first.items()
        },
        "failed": failed,
        "missing": missing,
    }


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as Markdown: times, ratios, first inputs."""
    parts = [
        "Microseconds a step with bounds active, median [quartiles] (99th percentile); unbounded: without them:",
        "",
    ]
    names = ["unbounded", *step.BACKENDS, *PYTHON, *INSIDE]
    present = [name for name in names if any(name in row["times_us"] for row in rows)]
    parts += step.markdown(present, rows, lambda row, name: step.time_cell(row["times_us"].get(name)))
    parts += ["", "Ratios, with the limit promised:", ""]
    limits = ["-" if limit is None else f"<= {limit:g}" for *_, limit in RATIOS]
    ratios = [f"{a} ({kind}) / {b}" for a, kind, b, _ in RATIOS]
    parts += step.markdown(ratios, rows, lambda row, name: step.number_cell(row["ratios"].get(name), ".2f"), limits)
    parts += ["", "Steps counted, inputs of the horizon at a bound (median), steps that acados could not solve:", ""]
    counts = ["steps", "active", *PYTHON]
    parts += step.markdown(counts, rows, lambda row, name: str(row.get(name, row["failed"].get(name, "missing"))))
    parts += ["", "First input, median distance to ours, compiled (N; acados does not move its guess forward):", ""]
    others = ["interpreted", *PYTHON]
    parts += step.markdown(others, rows, lambda row, name: step.number_cell(row["first_input_N"].get(name), ".0e"))
    return "\n".join([*parts, "", *step.acados_lines(rows)])
