"""What `benchmarks.draws --wider` draws: vehicles, times, delays, rates and paths beyond those of its own draws.

vehicle     half as shipped, half of 30 g to 10 kg (lengths grow with the cube root of the mass, inertia with its
            5/3rd power) and a thrust of 1.3 to 8 times the weight; each off by up to 30 %
world       half the named ones; half made of parts: turbulence, a gust or a load that begins late, an estimate
            0 to 80 ms late, with noise or exact, commands 0 to 80 ms late, motors that lag, a battery, a payload
readings    up to 20 % of the accelerometer's missing, in a third of the draws
control     20 to 500 Hz, or the controller's own rate
path        hover, slow flight, circles, lemniscates, random ones, rectangles and files, 5 to 120 s where the path
            has a duration; up to the vehicle's limit
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.draws import EXAMPLES, OFF, OWN_SENSORS, SENSORS, SHEET, SLOWER, VEHICLES, WORLDS, flyable, of_size
from quadexp.control.readings import ReadingGate
from quadexp.errors import UsageError
from quadexp.experiment import rollout
from quadexp.experiment.build import build_vehicle
from quadexp.parts.compose import compose
from quadexp.world.true_vehicle import with_factors

CONTROLLERS = "perfect_mpc", "nominal_mpc", "dfbc", "geometric"
MASSES, THRUSTS = (0.03, 10.0), (1.3, 8.0)  # kg; of the weight
LATEST, LARGEST_LAG = 0.08, 0.06  # s
RATES, LENGTHS = (20.0, 500.0), (5.0, 120.0)  # Hz, s
MISSING = 0.2
SPEEDS = (0.2, 20.0)  # m/s; lowered to what the vehicle can fly
PATHS = "hover", "circle", "lemniscate", "random", "rectangle", "file"
SLOWEST = 0.1  # m/s: a vehicle that cannot fly this on a path hovers instead


def drawn_wider(seed: int, number: int) -> tuple[list[str], list[str], list[str], float]:
    """As benchmarks.draws.drawn; and the share of the accelerometer's readings that are missing."""
    rng = np.random.default_rng([seed, number, 40])

    def one(names: tuple[str, ...]) -> str:
        return names[int(rng.integers(len(names)))]

    def between(limits: tuple[float, float]) -> float:
        """Log-uniform."""
        return float(np.exp(rng.uniform(*np.log(limits))))

    vehicle = _vehicle(one(VEHICLES), between(MASSES), between(THRUSTS), rng.random() < 0.5)
    body, true = build_vehicle(compose(vehicle, EXAMPLES).vehicle), None
    while true is None:
        mass, *inertia = rng.uniform(*OFF, 4).round(3).tolist()
        with suppress(UsageError):  # no rigid body, or one that cannot hover
            true = with_factors(body, mass, np.array(inertia), np.zeros(3))
    seconds = between(LENGTHS)
    common = [*vehicle, f"seed={int(rng.integers(10**6))}"]
    if rng.random() < 0.5:
        world = one(WORLDS)
        common.append(f"world={world}")
    else:
        world = ""
        common += _parts(rng, true, seconds)
    if world not in OWN_SENSORS:
        sheet = float(SHEET ** rng.uniform(-1, 1))
        common += [f"sensor={one(SENSORS)}", f"sensor.sheet_factor={sheet:.3f}"]
    common += of_size(compose([*common, "plant=simplified", "trajectory=hover"], EXAMPLES))
    common += _path(one(PATHS), rng, between(SPEEDS), seconds, common, f"truth.mass={mass}")
    untold = [f"controller={one(CONTROLLERS)}", f"truth.mass={mass}", f"truth.inertia={json.dumps(inertia)}"]
    if rng.random() < 0.5:
        untold.append(f"controller.rate={between(RATES):.0f}")
    told = [f"vehicle.mass={true.mass}", f"vehicle.inertia={json.dumps(true.inertia)}"]
    missing = float(rng.uniform(0, MISSING)) if rng.random() < 1 / 3 else 0.0
    return common, [*untold, "controller.allow_unstable=true"], told, missing


def _vehicle(name: str, mass: float, thrust: float, resized: bool) -> list[str]:
    body = build_vehicle(compose([f"vehicle={name}"], EXAMPLES).vehicle)
    words = [f"vehicle={name}"]
    if not resized or body.rotor is not None:  # the shape of rotors is that of one size
        return words
    k = mass / body.mass
    words += [
        f"vehicle.mass={mass:.5g}",
        f"vehicle.inertia={json.dumps((body.inertia_matrix * k ** (5 / 3)).tolist())}",
    ]
    words.append(f"vehicle.rotor_position={json.dumps((np.array(body.rotor_position) * np.cbrt(k)).tolist())}")
    words.append(f"vehicle.torque_coefficient={body.torque_coefficient * np.cbrt(k):.6g}")
    words.append(f"vehicle.thrust_max={thrust * mass * body.gravity / body.n_rotors:.6g}")
    words.append(f"vehicle.thrust_min={min(body.thrust_min * k, 0.1 * mass * body.gravity / body.n_rotors):.6g}")
    if body.thrust_coefficient is not None:
        words.append(f"vehicle.thrust_coefficient={body.thrust_coefficient * k:.6g}")
    return words


def _parts(rng: np.random.Generator, true: Any, seconds: float) -> list[str]:
    """A world of its own."""
    words = []
    begins = rng.uniform(0, seconds)
    wind = rng.integers(4)
    if wind == 1:
        words.append("wind=gusty")
    elif wind == 2:
        direction = rng.uniform(0, 2 * np.pi)
        peak = (rng.uniform(2, 8) * np.array([np.cos(direction), np.sin(direction), 0.0])).round(2).tolist()
        words += ["wind=gust", "wind.velocity=[0,0,0]", f"wind.amplitude={json.dumps(peak)}"]
        words += [f"wind.duration={rng.uniform(1, 10):.2f}", f"wind.onset={begins:.2f}"]
    elif wind == 3:
        speed = rng.uniform(1, 8)
        words += ["wind=dryden", f"wind.velocity=[{speed:.2f},0,0]"]
    if rng.random() < 0.4:
        words += [
            f"estimator={('late', 'late_noisy')[int(rng.integers(2))]}",
            f"estimator.delay={rng.uniform(0, LATEST):.4f}",
        ]
    if rng.random() < 0.4:
        words += ["link=latency", f"link.latency={rng.uniform(0, LATEST):.4f}"]
    if rng.random() < 0.4:
        lag = f"{rng.uniform(0.005, LARGEST_LAG):.4f}"
        words += ["actuator=first_order", f"actuator.time_constant_up={lag}", f"actuator.time_constant_down={lag}"]
    if rng.random() < 0.2:
        words.append("battery=sag")
    load = rng.integers(4)
    weight = true.mass * true.gravity
    if load == 1:
        kind = ("fixed", "slung")[int(rng.integers(2))]
        words += [f"payload={kind}", f"payload.mass={max(rng.uniform(0.02, 0.2) * true.mass, 1e-3):.4g}"]
    elif load == 2:
        force = (rng.normal(size=3) * 0.1 * weight).round(4).tolist()
        words += ["external=push", f"external.force={json.dumps(force)}", f"external.onset={begins:.2f}"]
    return words


def _path(
    path: str, rng: np.random.Generator, speed: float, seconds: float, common: list[str], truth: str
) -> list[str]:
    """A path at a speed that the vehicle can fly."""
    hover = ["trajectory=hover", f"trajectory.duration={seconds:.1f}"]
    if path == "hover":
        return hover
    words = [f"trajectory={path}"]
    if path == "rectangle":
        words += ["trajectory.start=reference", f"trajectory.duration={max(seconds, 8.0):.1f}"]
    elif path == "random":
        words += [f"trajectory.seed={int(rng.integers(1000))}", f"trajectory.keypoints={int(rng.integers(4, 30))}"]
    elif path == "file":
        words.append(f"trajectory.path={_file(rng)}")
    while speed > SLOWEST:
        fast = [*words, f"trajectory.speed={speed:.2f}"]
        if path in ("circle", "lemniscate"):  # faster for one half, slower for the other
            fast.append(f"trajectory.acceleration={2 * speed / seconds:.4f}")
        if flyable([*common, *fast, truth]):
            return fast
        speed *= SLOWER
    return hover


def _file(rng: np.random.Generator) -> Path:
    """Waypoints of one path, by their own name."""
    points = np.cumsum(rng.normal(size=(int(rng.integers(4, 15)), 3)) * [3, 3, 0.5], axis=0) + [0, 0, 3]
    text = "x,y,z\n" + "\n".join(",".join(f"{value:.3f}" for value in point) for point in points) + "\n"
    folder = Path(tempfile.gettempdir()) / "quadexp-draws"
    folder.mkdir(exist_ok=True)
    file = folder / f"{abs(int(points.sum() * 1e6)):d}.csv"
    file.write_text(text)
    return file


@contextmanager
def missing_readings(share: float, when: Callable[[float], bool] | None = None) -> Iterator[None]:
    """Meanwhile, this share of the accelerometer's readings is missing, or those of the times `when` says (s), in
    flights that Python makes."""
    if not share and when is None:
        yield
        return
    admit, covers = ReadingGate.admit, rollout.covers
    rng = np.random.default_rng(5)

    def some(gate: ReadingGate, measurement: Any) -> Any:
        measurement = admit(gate, measurement)
        gone = rng.random() < share if when is None else when(measurement.t)
        return measurement._replace(specific_force=None) if gone else measurement

    # The gate of every flight loses readings meanwhile, and no flight goes into C, which has a gate of its own.
    ReadingGate.admit, rollout.covers = some, lambda *about: False  # type: ignore[method-assign]  # for a while
    try:
        yield
    finally:
        ReadingGate.admit, rollout.covers = admit, covers  # type: ignore[method-assign]  # as it was
