"""What a sweep has to do: the key of every cell, and the order that pays for every controller build once a worker.

Only keys are kept: a cell's configuration is made when it is needed, flown, and let go, so that the memory of a sweep
hardly grows with its cells. The nodes of a configuration are shared by many cells; each is written as JSON once.
"""

from __future__ import annotations

import hashlib
import sys
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from quadexp.config.cells import Cell
from quadexp.config.flight import TrajectoryConfig, VehicleConfig
from quadexp.config.schema import Config
from quadexp.experiment.build import (
    ModelFile,
    build_trajectory,
    build_vehicle,
    controller_settings,
    find_model,
    input_hashes,
    knows_plant,
)
from quadexp.experiment.identity import FLIGHT_GROUPS, canonical
from quadexp.sweep import keys as cell_keys

TEXTS_KEPT = 20_000  # nodes whose JSON is kept at most
BUILDS_AT_ONCE = 32  # structures that every worker surely keeps, see build.KEPT
_DIGEST = 10  # bytes of a key


@dataclass(frozen=True, slots=True)
class Job:
    """A cell with all that its flight reads: key of its file, condition (what was asked for), checkpoint.

    build: structure and controller, what a worker sets up once for all cells that share it.
    """

    key: str
    condition: str
    cell: Cell
    model: ModelFile | None
    build: tuple[str, str]


class Plan:
    """The jobs of a sweep, each once, in the order of the cells.

    Raises UsageError where a file that a cell needs is not there.
    """

    def __init__(self, cells: Sequence[Cell]) -> None:
        self._cells = cells
        self._texts: dict[int, tuple[Any, str]] = {}
        self._found: dict[tuple[Any, ...], tuple[ModelFile | None, dict[str, str]]] = {}
        self._checked: set[str] = set()
        self._conditions = bytearray()
        self._index = array("q")  # of the cell of a place
        self.places: dict[str, int] = {}  # of every key, from 0, in the order of the cells
        self.varied: list[str] = []  # of every place, see Cell
        for index, cell in enumerate(cells):
            job = self._job(cell)
            if job.key not in self.places:
                self.places[job.key] = len(self.places)
                self.varied.append(sys.intern(cell.varied))
                self._index.append(index)
                self._conditions += bytes.fromhex(job.condition)

    def __len__(self) -> int:
        return len(self.places)

    def __iter__(self) -> Iterator[Job]:
        return map(self.job, self.places)

    def conditions(self) -> set[str]:
        """What was asked for, whatever the files hold."""
        parts = range(0, len(self._conditions), _DIGEST)
        return {self._conditions[i : i + _DIGEST].hex() for i in parts}

    def job(self, key: str) -> Job:
        return self._job(self._cells[self._index[self.places[key]]])

    def check(self, keys: Iterable[str]) -> None:
        """Raise UsageError where the settings of a cell contradict each other, before anything is flown."""
        for key in keys:
            config = self.job(key).cell.config
            checks: tuple[tuple[tuple[Any, ...], Callable[..., Any]], ...] = (
                ((config.vehicle,), build_vehicle),
                ((config.trajectory, config.vehicle), _build_trajectory),
                ((config.controller,), controller_settings),
            )
            for nodes, check in checks:
                text = "".join(self._text(node) for node in nodes)
                if text not in self._checked:
                    check(*nodes)
                    self._checked.add(text)

    def flying_order(self, keys: Sequence[str]) -> Iterator[str]:
        """Cells that share a controller build one after the other, those that share its structure beside them.

        First goes one cell of every structure, so that the workers begin by compiling different ones side by side.
        """
        groups: dict[str, dict[str, array[int]]] = {}
        for place, key in enumerate(keys):
            structure, controller = self.job(key).build
            groups.setdefault(structure, {}).setdefault(controller, array("q")).append(place)
        first: set[int] = set()
        if len(groups) <= BUILDS_AT_ONCE:
            first = {next(iter(group.values()))[0] for group in groups.values()}
        yield from (keys[place] for place in sorted(first))
        for group in groups.values():
            for places in group.values():
                yield from (keys[place] for place in places if place not in first)

    def _job(self, cell: Cell) -> Job:
        config = cell.config
        controller, vehicle = self._text(config.controller), self._text(config.vehicle)
        own = (
            getattr(config.trajectory, "_target_", None),
            getattr(config.plant, "_target_", None),
            getattr(config.plant, "model", None),
        )
        reads = (config.model, controller, vehicle, getattr(config.trajectory, "path", None), *own)
        if reads not in self._found:
            model = find_model(config)
            self._found[reads] = model, input_hashes(config, model)
        model, inputs = self._found[reads]
        if model is None:
            config = replace(config, model=None)  # a checkpoint that the controller does not use decides nothing
            cell = replace(cell, config=config)
        condition = self._condition(config)
        key = f'[{cell_keys.SCHEMA},"evaluate",{condition},{canonical(sorted(inputs.items()))}]'
        believed = self._text(config.plant) if knows_plant(config.controller) else model.sha256 if model else ""
        return Job(_digest(key), _digest(condition), cell, model, (_structure(config, vehicle), controller + believed))

    def _condition(self, config: Config) -> str:
        """The JSON of keys.condition(config), from the JSON of its nodes."""
        texts = {group: self._text(getattr(config, group)) for group in FLIGHT_GROUPS}
        texts |= {"model": canonical(config.model), "seed": canonical(config.seed)}
        return "{" + ",".join(f'"{name}":{texts[name]}' for name in sorted(texts)) + "}"

    def _text(self, node: Any) -> str:
        known = self._texts.get(id(node))
        if known is not None:
            return known[1]
        record = asdict(node)
        record.pop("models", None)  # where a checkpoint was looked for; see keys.condition
        if len(self._texts) > TEXTS_KEPT:
            self._texts.clear()
        self._texts[id(node)] = node, canonical(record)  # the node is kept, so that its id stays its own
        return self._texts[id(node)][1]


def _build_trajectory(trajectory: TrajectoryConfig, vehicle: VehicleConfig) -> Any:
    return build_trajectory(trajectory, build_vehicle(vehicle))


def _structure(config: Config, vehicle: str) -> str:
    """What the functions of a controller are generated and compiled from, beside its numbers."""
    controller = config.controller
    names = ("kind", "residual", "nodes", "backend", "variant", "_target_")
    parts = [getattr(controller, name, None) for name in names]
    return canonical([vehicle, parts])


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[: 2 * _DIGEST]
