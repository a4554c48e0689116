"""The typed configuration of the engine: where the flights of a sweep run. Nothing here changes a flight."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from quadexp.config.fields import MISSING, Checked, choice, number


@dataclass
class EngineConfig(Checked):
    """kind: where. How many workers, how long and with how much memory a flight may run stands in `evaluate`."""

    prefix: ClassVar[str] = "engine."

    name: str = MISSING
    kind: str = choice("local", "dask", "slurm")


@dataclass
class ClusterConfig(EngineConfig):
    """What all clusters share. tls: encrypt and authenticate with certificates; made for the occasion unless given.
    Without it whoever reaches the scheduler can run code as the user. wait: how long a sweep goes on without a single
    worker."""

    tls: bool = True
    tls_ca: str | None = None
    tls_cert: str | None = None
    tls_key: str | None = None
    wait: float = number("(0, 604800]", "s")

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [value for value in (self.tls_ca, self.tls_cert, self.tls_key) if value is not None]
        if given and len(given) < 3:
            raise ValueError("engine.tls_ca, engine.tls_cert and engine.tls_key: give all three, or none")
        if given and not self.tls:
            raise ValueError("engine.tls=false: contradicts the certificates that are given; leave one of them out")


@dataclass
class DaskConfig(ClusterConfig):
    """A Dask cluster: one of this machine's own, the scheduler at `address`, or workers on `hosts` over SSH (the first
    host also runs the scheduler)."""

    address: str | None = None
    hosts: list[str] = field(default_factory=list)
    remote_python: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.address and self.hosts:
            raise ValueError("engine.address and engine.hosts: give one of them")
        if self.address:
            self._check_address(self.address)

    def _check_address(self, address: str) -> None:
        """A scheduler that somebody else started: certificates are given, or going without them is asked for."""
        encrypted = address.startswith("tls://")
        if encrypted and not self.tls:
            raise ValueError(f"engine.address={address}: contradicts engine.tls=false; leave that out")
        if self.tls and not encrypted:
            raise ValueError(
                f"engine.address={address}: is not encrypted; give a tls:// address with its certificates, or"
                " engine.tls=false, with which everybody who reaches that scheduler can run code as you"
            )
        if self.tls and self.tls_ca is None:
            raise ValueError(
                f"engine.address={address}: needs engine.tls_ca, engine.tls_cert and engine.tls_key, as the scheduler"
                " was given them"
            )


@dataclass
class SlurmConfig(ClusterConfig):
    """Jobs of a Slurm cluster, `evaluate.workers` of them, one worker each.

    job_memory: GB that is asked for. walltime: of a job, hh:mm:ss. queue, account, directives: as `sbatch` takes them.
    prologue: lines of shell before the worker starts. shared: folder that all nodes see, for certificates and logs.
    interface: network interface by which nodes reach the scheduler. python: of the nodes.
    """

    queue: str | None = None
    account: str | None = None
    walltime: str = MISSING
    job_memory: float = number("[0.5, 4096]", "GB")
    directives: list[str] = field(default_factory=list)
    prologue: list[str] = field(default_factory=list)
    shared: str | None = None
    interface: str | None = None
    python: str | None = None
