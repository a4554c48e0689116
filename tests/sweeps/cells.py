"""Cell functions for tests of the engine and of sweeps, importable by worker processes."""

import ctypes
import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import describe, result_row
from quadexp.log.store import write_flight
from quadexp.sweeps.engine import Workers
from quadexp.writer import write_text
from tests.log.flights import straight_flight


def add(a, b):
    return a + b


def built_engine(config):
    """The engine that a configuration names."""
    return config.engine.build(config.evaluate)


def run_cells(function, jobs, *, workers=0, timeout=None, preload=()):
    """Key and result of every job, in processes of its own."""
    with Workers(workers, preload=preload) as processes:
        yield from processes.run(function, jobs, timeout=timeout)


def misbehave(what, folder):
    """What a poisoned cell can do; counts how often it was tried."""
    with open(Path(folder) / what, "a") as file:
        file.write("x")
    if what == "raise":
        raise ValueError("a bad\nday")
    if what == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    if what in ("exit", "end"):
        os._exit(3 * (what == "exit"))
    if what == "loop":
        while True:
            time.sleep(0.01)
    if what == "nap":
        time.sleep(1.0)
    if what == "kill_once" and len((Path(folder) / what).read_text()) == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return what


def quick_cell(config, model, path, key):
    """A flight without flying: its error is 10 mm times the seed."""
    flight = straight_flight(5, (0.01 * config.seed, 0.0, 0.0))
    flight.metadata.update(describe(config, build_vehicle(config.vehicle), model))
    flight.metadata["row"] = result_row(config, flight) | {"key": key}
    write_flight(Path(path), flight, key=key)
    count = Path(path).parents[2] / "counts" / key
    if count.parent.is_dir():
        with open(count, "a") as file:
            file.write("x")
    return flight.metadata["row"]


def contradicting_cell(config, model, path, key):
    """quick_cell, whose parts do not go with seed 1."""
    if config.seed == 1:
        raise UsageError("seed 1 does not go with this")
    return quick_cell(config, model, path, key)


@dataclass(frozen=True)
class CountedCell:
    """quick_cell, with a letter in a file for every try."""

    file: str

    def __call__(self, config, model, path, key):
        with open(self.file, "a") as file:
            file.write("x")
        return quick_cell(config, model, path, key)


def poisoned_cell(config, model, path, key):
    """Seed 1 kills its process while it writes, 2 raises, 3 never ends, 4 eats all memory, 5 segfaults."""
    if config.seed == 1:
        Path(path).with_name(f".quadexp-{os.getpid():016x}.tmp").write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)
    if config.seed == 2:
        raise ValueError("this seed does not work")
    if config.seed == 3:
        time.sleep(1000)
    if config.seed == 4:
        eaten = []
        while True:
            eaten.append(bytes(100_000_000))  # asked for and not written to: quick, and counted all the same
    if config.seed == 5:
        ctypes.string_at(0)
    return quick_cell(config, model, path, key)


@dataclass(frozen=True)
class HeldCell:
    """quick_cell, but the first try of each of some seeds never ends: its process waits to be killed, while it flies
    and holds nothing that other processes need. Its id then stands in a file, named after the seed."""

    folder: str
    seeds: tuple[int, ...]

    def __call__(self, config, model, path, key):
        mark = Path(self.folder) / str(config.seed)
        if config.seed in self.seeds and not mark.exists():
            write_text(mark, str(os.getpid()))  # at once or not at all
            while True:
                time.sleep(0.1)
        return quick_cell(config, model, path, key)

    def flown_by(self):
        """Ids of the processes that wait, once all of them do."""
        marks = [Path(self.folder) / str(seed) for seed in self.seeds]
        while not all(mark.exists() for mark in marks):
            time.sleep(0.01)
        return [int(mark.read_text()) for mark in marks]


def slow_cell(config, model, path, key):
    time.sleep(0.2)
    return quick_cell(config, model, path, key)


def foreign_cell(config, model, path, key):
    """A cell whose second seed another program has flown."""
    row = quick_cell(config, model, path, key)
    return row | ({"program": "9.9.9", "sources": "abcdef123456"} if config.seed == 1 else {})


def surroundings():
    """What a child has to import from."""
    return {"path": sys.path, "PYTHONPATH": os.environ.get("PYTHONPATH")}
