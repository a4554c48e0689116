"""Stress test of the controller with thousands of extreme states and references, in one table.

    python -m benchmarks.stress                            # 10,000 steps for every model of the air, compiled
    python -m benchmarks.stress --steps 500 --backend interpreted

Every step must return an input within its bounds or a named failure, in bounded time. A trial draws a situation (see
SITUATIONS), resets the controller, and runs STEPS_EACH steps with jumping states; the first of them iterates up to 20
times, the others once.
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.machine import machine
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import TOLERANCE, ModelPredictiveController
from quadexp.errors import QuadexpError
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.models.residual import Residual, no_residual
from quadexp.physics.rotor import RotorGeometry
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.blade_element import static_coefficients
from quadexp.plugins.aerodynamics.coefficients import BladeCoefficients
from quadexp.plugins.gaussian_process.posterior import gaussian_process_residual, mean_only
from quadexp.plugins.papers.lei_li.blade_element import blade_element_residual

STEPS_EACH = 4
BLADE = BladeCoefficients(lift_slope=3.32, profile_drag=0.22, body_drag=(0.01, 0.01, 0.02))  # Lei & Li 2017, Table 1
Window = tuple[np.ndarray, np.ndarray, np.ndarray]  # measured state (13,), states (N + 1, 13), inputs (N, n)


def stress_vehicle() -> Vehicle:
    """The quadrotor of Torrente et al. 2021 with the rotors of Lei & Li 2017."""
    arm, rotor = 0.235 / math.sqrt(2), RotorGeometry(0.12, 0.025, math.pi / 12, 1.205, math.pi * 0.225**2)
    return Vehicle(
        name="stress",
        mass=1.0,
        inertia=((0.03, 0, 0), (0, 0.03, 0), (0, 0, 0.06)),
        rotor_position=((arm, -arm, 0), (-arm, -arm, 0), (-arm, arm, 0), (arm, arm, 0)),
        rotor_spin=(-1, 1, -1, 1),
        torque_coefficient=0.013,
        thrust_min=0.0,
        thrust_max=20.0,
        rate_max=20.0,
        rotor=rotor,
        thrust_coefficient=static_coefficients(rotor, BLADE).thrust,
    )


def stress_residuals(vehicle: Vehicle) -> dict[str, Residual]:
    """One model of the air of every kind, with numbers of the size that fits give."""
    rng = np.random.default_rng(5)
    outputs = [
        mean_only(f"a_{axis}", (f"v_{axis}",), rng.uniform(-12, 12, (20, 1)), rng.normal(size=20), np.array([4.0]))
        for axis in "xyz"
    ]
    return {
        "none": no_residual(vehicle),
        "linear_drag": linear_drag_residual(vehicle, (0.5, 0.6, 0.1), (0.02, -0.01, 0.1), -0.015),
        "gaussian_process": gaussian_process_residual(vehicle, outputs),
        "blade_element": blade_element_residual(vehicle, BLADE),
    }


def pinched(vehicle: Vehicle) -> Vehicle:
    """The vehicle with next to no thrust to choose from: a thousandth around hover."""
    return replace(vehicle, thrust_min=0.999 * vehicle.hover_thrust, thrust_max=1.001 * vehicle.hover_thrust)


def _turned(rng: np.random.Generator, count: int) -> np.ndarray:
    q = rng.normal(size=(count, 4))
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def _flight(rng: np.random.Generator, vehicle: Vehicle, nodes: int, speed: float = 8.0) -> Window:
    """Straight flight, the vehicle near its reference."""
    states = np.zeros((nodes + 1, 13))
    velocity = speed * rng.normal(size=3) * [1, 1, 0.3]
    states[:, :3] = 0.1 * np.arange(nodes + 1)[:, None] * velocity
    states[:, 3], states[:, 7:10] = 1.0, velocity
    x = states[0] + 0.2 * rng.normal(size=13)
    x[3:7] /= np.linalg.norm(x[3:7])
    return x, states, np.full((nodes, vehicle.n_rotors), vehicle.hover_thrust)


def _tumbling(rng, vehicle, nodes) -> Window:
    x, states, inputs = _flight(rng, vehicle, nodes)
    x[3:7], x[7:10], x[10:13] = _turned(rng, 1)[0], 10 * rng.normal(size=3), 15 * rng.normal(size=3)
    return x, states, inputs


def _far(rng, vehicle, nodes) -> Window:
    x, states, inputs = _flight(rng, vehicle, nodes)
    x[:3] += 10 ** rng.uniform(1, 4) * rng.normal(size=3)
    return x, states, inputs


def _jumping(rng, vehicle, nodes) -> Window:
    """A reference that jumps from node to node, attitude and inputs too."""
    x, states, inputs = _flight(rng, vehicle, nodes)
    states[:, :3] += 20 * rng.normal(size=(nodes + 1, 3))
    states[:, 3:7] = _turned(rng, nodes + 1)
    states[:, 7:] += 10 * rng.normal(size=(nodes + 1, 6))
    return x, states, vehicle.thrust_max * rng.uniform(-0.5, 1.5, inputs.shape)


def _saturated(rng, vehicle, nodes) -> Window:
    """More thrust than there is, or less than none, is asked for all along."""
    x, states, inputs = _flight(rng, vehicle, nodes)
    states[:, 2] += rng.choice([-1, 1]) * 30 * np.linspace(0, 1, nodes + 1) ** 2
    states[:, 9] += rng.choice([-20, 20])
    return x, states, inputs * rng.choice([0.0, 8.0])


def _falling(rng, vehicle, nodes) -> Window:
    """Upside down and fast, rotors off."""
    x, states, inputs = _flight(rng, vehicle, nodes)
    x[3:7], x[9] = [0, 1, 0, 0], -40 * rng.uniform()
    return x, states, 0 * inputs


def _extreme(rng, vehicle, nodes) -> Window:
    """Finite numbers far from any flight: up to 1e6 m/s, 1e4 rad/s, 1e8 m."""
    x, states, inputs = _flight(rng, vehicle, nodes)
    x[:3] *= 10 ** rng.uniform(0, 8)
    x[7:10] *= 10 ** rng.uniform(0, 6)
    x[10:13] *= 10 ** rng.uniform(0, 4)
    return x, states, inputs


def _broken_measurement(rng, vehicle, nodes) -> Window:
    x, states, inputs = _flight(rng, vehicle, nodes)
    x[rng.integers(13, size=rng.integers(1, 4))] = rng.choice([np.nan, np.inf, -np.inf])
    return x, states, inputs


def _broken_reference(rng, vehicle, nodes) -> Window:
    x, states, inputs = _flight(rng, vehicle, nodes)
    target = states if rng.uniform() < 0.5 else inputs
    target[rng.integers(len(target)), rng.integers(target.shape[1])] = rng.choice([np.nan, np.inf])
    return x, states, inputs


SITUATIONS: dict[str, Callable[..., Window]] = {
    "flight": _flight,
    "tumbling": _tumbling,
    "far": _far,
    "jumping reference": _jumping,
    "saturated": _saturated,
    "falling": _falling,
    "extreme": _extreme,
    "broken measurement": _broken_measurement,
    "broken reference": _broken_reference,
}


@dataclass
class Outcome:
    """What the steps ended in. times: s, of the steps that iterate once; cold: s, of first steps.

    counts: steps by status, or "refused" for a named error. wrong: one line for every step that broke the promise.
    """

    counts: Counter = field(default_factory=Counter)
    by_situation: dict[str, Counter] = field(default_factory=dict)
    times: list[float] = field(default_factory=list)
    cold: list[float] = field(default_factory=list)
    sweeps: int = 0
    wrong: list[str] = field(default_factory=list)

    def percentile(self, share: float) -> float:
        """Of the solve times of ordinary steps (s)."""
        return float(np.percentile(self.times, share))


def stress(controllers: list[ModelPredictiveController], steps: int, seed: int = 0) -> Outcome:
    """Send the controllers through `steps` steps in all; see the module's docstring."""
    rng, outcome, done = np.random.default_rng(seed), Outcome(), 0
    names = list(SITUATIONS)
    while done < steps:
        controller, name = controllers[done // STEPS_EACH % len(controllers)], names[rng.integers(len(names))]
        vehicle, nodes, make = controller.vehicle, controller.settings.nodes, SITUATIONS[name]
        x, states, inputs = make(rng, vehicle, nodes)
        sound = _flight(rng, vehicle, nodes)
        controller.reset(*(sound if name.startswith("broken") else (x, states, inputs)))
        counts = outcome.by_situation.setdefault(name, Counter())
        for step in range(STEPS_EACH):
            if step:
                x, states, inputs = make(rng, vehicle, nodes)
            key = _one_step(controller, (x, states, inputs), outcome, f"{name}, seed {seed}, step {done}", step == 0)
            counts[key] += 1
            done += 1
            if name.startswith("broken") and step == STEPS_EACH - 1:  # it flies on with the next sound measurement
                _one_step(controller, sound, outcome, f"after {name}, seed {seed}, step {done}", None)
    return outcome


def _one_step(controller, window: Window, outcome: Outcome, where: str, cold: bool | None) -> str:
    """One step, checked; cold None: only checked, and it must not fail."""
    vehicle = controller.vehicle
    try:
        u, record = controller.command(*window)
    except QuadexpError as error:
        if cold is None:
            outcome.wrong.append(f"{where}: {error}")
        outcome.counts["refused"] += cold is not None
        return "refused"
    inside = (u >= vehicle.thrust_min - TOLERANCE).all() and (u <= vehicle.thrust_max + TOLERANCE).all()
    if not (np.isfinite(u).all() and inside):
        outcome.wrong.append(f"{where}: {record.status.name} with input {u}")
    if not all(np.isfinite(part).all() for part in controller.prediction):
        outcome.wrong.append(f"{where}: {record.status.name} leaves a prediction that is not finite")
    if record.status == Status.FAILED and cold is None:
        outcome.wrong.append(f"{where}: failed on a sound measurement")
    if cold is not None:
        outcome.counts[record.status.name] += 1
        (outcome.cold if cold else outcome.times).append(record.solve_time)
        outcome.sweeps = max(outcome.sweeps, record.sweeps)
    return record.status.name


def make_controllers(residual: str, backend: str = "auto") -> list[ModelPredictiveController]:
    """The controller with the model of the air, for the vehicle and for the pinched one."""
    return [
        ModelPredictiveController(vehicle, stress_residuals(vehicle)[residual], backend=backend)
        for vehicle in (stress_vehicle(), pinched(stress_vehicle()))
    ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--backend", default="auto")
    options = parser.parse_args()
    ends = [*(status.name for status in Status), "refused"]
    heads = ["model", *(end.lower() for end in ends), "median", "p99", "p99.9", "max", "cold max", "wrong"]
    print(f"{machine()}\n{options.steps} steps each, seed {options.seed}, back end {options.backend}")
    print("times in us, of steps that iterate once (cold: the first of a flight)\n")
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    wrong, situations = [], {}
    for name in stress_residuals(stress_vehicle()):
        outcome = stress(make_controllers(name, options.backend), options.steps, options.seed)
        times = [outcome.percentile(share) for share in (50, 99, 99.9)] + [max(outcome.times), max(outcome.cold)]
        cells = [*(outcome.counts[end] for end in ends), *(f"{1e6 * t:.0f}" for t in times), len(outcome.wrong)]
        print(f"| {name} | " + " | ".join(map(str, cells)) + " |", flush=True)
        wrong += [f"{name}: {line}" for line in outcome.wrong]
        for situation, counts in outcome.by_situation.items():
            situations.setdefault(situation, Counter()).update(counts)
    print("\n| situation | " + " | ".join(name.lower() for name in ends) + " |")
    print("|---" * (len(ends) + 1) + "|")
    for situation in SITUATIONS:
        print(f"| {situation} | " + " | ".join(str(situations.get(situation, {}).get(end, 0)) for end in ends) + " |")
    print("\n".join(["", *wrong[:20]]))


if __name__ == "__main__":
    main()
