"""Settings of the engine: where the flights of a sweep run. Nothing here changes a flight."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from quadexp.parts.part import Part
from quadexp.parts.settings import Setting, key, keyed

Wait = Annotated[float, Setting("time without any worker after which the sweep stops", "(0, 604800]", "s")]


@keyed
class EngineConfig(Part):
    """Where the flights run; number of workers and limits of time and memory are settings of `evaluate`."""

    prefix = "engine."

    kind: ClassVar[str] = "local"


@keyed
class DaskConfig(EngineConfig):
    """A Dask cluster: started on this machine, or that of the scheduler at `address`, whose certificates are named by
    Dask's own settings (DASK_DISTRIBUTED__COMM__TLS__CA_FILE and its like)."""

    kind = "dask"
    address: str | None = key(
        None, "address of a running scheduler, such as tls://head:8786; null: start a cluster on this machine"
    )
    wait: Wait = 60.0


@keyed
class JobsConfig(EngineConfig):
    """Jobs of a queueing system, `evaluate.workers` of them with one worker each, submitted by dask-jobqueue.

    options: arguments of its SLURMCluster, PBSCluster, ...: queue, account, memory, walltime, interface, python,
    job_extra_directives, job_script_prologue, shared_temp_directory. They become the shell script of a job.
    """

    kind = "jobs"
    system: Literal["slurm", "pbs", "lsf", "sge"] = key("slurm", "queueing system")
    options: dict[str, Any] = key({}, "what dask-jobqueue is given, such as {queue: short, memory: 3GB}")
    wait: Wait = 3600.0
