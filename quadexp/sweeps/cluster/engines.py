"""The engine that a configuration names."""

from __future__ import annotations

import contextlib
import importlib
from collections.abc import Iterator
from dataclasses import replace

from quadexp.config.engine import ClusterConfig, DaskConfig, SlurmConfig
from quadexp.config.schema import Config
from quadexp.errors import UsageError
from quadexp.sweeps.engine import Engine, LocalEngine, Workers, default_workers

EXTRA = "pip install 'quadexp[cluster]'"


def build_engine(config: Config, processes: Workers | None = None) -> Engine:
    """The engine; nothing is started before the first cell is flown.

    processes: of this machine, in which it may fly; None for some of its own.
    Raises UsageError where a package that it needs is not installed.
    """
    settings = config.evaluate
    memory = settings.memory or None
    engine = config.engine
    if not isinstance(engine, ClusterConfig):
        return LocalEngine(settings.workers, settings.timeout, memory, processes)
    needed = ["distributed"]
    needed += ["cryptography"] if engine.tls else []
    needed += ["dask_jobqueue"] if isinstance(engine, SlurmConfig) else []
    needed += ["asyncssh"] if isinstance(engine, DaskConfig) and engine.hosts else []
    for name in needed:
        try:
            importlib.import_module(name)
        except ImportError:
            raise UsageError(f"engine={engine.name} needs {name}, which is not (wholly) installed: {EXTRA}") from None
    from quadexp.sweeps.cluster.driver import DaskEngine
    from quadexp.sweeps.cluster.start import open_cluster

    workers = settings.workers or default_workers()
    return DaskEngine(lambda: open_cluster(engine, workers), settings.timeout, memory, engine.wait)


@contextlib.contextmanager
def open_engine(config: Config, processes: Workers | None = None) -> Iterator[Engine]:
    """The same engine for several rounds of flights: its cluster is opened once, and ends with the context."""
    engine = build_engine(config, processes)
    if isinstance(engine, LocalEngine):
        yield engine
        return
    from quadexp.sweeps.cluster.driver import DaskEngine

    assert isinstance(engine, DaskEngine)
    with engine.open() as client:
        yield replace(engine, open=lambda: contextlib.nullcontext(client))


@contextlib.contextmanager
def opened(config: Config, calls: int) -> Iterator[Engine]:
    """The engine with processes of its own on this machine, which end with the context. calls: flights at least."""
    settings = config.evaluate
    with (
        Workers(settings.workers, settings.memory or None, calls=calls) as processes,
        open_engine(config, processes) as engine,
    ):
        yield engine
