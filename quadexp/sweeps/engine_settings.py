"""Settings of the engine: where the flights of a sweep run. Nothing here changes a flight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal

from quadexp.errors import UsageError
from quadexp.parts.part import Part
from quadexp.parts.settings import Setting, key

CERTIFICATES = ("tls_ca", "tls_cert", "tls_key")
Wait = Annotated[float, Setting("time without any worker after which the sweep stops", "(0, 604800]", "s")]


@dataclass(frozen=True, kw_only=True)
class EngineConfig(Part):
    """Where the flights run; number of workers and limits of time and memory are settings of `evaluate`."""

    prefix: ClassVar[str] = "engine."

    kind: ClassVar[str] = "local"


@dataclass(frozen=True, kw_only=True)
class DaskConfig(EngineConfig):
    """A Dask cluster: started on this machine, or that of the scheduler at `address`, with the certificates that it was
    given."""

    kind = "dask"
    address: str | None = key(
        None, "address of a running scheduler, such as tls://head:8786; null: start a cluster on this machine"
    )
    tls_ca: str | None = key(None, "file of the certificate authority of that scheduler")
    tls_cert: str | None = key(None, "file of the certificate")
    tls_key: str | None = key(None, "file of the certificate's key")
    wait: Wait = 60.0

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [name for name in CERTIFICATES if getattr(self, name) is not None]
        encrypted = self.address is not None and self.address.startswith("tls://")
        if self.address and not self.address.startswith(("tls://", "tcp://")):
            raise UsageError(f"engine.address={self.address}: must begin with tls://, or with tcp:// if not encrypted")
        if encrypted and len(given) < len(CERTIFICATES):
            raise UsageError(
                f"engine.address={self.address}: needs engine.tls_ca, engine.tls_cert and engine.tls_key, as the"
                " scheduler was given them"
            )
        if given and not encrypted:
            raise UsageError(f"engine.{given[0]}: is of a scheduler at engine.address=tls://...; leave it out")


@dataclass(frozen=True, kw_only=True)
class JobsConfig(EngineConfig):
    """Jobs of a queueing system, `evaluate.workers` of them with one worker each, submitted by dask-jobqueue.

    options: arguments of its SLURMCluster, PBSCluster, ...: queue, account, memory, walltime, interface, python,
    job_extra_directives, job_script_prologue, shared_temp_directory. They become the shell script of a job.
    """

    kind = "jobs"
    system: Literal["slurm", "pbs", "lsf", "sge"] = key("slurm", "queueing system")
    options: dict[str, Any] = key({}, "what dask-jobqueue is given, such as {queue: short, memory: 3GB}")
    wait: Wait = 3600.0
