"""How clusters start: on this machine, at a scheduler's address, on hosts over SSH, in jobs of Slurm."""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster
from distributed.security import Security

from quadexp.config_engine import ClusterConfig, DaskConfig, SlurmConfig
from quadexp.errors import QuadexpError, UsageError
from quadexp.experiment.child import SAFE, THREADS, safe_path

CONNECT = 20.0  # s to wait for a scheduler
ENVIRONMENT = {"DASK_DISTRIBUTED__WORKER__DAEMON": "False", SAFE: "1", **dict.fromkeys(THREADS, "1")}
# A worker's cells run in children with a memory limit of their own; it must neither pause nor kill itself over them.
SETTINGS = {
    "distributed.worker.daemon": False,
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
    "distributed.nanny.pre-spawn-environ": dict.fromkeys((SAFE, *THREADS), "1"),
}


@contextlib.contextmanager
def open_cluster(config: ClusterConfig, workers: int) -> Iterator[Client]:
    """A client of the configured cluster; what was started for it ends with the context.

    workers: processes, where we start them. Raises UsageError for what the configuration gets wrong, QuadexpError where
    the cluster cannot be reached.
    """
    if not os.environ.get("QUADEXP_DEBUG"):
        for name in ("distributed", "dask_jobqueue", "asyncssh"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        stack.enter_context(safe_path())
        connect = {"distributed.comm.timeouts.connect": f"{CONNECT:g}s"}
        stack.enter_context(dask.config.set({**SETTINGS, **connect, **_tls_settings(config)}))
        where = _name(config)
        try:
            cluster = _cluster(config, workers, stack)
            client = Client(cluster, security=_security(config), timeout=CONNECT, set_as_default=False)
        except QuadexpError:
            raise
        except Exception as error:
            said = str(error).strip().splitlines() or [type(error).__name__]
            raise QuadexpError(f"{where} cannot be had: {said[0]}") from error
        stack.enter_context(client)
        yield client


def _name(config: ClusterConfig) -> str:
    """What to call the cluster in an error."""
    if not isinstance(config, DaskConfig):
        return "the Slurm cluster"
    if config.address:
        return f"engine.address={config.address}"
    return f"engine.hosts={','.join(config.hosts)}" if config.hosts else "a cluster of this machine"


def _cluster(config: ClusterConfig, workers: int, stack: contextlib.ExitStack) -> Any:
    """A cluster that ends with `stack`, or the address of one."""
    if isinstance(config, SlurmConfig):
        return stack.enter_context(_slurm(config, workers))
    assert isinstance(config, DaskConfig)
    if config.address:
        return config.address
    if config.hosts:
        return stack.enter_context(_ssh(config, workers))
    protocol = "tls://" if config.tls else "tcp://"
    cluster = LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        host="127.0.0.1",
        protocol=protocol,
        security=_security(config),
        dashboard_address="127.0.0.1:0",
        memory_limit=0,
        silence_logs=logging.CRITICAL,
    )
    return stack.enter_context(cluster)


_temporary: dict[str, Security] = {}


def _security(config: ClusterConfig) -> Security | None:
    """Certificates as given, made for the occasion, or none."""
    if not config.tls and not (isinstance(config, DaskConfig) and (config.address or "").startswith("tls:")):
        return None
    if config.tls_ca is not None:
        for name in ("tls_ca", "tls_cert", "tls_key"):
            if not Path(getattr(config, name)).is_file():
                raise UsageError(f"engine.{name}={getattr(config, name)}: no such file")
        cert = {f"tls_{role}_cert": config.tls_cert for role in ("client", "scheduler", "worker")}
        key = {f"tls_{role}_key": config.tls_key for role in ("client", "scheduler", "worker")}
        return Security(tls_ca_file=config.tls_ca, require_encryption=True, **cert, **key)
    if isinstance(config, DaskConfig) and (config.address or config.hosts):
        raise UsageError("engine.tls: a cluster elsewhere needs engine.tls_ca, engine.tls_cert and engine.tls_key")
    if isinstance(config, SlurmConfig) and config.shared is None:
        raise UsageError("engine.tls: Slurm's nodes need engine.shared=FOLDER to get the certificates")
    if "made" not in _temporary:
        _temporary["made"] = Security.temporary()
    return _temporary["made"]


def _tls_settings(config: ClusterConfig) -> dict[str, Any]:
    """Given certificates as Dask settings, which processes started over SSH inherit."""
    if not config.tls or config.tls_ca is None:
        return {}
    found: dict[str, Any] = {"distributed.comm.require-encryption": True}
    found["distributed.comm.tls.ca-file"] = config.tls_ca
    for role in ("client", "scheduler", "worker"):
        found[f"distributed.comm.tls.{role}.cert"] = config.tls_cert
        found[f"distributed.comm.tls.{role}.key"] = config.tls_key
    return found


def _ssh(config: DaskConfig, workers: int) -> Any:
    from distributed import SSHCluster

    protocol = "tls://" if config.tls else "tcp://"
    return SSHCluster(
        [config.hosts[0], *config.hosts],
        connect_options={"known_hosts": _known_hosts()},
        worker_options={
            "nthreads": 1,
            "n_workers": max(1, workers // len(config.hosts)),
            "memory_limit": 0,
            "protocol": protocol,
        },
        scheduler_options={"dashboard": False, "port": 0, "protocol": protocol},
        remote_python=f"{config.remote_python or sys.executable} -P",  # not from the folder it is started in
        security=_security(config),
    )


def _known_hosts() -> str:
    """SSH checks the hosts' keys, as on the command line."""
    return str(Path.home() / ".ssh" / "known_hosts")


def _slurm(config: SlurmConfig, workers: int) -> Any:
    from dask_jobqueue import SLURMCluster

    folder = Path(config.shared) if config.shared else None
    if folder is not None:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    cluster = SLURMCluster(
        cores=1,
        processes=1,
        memory=f"{config.job_memory:g}GB",
        walltime=config.walltime,
        queue=config.queue,
        account=config.account,
        interface=config.interface,
        python=config.python,
        job_extra_directives=list(config.directives),
        job_script_prologue=[*(f"export {k}={v}" for k, v in ENVIRONMENT.items()), *config.prologue],
        worker_extra_args=["--memory-limit", "0"],
        log_directory=str(folder / "logs") if folder else None,
        shared_temp_directory=str(folder) if folder else None,
        security=_security(config),
        protocol="tls://" if config.tls else None,
        scheduler_options={"dashboard": False},
        silence_logs="critical",
    )
    try:
        _refused(cluster.job_script())
    except BaseException:
        cluster.close()
        raise
    cluster.scale(jobs=workers)
    return cluster


def _refused(script: str) -> None:
    """Raise UsageError where Slurm would not take the job: dask-jobqueue only logs that, and no worker ever comes."""
    with tempfile.NamedTemporaryFile("w", suffix=".sh") as file:
        file.write(script)
        file.flush()
        try:
            done = subprocess.run(["sbatch", "--test-only", file.name], check=False, capture_output=True, text=True)
        except FileNotFoundError:
            raise UsageError("engine=slurm: there is no sbatch here") from None
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.strip()] or ["no reason given"]
        raise UsageError(f"engine=slurm: Slurm takes no such job: {said[0]}")
