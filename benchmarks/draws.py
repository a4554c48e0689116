"""Vehicles, sensors, worlds and paths drawn from a seed, each flown with remedies=auto and without: who is lost, who is
worse, and how often the 95 % bands of what was assumed at the end contain the truth.

    python -m benchmarks.draws --seed 7 --draws 100 --out draws.jsonl    # goes on where the file ends
    python -m benchmarks.draws --wider --seed 7 --out wider.jsonl        # what wider_draws.py draws

First a vehicle is drawn: one of VEHICLES with 70 to 130 % of its mass and of each moment of inertia, which no
controller is given, its sensors and its world. It flies EACH times; of each flight a data sheet wrong by up to a factor
of three, a path, a speed, lowered until the vehicle could fly it, a controller and a seed are drawn. Drag and noise of
plant=simplified, which are of a vehicle of 1 kg, grow with the mass. Where auto is lost, perfect_mpc flies the draw
with the true vehicle, an observer of the wind, and the delays given.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError, UsageError
from quadexp.experiment.build import build_trajectory, build_vehicle
from quadexp.experiment.evaluate import InfeasibleError, check_feasible, fly_one
from quadexp.log.schema import Flight
from quadexp.parts.compose import compose
from quadexp.parts.schema import Config
from quadexp.plugins.auto.beliefs import beliefs, truths
from quadexp.provenance import sources
from quadexp.report.metrics import position_error
from quadexp.world.true_vehicle import with_factors


def vehicles_alone() -> Path:
    """The vehicles of the examples, one of which has six rotors, without controllers that cover shipped ones."""
    folder = Path(tempfile.gettempdir()) / "quadexp-draws" / "conf"
    shutil.copytree(Path(__file__).parents[1] / "examples" / "vehicle", folder / "vehicle", dirs_exist_ok=True)
    return folder


EXAMPLES = vehicles_alone()
VEHICLES = "torrente", "blackbird", "hummingbird", "quad_bench", "lei_li", "crazyflie", "hexacopter"
CONTROLLERS = "perfect_mpc", "nominal_mpc", "dfbc", "geometric"
SENSORS = "perfect", "low", "high", "mocap_room", "gnss_quad", "race_dshot", "race_serial", "crazyflie"
OWN_SENSORS = "indoor_mocap", "outdoor_breeze"  # worlds
WORLDS = (
    "clean", "only_motor_lag", "only_latency", "only_late_estimate", "only_noisy_estimate", "only_thrust_scale",
    "only_battery", "only_wind", "everything", "race", *OWN_SENSORS,
)  # fmt: skip
PATHS = "circle", "lemniscate", "random", "rectangle"
TOLD = "horizon=firm", "motor=states", "observer=wind", "observer.targets=false", "delay=prediction"  # given the delays
EACH = 8
OFF, SHEET, SPEEDS = (0.7, 1.3), 3.0, (3.0, 9.0)  # factors of the vehicle; of data sheets; m/s
SLOWER = 0.85  # a speed that the vehicle cannot fly, by this


def drawn(seed: int, number: int) -> tuple[list[str], list[str], list[str]]:
    """Settings of a draw: what all flights of it have in common; controller and true vehicle as controllers are given
    nothing; and as perfect_mpc is given all but the delays."""
    rng = np.random.default_rng([seed, number // EACH])

    def one(names: tuple[str, ...]) -> str:
        return names[int(rng.integers(len(names)))]

    vehicle, world, sensor = map(one, (VEHICLES, WORLDS, SENSORS))
    body, true = build_vehicle(compose([f"vehicle={vehicle}"], EXAMPLES).vehicle), None
    while true is None:
        mass, *inertia = rng.uniform(*OFF, 4).round(3).tolist()
        with suppress(UsageError):  # no rigid body, or one that cannot hover
            true = with_factors(body, mass, np.array(inertia), np.zeros(3))
    rng = np.random.default_rng([seed, number // EACH, 1 + number % EACH])
    controller, path = map(one, (CONTROLLERS, PATHS))
    sheet, speed = float(SHEET ** rng.uniform(-1, 1)), float(rng.uniform(*SPEEDS))
    common = [f"vehicle={vehicle}", f"world={world}", f"trajectory={path}", f"seed={int(rng.integers(10**6))}"]
    if world not in OWN_SENSORS:
        common += [f"sensor={sensor}", f"sensor.sheet_factor={sheet:.3f}"]
    if path == "rectangle":
        common += ["trajectory.start=reference", "trajectory.duration=16"]
    believed = compose([*common, "plant=simplified"], EXAMPLES)
    common += of_size(believed)
    while not flyable([*common, f"trajectory.speed={speed:.2f}", f"truth.mass={mass}"]):
        speed *= SLOWER
    common.append(f"trajectory.speed={speed:.2f}")
    untold = [f"controller={controller}", f"truth.mass={mass}", f"truth.inertia={json.dumps(inertia)}"]
    told = [f"vehicle.mass={true.mass}", f"vehicle.inertia={json.dumps(true.inertia)}"]
    return common, [*untold, "controller.allow_unstable=true"], told


def of_size(config: Config) -> list[str]:
    """Drag and noise of the plant, for the size of the vehicle."""
    reference, plant = compose([]).vehicle, config.plant
    heavier = config.vehicle.mass / reference.mass
    wider = config.vehicle.inertia[0][0] / reference.inertia[0][0]
    factors = {"linear_drag": heavier, "quadratic_drag": heavier, "force_noise_density": heavier}
    of = {name: (factor * np.array(getattr(plant, name))).tolist() for name, factor in factors.items()}
    of["torque_noise_density"] = wider * plant.torque_noise_density
    return [f"plant.{name}={json.dumps(value)}" for name, value in of.items()]


def flyable(settings: list[str]) -> bool:
    """Whether the path is within the thrust of the vehicle that is assumed and of the true one."""
    config = compose(settings, EXAMPLES)
    vehicle = build_vehicle(config.vehicle)
    try:
        for flies in (vehicle, config.truth.true_vehicle(vehicle)):
            check_feasible(config, build_trajectory(config.trajectory, vehicle), flies)
    except InfeasibleError:
        return False
    return True


def flown(seed: int, number: int, wider: bool = False) -> dict[str, Any]:
    """What came of a draw: errors (m) and outcomes, and what auto assumed at the end."""
    from benchmarks.wider_draws import drawn_wider, missing_readings

    common, untold, told, missing = drawn_wider(seed, number) if wider else (*drawn(seed, number), 0.0)
    with missing_readings(missing):
        record = _flown(common, untold, told)
    about = {"seed": seed, "draw": number, "sources": sources(), "settings": [*common, *untold]}
    return about | ({"missing": missing} if wider else {}) | record


def _flown(common: list[str], untold: list[str], told: list[str]) -> dict[str, Any]:
    record: dict[str, Any] = {}
    flights = {name: _flight([*common, *untold, f"remedies={name}"]) for name in ("none", "auto")}
    auto = flights["auto"]
    if auto.outcome != "ok":
        timing = auto.metadata["timing"]
        age = truths(auto)["auto_age"].max(initial=timing["age"])  # s, the mean of poses that have a rate
        delays = [f"controller.dead_time={timing['dead_time']}", f"controller.motor_lag={timing['lag']}"]
        known = ["controller=perfect_mpc", "controller.allow_unstable=true", *TOLD, *delays]
        flights["told"] = _flight([*common, *told, *known, f"delay.time={age}"])
    for name, flight in flights.items():
        record[name] = {"outcome": flight.outcome, "cause": flight.metadata.get("cause", "")}
        record[name]["error"] = float(position_error(flight).mean()) if len(flight) else None
        record[name]["change"] = float(np.sqrt(np.mean(np.square(np.diff(flight.input, axis=0)))))  # N, of a command
    record["beliefs"] = {
        belief.name: [belief.low[-1], belief.high[-1], belief.true[-1], belief.identifiable] for belief in beliefs(auto)
    }
    return record


def _flight(settings: list[str]) -> Flight:
    return fly_one(compose(settings, EXAMPLES))


def inside(records: list[dict[str, Any]]) -> Iterator[tuple[str, int, int, int]]:
    """Of each quantity: in the band, identifiable with a truth, not identifiable."""
    counts: dict[str, Counter] = {}
    for record in (record for record in records if record["auto"]["outcome"] == "ok"):
        for name, (low, high, true, identifiable) in record["beliefs"].items():
            zero = ", which is 0" if true == 0 and name.startswith("age") else ""  # the edge of what can be
            count = counts.setdefault(name.split(",")[0] + zero, Counter())
            count["unknown"] += not identifiable
            if identifiable and np.isfinite(true):
                count["all"] += 1
                count["inside"] += low <= true <= high
    for name, count in counts.items():
        yield name, count["inside"], count["all"], count["unknown"]


def summary(records: list[dict[str, Any]]) -> str:
    """As Markdown."""
    from scipy.stats import binomtest

    both = [r for r in records if r["none"]["outcome"] == r["auto"]["outcome"] == "ok"]
    lost = [r for r in records if r["auto"]["outcome"] != "ok"]
    ratios = np.array([r["auto"]["error"] / r["none"]["error"] for r in both])
    saved = sum(r["none"]["outcome"] != "ok" and r["auto"]["outcome"] == "ok" for r in records)
    counted = len(both) + saved + sum(r["none"]["outcome"] == "ok" for r in lost)
    told = [r for r in lost if r["told"]["outcome"] == "ok"]
    rows = {
        "draws": len(records),
        "lost without": sum(r["none"]["outcome"] != "ok" for r in records),
        "lost with auto": len(lost),
        "lost with auto, not without": sum(r["none"]["outcome"] == "ok" for r in lost),
        "lost with auto, perfect_mpc given all flies": len(told),
        "which are rectangles": sum("rectangle" in " ".join(r["settings"]) for r in told),
        f"better than without, of {counted}": f"{((ratios < 1).sum() + saved) / max(counted, 1):.3f}",
        "ratio to without: geometric mean": f"{np.exp(np.log(ratios).mean()):.3f}",
        "largest": f"{ratios.max():.3g}",
    }
    changes = [r["auto"]["change"] / r["none"]["change"] for r in both if r["none"].get("change")]
    if changes:
        rows["change of a command from step to step, to without: median, nine in ten"] = (
            f"{np.median(changes):.2f}, {np.quantile(changes, 0.9):.2f}"
        )
        rows["more than twice that without"] = f"{np.mean(np.array(changes) > 2):.2f}"
    lines = ["| | |", "|---|--:|", *(f"| {name} | {value} |" for name, value in rows.items()), ""]
    lines += [
        "| 95 % band at the end | contains the truth | interval | of | not identifiable |",
        "|---|--:|---|--:|--:|",
    ]
    for name, hits, of, unknown in inside(records):
        if of:
            share = binomtest(hits, of).proportion_ci(method="wilson")
            lines.append(f"| {name} | {hits / of:.3f} | {share.low:.3f} .. {share.high:.3f} | {of} | {unknown} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--draws", type=int, default=500)
    parser.add_argument("--wider", action="store_true", help="what wider_draws.py draws")
    parser.add_argument("--out", type=Path, required=True, help="one JSON object a draw")
    arguments = parser.parse_args()
    lines = arguments.out.read_text().splitlines() if arguments.out.exists() else []
    records = [json.loads(line) for line in lines]
    done = {record["draw"] for record in records if record["sources"] == sources()}
    with arguments.out.open("a") as file:
        for number in (number for number in range(arguments.draws) if number not in done):
            try:
                records.append(flown(arguments.seed, number, arguments.wider))
            except QuadexpError as error:
                if not (isinstance(error, UsageError) and str(error).startswith("vehicle.")):
                    raise SystemExit(f"draw {number}: {error}") from None
                print(f"draw {number} is left out: {error}", file=sys.stderr)  # no vehicle of this program's range
                continue
            file.write(json.dumps(records[-1]) + "\n")
            file.flush()
    print(summary([record for record in records if record["sources"] == sources()]))


if __name__ == "__main__":
    main()
