"""One flight from one configuration, and its row of results."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

import quadexp
from quadexp.control.mpc.attitude_error import yaw_share
from quadexp.errors import UsageError
from quadexp.experiment.build import (
    build_controller,
    build_trajectory,
    build_vehicle,
    build_world,
    cached,
    check_remedies,
)
from quadexp.experiment.identity import (
    ModelFile,
    digest,
    find_model,
    flight_entropy,
    flight_record,
    identity_with,
    part_identity,
)
from quadexp.log.runs import longest
from quadexp.log.schema import Flight
from quadexp.log.store import write_flight
from quadexp.parts.schema import Config, controller_name, world_parts
from quadexp.parts.settings import record
from quadexp.physics.state import ATTITUDE, POSITION, STATE_COLUMNS, finite_rows
from quadexp.physics.vehicle import Vehicle
from quadexp.plugin import brought, service
from quadexp.provenance import libraries, provenance, sources, versions
from quadexp.reference.base import LONGEST, sample_times
from quadexp.report.metrics import flight_metrics
from quadexp.world.effect import Effect

MOST_DRAG = 0.5  # of the weight, at 1 m/s
CHECK_STEP = 0.02  # s between the points at which a reference is compared with the vehicle's limits
UNKNOWN_RANGES = "the checkpoint has no ranges of its data (fitted by an older version); fit it again"
REFERENCES = 4  # kept of each controller
FINITE_SAMPLES = 200  # of a path, of which each must be finite


class InfeasibleError(UsageError):
    """The reference exceeds the vehicle's total thrust, or the plant's lag what the loop tolerates."""


def generator(config: Config, record: dict[str, Any] | None = None) -> np.random.Generator:
    """Random generator of a flight: the same for every controller on one trajectory, plant, vehicle and seed."""
    return np.random.default_rng(np.random.SeedSequence(flight_entropy(config, record)))


def _coarse_reference(trajectory: Any, vehicle: Vehicle) -> Any:
    """The reference by which a path is judged."""
    from quadexp.reference.flatness import flat_reference

    return flat_reference(trajectory, sample_times(trajectory, CHECK_STEP), vehicle)


def thrust_excess(trajectory: Any, vehicle: Vehicle, reference: Any = None) -> str | None:
    """Where the collective thrust exceeds that of all rotors, so that the path cannot be flown; None if nowhere."""
    try:
        reference = reference or _coarse_reference(trajectory, vehicle)
    except UsageError as error:
        return str(error)
    collective = reference.input.sum(axis=1)
    low = vehicle.n_rotors * vehicle.thrust_min
    high = vehicle.n_rotors * vehicle.thrust_max
    beyond = np.maximum(collective - high, low - collective)
    at = int(np.argmax(beyond))
    if beyond[at] <= 0:
        return None
    return (
        f"it takes {collective[at]:.4g} N of collective thrust at t={reference.t[at]:.2f} s,"
        f" the vehicle has {low:g} to {high:g} N"
    )


def check_feasible(config: Config, trajectory: Any, vehicle: Vehicle) -> str:
    """Where the reference exceeds the vehicle's limits, in one line, "" if nowhere.

    Raises InfeasibleError for a collective thrust beyond that of all rotors, unless the configuration allows it. A
    single rotor thrust or a rate beyond its limit, mostly due to a prescribed yaw, causes attitude errors but the path
    can still be flown: this is only noted.
    """
    from quadexp.reference.flatness import check_feasible as compare

    _check_finite(config, trajectory)
    reference = _coarse_reference(trajectory, vehicle)
    remedy = getattr(trajectory, "remedy", "lower trajectory.speed")
    excess = thrust_excess(trajectory, vehicle, reference)
    if excess and not config.trajectory.allow_infeasible:
        raise InfeasibleError(
            f"{config.trajectory.name} cannot be flown: {excess}; {remedy}, or pass trajectory.allow_infeasible=true"
        )
    worst = compare(reference, vehicle)
    beyond = "" if worst is None else f"{worst}; {remedy}"
    notes = [getattr(trajectory, "note", ""), beyond, below_ground(config, trajectory), heavy_drag(config)]
    return "; ".join(filter(None, notes))


def heavy_drag(config: Config) -> str:
    """Whether the drag of a plant is that of another vehicle, in one line, "" if not. The drag of the shipped plants is
    0.04 to 0.06 of the weight at 1 m/s, on the vehicles that they are of."""
    drag = sum(max(getattr(config.plant, name, (0.0,))) for name in ("linear_drag", "quadratic_drag"))
    share = drag / (config.vehicle.mass * config.vehicle.gravity)
    if share <= MOST_DRAG:
        return ""
    return (
        f"plant.linear_drag and quadratic_drag make {drag:.3g} N at 1 m/s, {share:.3g} of the weight of"
        f" vehicle={config.vehicle.name}; multirotors have 0.02 to 0.1: are they of another vehicle, or in mN s/m?"
    )


def _check_finite(config: Config, trajectory: Any) -> None:
    """UsageError where the path is not finite, with the setting that is furthest from the usual size of numbers."""
    t = np.linspace(0.0, min(trajectory.duration, LONGEST), FINITE_SAMPLES)
    with np.errstate(all="ignore"):
        flat = trajectory.flat_output(t).position
    finite = np.isfinite(flat).all(axis=(1, 2))
    if finite.all():
        return
    said = f"the reference is not finite at t = {t[int(np.argmin(finite))]:.3g} s"
    if not config.trajectory.shipped:
        raise UsageError(f"{said}: flat_output of trajectory={config.trajectory.name}")
    settings = record(config.trajectory)
    settings |= settings.pop("options", {})
    size = {key: abs(math.log10(abs(x))) for key, x in settings.items() if isinstance(x, (int, float)) and abs(x) > 0}
    key = max(size, key=lambda key: size[key], default="name")
    raise UsageError(f"{said}: trajectory.{key}={settings[key]} is too large or too small")


def ground_height(config: Config) -> float:
    """Of the ground that a part of the world knows, world (m); without one the plane z = 0 is meant."""
    effects = [part for part in world_parts(config).values() if isinstance(part, Effect)]
    return next((effect.ground_height for effect in effects if effect.ground_height is not None), 0.0)


def below_ground(config: Config, trajectory: Any) -> str:
    """Where a reference is below the ground, in one line, "" if nowhere; nothing stops a vehicle there."""
    ground = ground_height(config)
    t = sample_times(trajectory, CHECK_STEP)
    z = trajectory.flat_output(t).position[:, 0, 2]
    lowest = int(np.argmin(z))
    if z[lowest] >= ground - 1e-6:
        return ""
    keys = [name for name in ("height", "clearance", "position") if hasattr(config.trajectory, name)]
    return (
        f"the reference is below the ground (z = {ground:g} m), by {ground - z[lowest]:.3g} m at"
        f" t = {t[lowest]:.2f} s; nothing stops the vehicle there" + (f": raise trajectory.{keys[0]}" if keys else "")
    )


@dataclass(frozen=True)
class Loop:
    """Everything that flies under one configuration. margins: of the service `loop_margins`."""

    vehicle: Vehicle
    plant: Any
    controller: Any
    margins: dict[str, Any]

    def fly(self, trajectory: Any, rng: np.random.Generator, *, digest: str = "", **options: Any) -> Flight:
        """Fly a trajectory, from its own start if it has one. digest: of all that decides it, where that is known.
        options: see rollout.fly."""
        from quadexp.experiment.rollout import fly

        reference = _reference(trajectory, self.controller, digest)
        start = getattr(trajectory, "start_state", None)
        return fly(self.plant, self.controller, reference, rng, start=start, **options)


_references: WeakKeyDictionary[Any, dict[str, Any]] = WeakKeyDictionary()  # of a controller, by trajectory


def _reference(trajectory: Any, controller: Any, digest: str) -> Any:
    """The reference of a trajectory for a controller. The last ones are kept: flights that differ in seed or world
    have them in common, and with a model of the air they take as long as the flight."""
    from quadexp.experiment.rollout import SampledReference

    controller.forget()
    kept = _references.setdefault(controller, {})
    if controller.reference_period or not digest:
        return SampledReference(trajectory, controller)
    reference = kept.pop(digest, None)
    if reference is None or not reference.serves(controller):
        reference = SampledReference(trajectory, controller)
    while len(kept) >= REFERENCES:
        del kept[next(iter(kept))]
    kept[digest] = reference
    return reference


def build_loop(config: Config, model: ModelFile | None) -> Loop:
    """What a configuration flies with. Raises InfeasibleError where the loop is not stable at hover."""
    vehicle = build_vehicle(config.vehicle)
    plant = build_world(config, vehicle)
    check_remedies(config, vehicle, plant)
    controller = build_controller(config, vehicle, plant, model)
    loop_margins = brought("services", "loop_margins")
    if loop_margins is None:
        return Loop(vehicle, plant, controller, {"unknown": "no installed plug-in computes margins"})
    loop = Loop(vehicle, plant, controller, loop_margins(controller, plant))
    if unstable := service("instability", "margins")(config, loop, model):
        raise InfeasibleError(unstable)
    return loop


@contextmanager
def drawing_from(entropy: int) -> Iterator[None]:
    """Meanwhile `random` and `numpy.random`, from which a user's part may draw, follow from a number."""
    before = random.getstate(), np.random.get_state()  # noqa: NPY002 - what such a part uses
    random.seed(entropy)
    np.random.seed(entropy % 2**32)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(before[0])
        np.random.set_state(before[1])  # noqa: NPY002


def fly_one(
    config: Config, model: ModelFile | None = None, *, through: Callable[[Loop], Loop] = lambda loop: loop
) -> Flight:
    """Fly one configuration.

    model: the checkpoint; None: found by the configuration. through: makes of the loop the one that is flown.
    Raises UsageError (InfeasibleError) before the flight only; how the flight went is its outcome.
    """
    model = model or find_model(config)
    vehicle = build_vehicle(config.vehicle)
    trajectory = build_trajectory(config.trajectory, vehicle)
    known = config.trajectory.shipped
    path_digest = digest([part_identity("trajectory", config.trajectory), vehicle.fingerprint]) if known else ""
    beside = [vehicle.name, config.plant.recorded(), ground_height(config)]  # what a note names too

    def check() -> str:
        return check_feasible(config, trajectory, vehicle)

    note = cached(["path", path_digest, *beside], check) if known else check()
    loop = build_loop(config, model)
    controller = loop.controller
    flown = through(loop)
    limits = {"lost_distance": config.trajectory.lost_distance, "lost_box": config.trajectory.lost_box}
    metadata = describe(config, vehicle, model)
    with drawing_from(flight_entropy(config, metadata["config"])):
        flight = flown.fly(
            trajectory, generator(config, metadata["config"]), digest=path_digest, metadata=metadata, **limits
        )
    residual = {"name": controller.residual_name, "source": controller.source}
    late, lag, age = (float(getattr(loop.plant, name, 0.0)) for name in ("loop_delay", "loop_lag", "age"))
    timing = {"age": age, "dead_time": late - age, "lag": lag}  # s, as they are
    flight.metadata.update(reference_note=note, residual=residual, margins=flown.margins, timing=timing)
    if hasattr(controller, "remarks"):
        flight.metadata["lacking"] = controller.remarks(flight.columns, flown.margins)
    if getattr(config.controller, "attitude_error", "") == "plain" and len(flight):
        reference = flight.stack([f"ref_{name}" for name in STATE_COLUMNS[ATTITUDE]])
        flight.metadata["yaw_share"] = yaw_share(reference, np.array(config.controller.attitude_weight))
    flight.metadata["outside_data"] = outside_data(flight, model, controller)
    flight.metadata["row"] = result_row(config, flight)
    return flight


def outside_data(flight: Flight, model: ModelFile | None, controller: Any) -> dict[str, Any] | None:
    """How much of a flight lay outside the data that the controller's learned model was fitted to: {model, share,
    shares, ranges, where, note}, None where it flies without one.

    share: of the samples, 0..1, None where it is unknown. shares: of every feature. where: the longest stretch outside,
    in words, "" without one. See quadexp.models.base.
    """
    if model is None:
        return None
    from quadexp.control.wrapped import air_of, innermost
    from quadexp.models.base import outside
    from quadexp.models.dataset import feature_rows

    air = air_of(innermost(controller))
    ranges = dict(air.ranges or {})
    record = {"model": model.path, "share": None, "shares": {}, "ranges": ranges, "where": ""}
    if air.is_zero:  # of an exported controller that knows nothing of the air: there are no data to leave
        return record | {"share": 0.0, "note": ""}
    if not ranges or not len(flight):
        return record | {"note": "the flight has no samples" if ranges else UNKNOWN_RANGES}
    rate = flight.stack(["w_x", "w_y", "w_z"])
    finite = finite_rows(flight.state)
    masks = outside(ranges, feature_rows(flight.air_velocity[finite], rate[finite], flight.input[finite]))
    where = _longest(masks["any"], flight.t[finite], flight.state[finite, POSITION])
    shares = {name: float(mask.mean()) for name, mask in masks.items()}
    return record | {"share": shares.pop("any"), "shares": shares, "where": where, "note": ""}


def _longest(mask: np.ndarray, t: np.ndarray, position: np.ndarray) -> str:
    """The longest stretch of samples of a mask, (k,): times, and position (m) in its middle."""
    if not mask.any():
        return ""
    first, end = longest(mask)
    at = ", ".join(f"{x:.1f}" for x in position[(first + end - 1) // 2] + 0.0)
    return f"{t[first]:.2f} to {t[end - 1]:.2f} s at ({at}) m"


def infeasible_flight(config: Config, model: ModelFile | None, cause: str) -> Flight:
    """A flight without samples, so that a sweep records that it was not flown."""
    metadata = describe(config, build_vehicle(config.vehicle), model)
    flight = Flight({"t": np.empty(0)}, metadata | {"outcome": "infeasible", "cause": cause, "backend": ""})
    flight.metadata["row"] = result_row(config, flight)
    return flight


def describe(config: Config, vehicle: Vehicle, model: ModelFile | None) -> dict[str, Any]:
    """The metadata of every flight."""
    identity = identity_with(config, model)
    record = flight_record(config)
    parts = {group: getattr(config, group) for group, part in record.items() if isinstance(part, dict)}
    classes = {group: part.class_path for group, part in parts.items()}
    return {
        "config": record, "classes": classes, "config_hash": digest(record), "seed": config.seed,
        "inputs": identity.inputs, "code": identity.code,
        "vehicle": {"name": vehicle.name, "fingerprint": vehicle.fingerprint},
        "plant": config.plant.name, "world": config.world, "trajectory": config.trajectory.name,
        "controller": controller_name(config),
        "model": model.path if model else "", "model_sha256": model.sha256 if model else "",
        "versions": versions(), "sources": sources(), "provenance": provenance(),
    }  # fmt: skip


def result_row(config: Config, flight: Flight) -> dict[str, Any]:
    """The row of one flight in a table of results."""
    metadata = flight.metadata
    rate = getattr(config.controller, "rate", None)
    vehicle = config.vehicle
    metrics = flight_metrics(flight, vehicle.thrust_min, vehicle.thrust_max, 1 / rate if rate else None)
    outside = metadata.get("outside_data") or {}
    return {
        "plant": config.plant.name if config.world == "clean" else f"{config.plant.name}/{config.world}",
        "vehicle": vehicle.name, "trajectory": config.trajectory.name,
        "speed": getattr(config.trajectory, "speed", None), "controller": controller_name(config),
        "model": metadata["model"], "seed": config.seed, **metrics,
        "reference_residual": metadata.get("reference_residual"),
        "outside_data": outside.get("share"), "outside_where": outside.get("where", ""),
        "outcome": metadata["outcome"],
        "backend": metadata.get("backend", ""), "cause": metadata.get("cause", ""), **program_record(),
        "code": metadata.get("code", ""),
    }  # fmt: skip


def program_record() -> dict[str, str]:
    """Program columns of a row: version, hash of the sources that affect a flight, libraries."""
    return {"program": quadexp.__version__, "sources": sources(), "libraries": libraries()}


def failed_row(config: Config, model: ModelFile | None, cause: str, outcome: str = "failed") -> dict[str, Any]:
    """The row of a cell without a flight: its process crashed, timed out or raised an exception ("failed"), or its
    settings contradict each other ("invalid")."""
    empty = Flight({}, {"model": model.path if model else "", "outcome": outcome, "cause": cause})
    return result_row(config, empty)


def evaluate_cell(config: Config, model: ModelFile | None, path: str, key: str) -> dict[str, Any]:
    """Fly one cell of a sweep, write it to `path`, and return its row.

    The disk may hold the file later; what a power cut takes of it, its hash shows.
    """
    try:
        flight = fly_one(config, model)
    except InfeasibleError as error:
        flight = infeasible_flight(config, model, str(error))
    flight.metadata["row"]["key"] = key
    write_flight(Path(path), _thinned(flight, config.evaluate.log_period), key=key, durable=False)
    return flight.metadata["row"]


def _thinned(flight: Flight, period: float) -> Flight:
    """The flight with one sample a period (s) only, which its metadata then say; 0: all."""
    control_period = float(flight.t[1] - flight.t[0]) if len(flight) > 1 else math.inf
    every = round(period / control_period)
    if every < 2:
        return flight
    thinned = {"log_period": period, "control_period": control_period}
    columns = {name: column[::every] for name, column in flight.columns.items()}
    return Flight(columns, {**flight.metadata, "thinned": thinned})
