"""Starting a cluster: on this machine, at the address of a scheduler, on hosts over SSH, in jobs of Slurm."""

from __future__ import annotations

import contextlib
import logging
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster

from quadexp.config.engine import ClusterConfig, DaskConfig, SlurmConfig
from quadexp.errors import QuadexpError, UsageError
from quadexp.sweeps.cluster.certificates import handed_out, security, settings
from quadexp.sweeps.server import SAFE, THREADS, safe_path

UNPROTECTED = "engine.tls=false: whoever reaches the scheduler or a worker can run code as you"
# The web server of a scheduler and of a worker, which Dask starts with or without a dashboard.
LOOPBACK = "127.0.0.1:0"
CONNECT = 20.0  # s to wait for a scheduler
ENVIRONMENT = {"DASK_DISTRIBUTED__WORKER__DAEMON": "False", SAFE: "1", **dict.fromkeys(THREADS, "1")}
# Cells run in children with a memory limit of their own; the worker must neither pause nor end because of their memory.
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
    """A client of the configured cluster; everything that was started for it ends with the context.

    workers: number of processes to start. Raises UsageError for a wrong configuration, QuadexpError where the cluster
    cannot be reached.
    """
    if not os.environ.get("QUADEXP_DEBUG"):
        for name in ("distributed", "dask_jobqueue", "asyncssh"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    with contextlib.ExitStack() as stack:
        stack.enter_context(safe_path())
        connect = {"distributed.comm.timeouts.connect": f"{CONNECT:g}s"}
        stack.enter_context(dask.config.set({**SETTINGS, **connect}))
        where = _name(config)
        if not config.tls:
            print(f"warning: {UNPROTECTED}", file=sys.stderr, flush=True)
        try:
            cluster = _cluster(config, workers, stack)
            client = Client(cluster, security=security(config), timeout=CONNECT, set_as_default=False)
        except QuadexpError:
            raise
        except Exception as error:
            said = str(error).strip().splitlines() or [type(error).__name__]
            raise QuadexpError(f"{where} cannot be had: {said[0]}") from error
        stack.enter_context(client)
        yield client


def _name(config: ClusterConfig) -> str:
    """Name of the cluster for an error message."""
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
        return _ssh(config, workers, stack)
    protocol = "tls://" if config.tls else "tcp://"
    cluster = LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        host="127.0.0.1",
        protocol=protocol,
        security=security(config),
        dashboard_address=LOOPBACK,
        memory_limit=0,
        silence_logs=logging.CRITICAL,
    )
    return stack.enter_context(cluster)


def _ssh(config: DaskConfig, workers: int, stack: contextlib.ExitStack) -> Any:
    from distributed import SSHCluster

    protocol = "tls://" if config.tls else "tcp://"
    options = {"known_hosts": _known_hosts()}
    known = security(config)
    if config.tls_ca and config.tls_cert and config.tls_key:
        stack.enter_context(dask.config.set(settings(config.tls_ca, config.tls_cert, config.tls_key)))
    elif known is not None:
        file = stack.enter_context(handed_out(known, config.hosts, options))
        stack.enter_context(dask.config.set(settings(file, file, file)))
    cluster = SSHCluster(
        [config.hosts[0], *config.hosts],
        connect_options=options,
        worker_options={
            "nthreads": 1,
            "n_workers": max(1, workers // len(config.hosts)),
            "memory_limit": 0,
            "protocol": protocol,
            "dashboard_address": LOOPBACK,
        },
        scheduler_options={"dashboard": False, "dashboard_address": LOOPBACK, "port": 0, "protocol": protocol},
        remote_python=f"{shlex.quote(config.remote_python or sys.executable)} -P",  # -P: nothing of the current folder
        security=known,
    )
    return stack.enter_context(cluster)


def _known_hosts() -> str:
    """File with the hosts' keys, which SSH checks as on the command line."""
    return str(Path.home() / ".ssh" / "known_hosts")


def _slurm(config: SlurmConfig, workers: int) -> Any:
    from dask_jobqueue import SLURMCluster

    folder = Path(config.shared) if config.shared else None
    if folder is None and config.tls and config.tls_ca is None:
        raise UsageError(
            "engine=slurm: its nodes get their certificates in engine.shared=FOLDER, one that all nodes see and nobody"
            " else writes to; or engine.tls=false, with which everybody on that network can run code as you"
        )
    if folder is not None:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.stat()
        if config.tls and (found.st_uid != os.getuid() or found.st_mode & 0o022):
            raise UsageError(f"engine.shared={folder}: others may write there, where certificates lie: use another")
    cluster = SLURMCluster(
        cores=1,
        processes=1,
        memory=f"{config.job_memory:g}GB",
        walltime=config.walltime,
        queue=config.queue,
        account=config.account,
        interface=config.interface,
        python=config.python or shlex.quote(sys.executable),
        job_extra_directives=list(config.directives),
        job_script_prologue=[*(f"export {k}={v}" for k, v in ENVIRONMENT.items()), *config.prologue],
        worker_extra_args=["--memory-limit", "0", "--no-dashboard", "--dashboard-address", LOOPBACK],
        log_directory=str(folder / "logs") if folder else None,
        shared_temp_directory=str(folder) if folder else None,
        security=security(config),
        protocol="tls://" if config.tls else None,
        scheduler_options={"dashboard": False, "dashboard_address": LOOPBACK},
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
    """Raise UsageError where Slurm refuses the job: dask-jobqueue only logs that, and no worker would ever start."""
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
