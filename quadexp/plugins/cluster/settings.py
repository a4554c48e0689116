"""Where the flights of a sweep run: a Dask cluster, or jobs of a queueing system."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from quadexp.errors import UsageError
from quadexp.parts.settings import Setting, key, keyed
from quadexp.sweeps.engine_settings import EngineConfig

if TYPE_CHECKING:
    from quadexp.sweeps.engine import Engine, Workers

Wait = Annotated[float, Setting("time without any worker after which the sweep stops", "(0, 604800]", "s")]


@keyed
class DaskConfig(EngineConfig):
    """A Dask cluster: started on this machine, or that of the scheduler at `address`, whose certificates are named by
    Dask's own settings (DASK_DISTRIBUTED__COMM__TLS__CA_FILE and its like)."""

    kind = "dask"
    address: str | None = key(
        None, "address of a running scheduler, such as tls://head:8786; null: start a cluster on this machine"
    )
    wait: Wait = 60.0
    needs: ClassVar[tuple[str, ...]] = ("distributed", "cryptography")  # packages

    def build(self, settings: Any, processes: Workers | None = None) -> Engine:
        """See EngineConfig.build."""
        for name in self.needs:
            try:
                importlib.import_module(name)
            except ImportError:
                extra = "pip install 'quadexp[cluster]'"
                raise UsageError(f"engine={self.name} needs {name}, which is not (wholly) installed: {extra}") from None
        from quadexp.plugins.cluster.cluster import DaskEngine, open_cluster
        from quadexp.sweeps.engine import default_workers

        workers = settings.workers or default_workers()
        return DaskEngine(lambda: open_cluster(self, workers), settings.timeout, settings.memory or None, self.wait)


@keyed
class JobsConfig(DaskConfig):
    """Jobs of a queueing system, `evaluate.workers` of them with one worker each, submitted by dask-jobqueue.

    options: arguments of its SLURMCluster, PBSCluster, ...: queue, account, memory, walltime, interface, python,
    job_extra_directives, job_script_prologue, shared_temp_directory. They become the shell script of a job.
    """

    kind = "jobs"
    needs = (*DaskConfig.needs, "dask_jobqueue")
    system: Literal["slurm", "pbs", "lsf", "sge"] = key("slurm", "queueing system")
    options: dict[str, Any] = key({}, "what dask-jobqueue is given, such as {queue: short, memory: 3GB}")
    wait: Wait = 3600.0
