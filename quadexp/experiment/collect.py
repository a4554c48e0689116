"""Flights for learning, and the data set made from them.

mode "random": smooth random paths, one lap each or its first `flight_duration` seconds, with peak speeds spread evenly
over [speed_min, speed_max]; a path that exceeds the total thrust of all rotors is replaced by another. Single rotors
may reach their limits, unlike on the paths of trajectory=random, so that the data cover the whole range of the vehicle.
mode "setpoints": jumps between random points, each held for the duration of a minimum-snap move to the next one at a
peak speed of that range.

Paths and noise depend on the seed only, not on controller or plant, so that their data can be compared. Collection
stops at a simulated time, so the same command gives the same data set on every machine: the last path is flown to its
end where this takes at most 5 % longer than asked for, and ended in time otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError, UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import build_loop, describe, thrust_excess
from quadexp.experiment.identity import digest, find_model, flight_record
from quadexp.experiment.vehicle_of import refuse_repeated
from quadexp.log.outcome import COMPLETED
from quadexp.log.schema import Flight, is_recorded
from quadexp.log.store import read_flight, write_flight, write_table
from quadexp.models.dataset import ResidualDataset, as_told, known_noise, residual_dataset
from quadexp.models.residual import VELOCITY
from quadexp.names import without
from quadexp.parts.schema import WORLD, Config
from quadexp.physics.state import norms
from quadexp.physics.vehicle import Vehicle
from quadexp.plugin import brought, service
from quadexp.provenance import provenance, versions
from quadexp.reference.base import FlatOutput, standing
from quadexp.reference.random_polynomial import RandomPolynomial

PEAK_OVER_MEAN = 35 / 16  # speed of the minimum-snap move from rest to rest, 35 s^4 - 84 s^5 + 70 s^6 - 20 s^7
DRAWS = 50  # attempts to draw a path that can be flown
OF_RECORDED = ("target", "identified")  # keys of `collect` for recorded flights only
LOST_DISTANCE = 1e3  # m; large, because a jump of the set-point must not end the flight
# Share of collect.duration by which the last path may end later; of a longer one the beginning is flown.
OVERTIME = 0.05
SETPOINTS = 20.0  # s of a flight through setpoints, where collect.flight_duration does not say
SHORTEST = 1.0  # s of a flight at least: fewer samples show neither lag nor drag
GOLDEN = 0.6180339887498949  # step of an even spread over an interval for any number of points


@dataclass(frozen=True)
class Beginning:
    """The beginning of a path, `duration` seconds of it; the horizon of a controller sees where it goes on."""

    path: RandomPolynomial
    duration: float

    @property
    def peak_speed(self) -> float:
        return self.path.peak_speed

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output."""
        return self.path.flat_output(t)


@dataclass(frozen=True)
class Setpoints:
    """Points held one after another, with jumps in between.

    points: (n, 3), world (m). times: (n,), s, start of each. duration: s.
    """

    points: np.ndarray
    times: np.ndarray
    duration: float

    @property
    def peak_speed(self) -> float:
        return 0.0

    def flat_output(self, t: np.ndarray) -> FlatOutput:
        """See Trajectory.flat_output; all derivatives are zero."""
        t = np.atleast_1d(np.asarray(t, float))
        return standing(self.points[np.searchsorted(self.times, t, side="right").clip(1) - 1])


def collect_flights(
    config: Config, progress: Callable[[float, float], None] = lambda done, total: None, *,
    worlds: Sequence[Config] = (),
) -> list[Flight]:  # fmt: skip
    """Fly until `collect.duration` seconds are recorded.

    worlds: configurations that differ from this one in the plant and the world around it, flown in turn.
    Raises UsageError where the controller lacks its model, worlds differ in something else, or one of them makes the
    loop unstable, QuadexpError where no path of a speed can be flown.
    """
    model = find_model(config)
    settings = config.collect
    vehicle = build_vehicle(config.vehicle)
    worlds = worlds or [config]
    for world in worlds:
        _check_same(config, world)
        build_loop(world, model)
    sequence = np.random.SeedSequence(int(digest(["collect", config.seed]), 16))
    offset = np.random.default_rng(sequence.spawn(1)[0]).random()
    decisive = without(asdict(settings), OF_RECORDED)
    flights: list[Flight] = []
    recorded = 0.0
    while not flights or recorded < settings.duration - 1e-6:
        index = len(flights)
        world = worlds[index % len(worlds)]
        loop = build_loop(world, model)
        path_rng, noise_rng = map(np.random.default_rng, sequence.spawn(2))
        speed = settings.speed_min + (offset + index * GOLDEN) % 1.0 * (settings.speed_max - settings.speed_min)
        rest = settings.duration - recorded
        trajectory = _trajectory(config, vehicle, loop.controller, speed, rest, path_rng)
        metadata = describe(world, vehicle, model) | {"name": f"flight_{index:03d}", "trajectory": settings.mode}
        flown = {group: node for group, node in flight_record(world).items() if group != "trajectory"}
        metadata["config"] = {**flown, "collect": decisive}
        flight = loop.fly(trajectory, noise_rng, lost_distance=LOST_DISTANCE, metadata=metadata)
        if flight.outcome not in COMPLETED:
            raise QuadexpError(
                f"flight {index} at {speed:.1f} m/s ended early ({flight.metadata['cause']}); lower collect.speed_max"
            )
        flights.append(flight)
        recorded += float(flight.t[-1])
        progress(min(round(recorded, 1), settings.duration), settings.duration)
    return flights


def _check_same(config: Config, other: Config) -> None:
    """Raise UsageError where two configurations differ in more than the plant and the world around it."""
    mine, others = (flight_record(either) | {"collect": asdict(either.collect)} for either in (config, other))
    fixed = (key for key in mine if key not in (*WORLD, "plant") and mine[key] != others.get(key))
    if different := next(fixed, None):
        raise UsageError(
            f"collect --sweep: the flights differ in `{different}`; one data set is of one vehicle, controller"
            f" and seed, in worlds that may differ in {', '.join(('plant', *WORLD))}"
        )


def _trajectory(
    config: Config, vehicle: Vehicle, controller: Any, speed: float, rest: float, rng: np.random.Generator
) -> Any:
    """What is flown next, for `rest` (s) at most where that is possible."""
    settings = config.collect
    if settings.mode == "setpoints":
        duration = min(settings.flight_duration or SETPOINTS, rest)
        return setpoints(settings.extent, settings.clearance, speed, duration, rng)
    longest = settings.flight_duration or math.inf
    overtime = OVERTIME * settings.duration if rest < longest else 0.0
    for _ in range(DRAWS):
        seed = int(rng.integers(2**31))
        path = RandomPolynomial(speed=speed, seed=seed, extent=settings.extent, clearance=settings.clearance)
        if thrust_excess(path, vehicle) is None:
            period = controller.control_period
            wanted = max(SHORTEST, math.ceil(min(rest, longest) / period - 1e-6) * period)
            return Beginning(path, wanted) if path.duration > wanted + overtime else path
    raise QuadexpError(
        f"none of {DRAWS} random paths at {speed:.1f} m/s can be flown; lower collect.speed_max"
        f" ({settings.speed_max:g} m/s) or raise collect.extent ({settings.extent:g} m)"
    )


def setpoints(extent: float, clearance: float, speed: float, duration: float, rng: np.random.Generator) -> Setpoints:
    """Random points in a cube of side `extent` (m) above `clearance`, each held for a minimum-snap move at `speed`."""
    points = [rng.uniform(0.0, extent, 3)]
    times = [0.0]
    while times[-1] < duration:
        point = rng.uniform(0.0, extent, 3)
        times.append(times[-1] + max(0.1, PEAK_OVER_MEAN * float(np.linalg.norm(point - points[-1])) / speed))
        points.append(point)
    shift = np.array([-extent / 2, -extent / 2, clearance])
    return Setpoints(np.array(points) + shift, np.array(times), duration)


def _rows(
    config: Config, vehicle: Vehicle, flights: Sequence[Flight], names: Sequence[str]
) -> tuple[ResidualDataset, list[str]]:
    """The data set with notes on it: of recorded flights by their accelerometer, of simulated ones by transitions.

    Raises UsageError where recorded and simulated flights are mixed without a target for both.
    """
    settings = config.collect
    recorded = [is_recorded(flight) for flight in flights]
    if settings.target == "auto" and any(recorded) != all(recorded):
        raise UsageError("collect.target: simulated and recorded flights together need specific_force or velocity")
    if settings.state == "estimate":
        flights = [as_told(flight) for flight in flights]
    if settings.target in ("auto", "velocity") and settings.identified is None and not any(recorded):
        return _simulated_rows(config, vehicle, flights, names)
    rows: tuple[ResidualDataset, list[str]] = service("recorded_rows", "collect")(settings, vehicle, flights, names)
    return rows


def _simulated_rows(
    config: Config, vehicle: Vehicle, flights: Sequence[Flight], names: Sequence[str]
) -> tuple[ResidualDataset, list[str]]:
    """Transitions under the thrusts that the rotors delivered, as far as the flights tell, and how these are known."""
    settings = config.collect
    dataset = residual_dataset(flights, vehicle, frame=settings.frame, names=names)
    worlds = [flight.metadata.get("config") or {} for flight in flights]

    def noise_of(rows: ResidualDataset) -> dict[str, Any] | None:
        return known_noise(rows, vehicle, worlds, of_estimate=settings.state == "estimate")

    lines: list[str] = []
    extra: dict[str, Any] = {}
    if settings.thrust == "delivered":
        delivered = brought("services", "delivered_rows")
        if delivered is None:
            lines.append("warning: commands count as acting at once: no installed plug-in finds lag and delays")
        else:
            dataset, lines, extra = delivered(settings, vehicle, flights, dataset, names, noise_of)
    extra["known_noise"] = noise_of(dataset)
    return dataset._replace(metadata={**dataset.metadata, **extra}), lines


def collect_dataset(
    config: Config, path: Path, *, flights: Sequence[Path] = (), worlds: Sequence[Config] = (),
    save_flights: Path | None = None, force: bool = True,
    progress: Callable[[float, float], None] = lambda done, total: None,
) -> dict[str, Any]:  # fmt: skip
    """Write the residual data set of flight files, or of new flights (worlds: see collect_flights). force: replace
    files that are there.

    Returns the report. Raises UsageError for a repeated flight, which could be held out and fitted, and for equal names
    to be saved.
    """
    vehicle = build_vehicle(config.vehicle)
    settings = config.collect
    if flights:
        refuse_repeated("collect", [file.resolve() for file in flights])
        if save_flights is not None:
            said = f"two flights named {{path}} would both be written to {save_flights}"
            refuse_repeated("collect --save-flights", [Path(file.stem) for file in flights], said)
        flown = [read_flight(file, whole=True, placed=False) for file in flights]
        names = [str(file) for file in flights]
        record: dict[str, Any] = {"source": "files"}
    else:
        flown = collect_flights(config, progress, worlds=worlds)
        names = [flight.metadata["name"] for flight in flown]
        configs = [flight.metadata["config"] for flight in flown]
        record = {"source": "flown", "config": configs[0], "config_hash": digest(configs[0])}
        if len(worlds) > 1:
            record |= {"worlds": configs[: len(worlds)], "config_hash": digest(configs[: len(worlds)])}
    dataset, notes = _rows(config, vehicle, flown, names)
    target = dataset.metadata.get("target")
    record |= {key: getattr(settings, key) for key in OF_RECORDED if target}
    if save_flights is not None:
        for name, flight in zip(names, flown, strict=True):
            write_flight(save_flights / f"{Path(name).stem}.parquet", flight, force=force)
    metadata = {**dataset.metadata, **record, "seed": config.seed, "versions": versions(), "provenance": provenance()}
    write_table(path, dataset.columns, metadata, "residuals", force=force)
    if len(worlds) > len(flown):
        notes.append(f"warning: {len(flown)} flights in the first of {len(worlds)} worlds: raise collect.duration")
    speed = norms(dataset.matrix(VELOCITY))
    median = float(np.median(speed))
    high = float(np.percentile(speed, 95))
    largest = float(speed.max())
    seconds = float(np.sum(dataset.columns["dt"]))
    rows = "samples" if dataset.metadata["frame"] == "sample" else "transitions"
    kind = f"target {target}" if target else f"frame {settings.frame}"
    how = "recorded" if flights else settings.mode
    lines = [f"{dataset.n_rows} {rows} from {len(flown)} flights, {seconds:.0f} s ({how}, {kind})"]
    lines.append(f"speed: median {median:.1f}, 95 % {high:.1f}, largest {largest:.1f} m/s")
    return {
        "path": path, "rows": dataset.n_rows, "flights": len(flown), "duration": seconds, "speed_median": median,
        "speed_p95": high, "speed_max": largest, "plant": None if flights else config.plant.name,
        "controller": None if flights else config.controller.name, "seed": config.seed, "target": target,
        "notes": notes, "lines": [*notes, *lines],
    }  # fmt: skip
