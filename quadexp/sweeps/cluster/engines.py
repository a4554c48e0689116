"""The engine that a configuration names."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from quadexp.errors import UsageError
from quadexp.parts.schema import Config
from quadexp.sweeps.engine import Engine, LocalEngine, Workers, default_workers
from quadexp.sweeps.engine_settings import DaskConfig, JobsConfig

NEEDED = {"dask": ("distributed", "cryptography"), "jobs": ("distributed", "cryptography", "dask_jobqueue")}


def build_engine(config: Config, processes: Workers | None = None) -> Engine:
    """The engine; nothing is started before the first cell is flown.

    processes: of this machine, in which it may fly; None for some of its own.
    Raises UsageError where a package that it needs is not installed.
    """
    settings, engine = config.evaluate, config.engine
    memory = settings.memory or None
    if not isinstance(engine, DaskConfig | JobsConfig):
        return LocalEngine(settings.workers, settings.timeout, memory, processes)
    for name in NEEDED[engine.kind]:
        try:
            importlib.import_module(name)
        except ImportError:
            extra = "pip install 'quadexp[cluster]'"
            raise UsageError(f"engine={engine.name} needs {name}, which is not (wholly) installed: {extra}") from None
    from quadexp.sweeps.cluster.driver import DaskEngine
    from quadexp.sweeps.cluster.start import open_cluster

    workers = settings.workers or default_workers()
    return DaskEngine(lambda: open_cluster(engine, workers), settings.timeout, memory, engine.wait)


@contextlib.contextmanager
def opened(config: Config, calls: int) -> Iterator[Engine]:
    """The engine for several rounds of flights: its processes, or its cluster, are started once and end with the
    context. calls: flights at least."""
    settings = config.evaluate
    with Workers(settings.workers, settings.memory or None, calls=calls) as processes:
        engine: Any = build_engine(config, processes)
        if isinstance(engine, LocalEngine):
            yield engine
            return
        with engine.open() as client:
            yield replace(engine, open=lambda: contextlib.nullcontext(client))
