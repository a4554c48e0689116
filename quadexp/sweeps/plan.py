"""What a sweep has to do: its cells with their keys, and the order in which each worker builds each controller once."""

from __future__ import annotations

import marshal
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from quadexp.errors import UsageError
from quadexp.experiment.build import build_effects, build_trajectory, build_vehicle
from quadexp.experiment.identity import ModelFile, digest, flight_identity
from quadexp.parts.cells import Cell, Grid, iterate_validated, varied
from quadexp.parts.schema import world_parts
from quadexp.report.inference import least_seeds
from quadexp.sweeps.sweep_table import condition

SCHEMA = 1  # version of what a cell is; with a higher number every older cell is unknown
BUILDS_AT_ONCE = 32  # compiled structures that every worker surely keeps, see experiment.build.KEPT
INVALID = "invalid"  # outcome of a cell whose settings contradict each other
STRUCTURE = ("kind", "residual", "nodes", "backend", "variant", "_target_")  # controller settings that are compiled in


@dataclass(frozen=True, slots=True)
class Job:
    """A cell to fly. key: of its file. condition: hash of what was asked for, whatever the files it reads contain.
    model: the checkpoint that its controller uses. invalid: why its settings contradict each other, "" where they do
    not; it is not flown then. variant: its settings that no column of the result table names, see cells.varied. inputs,
    files, program: see identity.FlightIdentity."""

    key: str
    condition: str
    cell: Cell
    model: ModelFile | None
    invalid: str = ""
    variant: str = ""
    inputs: Mapping[str, str] = field(default_factory=dict)
    files: Mapping[str, str] = field(default_factory=dict)
    program: str = ""


def plan_cells(cells: Iterable[Cell]) -> dict[str, Job]:
    """Key -> job of every different flight, in the order of the cells.

    Raises UsageError where a file that a cell needs does not exist, or the request is wrong as a whole.
    """
    jobs: dict[str, Job] = {}
    known: dict[Any, Any] = {}  # parts that cells share are looked at once
    for cell in iterate_validated(cells):
        if cell.invalid:
            key = digest([INVALID, *sorted(cell.overrides)])
            jobs.setdefault(key, Job(key, key, cell, None, cell.invalid))
            continue
        identity = flight_identity(cell.config, known)
        if identity.model is None:
            cell = replace(cell, config=replace(cell.config, model=None))  # a checkpoint that is not used
        key = cell_key(identity.record, identity.inputs)
        if key not in jobs:
            jobs[key] = Job(
                key,
                condition=digest(condition(identity.record)),
                cell=cell,
                model=identity.model,
                inputs=identity.inputs,
                files=identity.files,
                program=identity.program,
            )
    variants = varied([job.cell for job in jobs.values()])
    return {key: replace(jobs[key], variant=variant) for key, variant in zip(jobs, variants, strict=True)}


def too_few_seeds(grids: Iterable[Grid], baseline: str, confidence: float) -> str:
    """What to say before a sweep of several seeds that cannot show a difference in any line of its table: the paired
    permutation test of n seeds gives 2^(1-n) at least, corrected by Holm over all comparisons; "" where they can."""
    seeds = comparisons = 0
    for grid in grids:
        axes = {texts[0].partition("=")[0]: texts for texts in grid}
        seeds = max(seeds, len(axes.pop("seed", ())))
        controllers = axes.get("controller", ())
        if f"controller={baseline}" in controllers:
            lines = math.prod(map(len, axes.values()))
            comparisons += lines - lines // len(controllers)
    least = least_seeds(comparisons, confidence) if comparisons else 0
    if not 1 < seeds < least:
        return ""
    return f"{seeds} seeds cannot show a significant difference in a line; seed='range({least})' can"


def cell_key(record: Mapping[str, Any], inputs: Mapping[str, str]) -> str:
    """Key of one flight, the name of its file: sha256 of everything that decides it, 20 hex digits.

    record, inputs: of the flight, see identity.FlightIdentity.
    """
    return digest([SCHEMA, "evaluate", condition(record), sorted(inputs.items())])


def check_jobs(jobs: Iterable[Job]) -> dict[str, str]:
    """Key -> why the settings of a cell contradict each other, of those where they do, before anything is flown."""
    known: dict[tuple[Any, ...], str] = {}
    files: dict[str, str] = {}
    for job in jobs:
        config = job.cell.config
        checks = (
            (build_vehicle, config.vehicle),
            (_build_trajectory, config.trajectory, config.vehicle),
            (_build_effects, config.vehicle, *world_parts(config).values()),
        )
        for check, *nodes in checks:
            name = (check, *map(id, nodes))  # cells share the nodes of their configurations
            if name not in known:
                known[name] = ""
                try:
                    check(*nodes)
                except UsageError as error:
                    known[name] = str(error)
            if known[name]:
                files.setdefault(job.key, known[name])
    return files


def flying_order(jobs: Sequence[Job]) -> list[Job]:
    """Cells of the same controller one after the other, controllers of the same compiled structure next to each other.

    First comes one cell of every structure, so that the workers begin by compiling different ones in parallel.
    """
    groups: dict[bytes, dict[bytes, list[Job]]] = {}
    for job in jobs:
        structure, controller = _builds(job)
        groups.setdefault(structure, {}).setdefault(controller, []).append(job)
    grouped = [job for group in groups.values() for same in group.values() for job in same]
    if len(groups) > BUILDS_AT_ONCE:
        return grouped
    first = {job.key: job for group in groups.values() for job in next(iter(group.values()))[:1]}
    return [*first.values(), *(job for job in grouped if job.key not in first)]


def _builds(job: Job) -> tuple[bytes, bytes]:
    """What a worker builds for a cell: the structure that is compiled, and the controller with its numbers."""
    config = job.cell.config
    vehicle, controller = config.vehicle.recorded(), config.controller.recorded()
    structure = marshal.dumps([vehicle, [controller.get(name) for name in STRUCTURE]], 2)
    known = config.plant.recorded() if config.controller.knows_plant else job.model and job.model.sha256
    return structure, marshal.dumps([structure, controller, known], 2)


def _build_effects(vehicle: Any, *parts: Any) -> Any:
    return build_effects(build_vehicle(vehicle), *parts)


def _build_trajectory(trajectory: Any, vehicle: Any) -> Any:
    return build_trajectory(trajectory, build_vehicle(vehicle))
