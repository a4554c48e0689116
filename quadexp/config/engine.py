"""Settings of the engine: where the flights of a sweep run. Nothing here changes a flight."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from quadexp.config.part import Part
from quadexp.config.settings import Setting
from quadexp.errors import UsageError


@dataclass(frozen=True, kw_only=True)
class EngineConfig(Part):
    """Where the flights run; number of workers and limits of time and memory are settings of `evaluate`."""

    prefix: ClassVar[str] = "engine."

    kind: Annotated[Literal["local", "dask", "slurm"], Setting("where the flights run")] = "local"


@dataclass(frozen=True, kw_only=True)
class ClusterConfig(EngineConfig):
    """What all clusters share. tls: encrypt and authenticate with certificates, which are made for the sweep unless
    given; without it anybody who reaches the scheduler can run code as the user."""

    tls: Annotated[
        bool,
        Setting(
            "encrypt and authenticate with certificates, made for the sweep unless given; false: others can run code"
        ),
    ] = True
    tls_ca: Annotated[str | None, Setting("file of the certificate authority")] = None
    tls_cert: Annotated[str | None, Setting("file of the certificate")] = None
    tls_key: Annotated[str | None, Setting("file of the certificate's key")] = None
    wait: Annotated[float, Setting("time without any worker after which the sweep stops", "(0, 604800]", "s")] = 60.0

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [value for value in (self.tls_ca, self.tls_cert, self.tls_key) if value is not None]
        if given and len(given) < 3:
            raise UsageError("engine.tls_ca, engine.tls_cert and engine.tls_key: give all three, or none")
        if given and not self.tls:
            raise UsageError("engine.tls=false: contradicts the certificates that are given; leave one of them out")


@dataclass(frozen=True, kw_only=True)
class DaskConfig(ClusterConfig):
    """A Dask cluster: started on this machine, the scheduler at `address`, or workers on `hosts` over SSH (the first
    host also runs the scheduler)."""

    kind: Annotated[Literal["dask"], Setting("where the flights run")] = "dask"
    address: Annotated[
        str | None,
        Setting("address of a running scheduler, such as tls://head:8786; null: start a cluster on this machine"),
    ] = None
    hosts: Annotated[
        tuple[str, ...], Setting("hosts that run workers, started over SSH; the first also runs the scheduler")
    ] = ()
    remote_python: Annotated[str | None, Setting("Python interpreter of the hosts; null: the same path as here")] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.address and self.hosts:
            raise UsageError("engine.address and engine.hosts: give one of them")
        if self.address:
            self._check_address(self.address)

    def _check_address(self, address: str) -> None:
        """A scheduler that somebody else started: certificates are given, or going without them is asked for."""
        encrypted = address.startswith("tls://")
        if encrypted and not self.tls:
            raise UsageError(f"engine.address={address}: contradicts engine.tls=false; leave that out")
        if self.tls and not encrypted:
            raise UsageError(
                f"engine.address={address}: is not encrypted; give a tls:// address with its certificates, or"
                " engine.tls=false, with which everybody who reaches that scheduler can run code as you"
            )
        if self.tls and self.tls_ca is None:
            raise UsageError(
                f"engine.address={address}: needs engine.tls_ca, engine.tls_cert and engine.tls_key, as the scheduler"
                " was given them"
            )


@dataclass(frozen=True, kw_only=True)
class SlurmConfig(ClusterConfig):
    """Jobs of a Slurm cluster, `evaluate.workers` of them, one worker each.

    job_memory: GB that is asked for. walltime: of a job, hh:mm:ss. queue, account, directives: as `sbatch` takes them.
    prologue: lines of shell before the worker starts. shared: folder that all nodes see, for certificates and logs.
    interface: network interface by which nodes reach the scheduler. python: of the nodes.
    """

    kind: Annotated[Literal["slurm"], Setting("where the flights run")] = "slurm"
    queue: Annotated[str | None, Setting("partition, as sbatch takes it")] = None
    account: Annotated[str | None, Setting("account, as sbatch takes it")] = None
    walltime: Annotated[str, Setting("time limit of a job, hh:mm:ss")] = "01:00:00"
    job_memory: Annotated[float, Setting("memory requested for a job; one worker per job", "[0.5, 4096]", "GB")] = 2.0
    directives: Annotated[tuple[str, ...], Setting("more options of sbatch")] = ()
    prologue: Annotated[tuple[str, ...], Setting("lines of shell before a worker starts")] = ()
    shared: Annotated[
        str | None,
        Setting("folder that all nodes see, for certificates and logs; needed with engine.tls"),
    ] = None
    interface: Annotated[str | None, Setting("network interface by which nodes reach the scheduler")] = None
    python: Annotated[str | None, Setting("Python interpreter of the nodes; null: the same path as here")] = None

    def __post_init__(self) -> None:
        """What stands in the script of a job is a word of the shell, or one line: only `prologue` is shell."""
        super().__post_init__()
        for name in ("queue", "account", "walltime", "shared", "interface", "python", "tls_ca", "tls_cert", "tls_key"):
            value = getattr(self, name)
            if value is not None and shlex.quote(value) != value:
                raise UsageError(
                    f"engine.{name}={value!r}: must be one word of letters, digits and @%+=:,./-_: it stands in the"
                    " script of a job"
                )
        for directive in self.directives:
            if not directive.isprintable():
                raise UsageError(f"engine.directives={directive!r}: each must be one line")
