"""Folders of results with errors that are known: any keys swept, without a simulation."""

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import describe, program_record, result_row
from quadexp.log.store import write_flight
from quadexp.parts.compose import expand
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.log.flights import straight_flight


def swept(out: Path, overrides: list[str], error: Callable[[Any], float | None]) -> Path:
    """Results of a sweep whose flights have these mean errors (m). error: None for a lost flight; it may raise
    UsageError where the settings contradict each other."""

    def cell(config, model, path, key):
        off = error(config)
        flight = straight_flight(5, (0.0 if off is None else off, 0.0, 0.0))
        if off is None:
            flight.metadata.update(outcome="lost", cause="lost on purpose")
        flight.metadata.update(describe(config, build_vehicle(config.vehicle), model))
        flight.metadata["row"] = result_row(config, flight) | {"key": key, **program_record()}
        write_flight(Path(path), flight, key=key)
        return flight.metadata["row"]

    run_sweep(expand(overrides), out, SweepRequest(function=cell, isolate=False))
    return out


def noise(*what: Any) -> float:
    """A number in [0, 1) that only `what` decides."""
    return zlib.crc32(repr(what).encode()) / 2**32


def refuse(config: Any) -> float:
    raise UsageError("does not fly")
