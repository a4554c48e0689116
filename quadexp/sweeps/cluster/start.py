"""Starting a cluster: on this machine, at the address of a scheduler, in jobs of a queueing system.

What is started here talks over TLS with a certificate made for it, which never appears on a command line: processes of
this machine receive it through their pipes, jobs in files that only the user may read.
"""

from __future__ import annotations

import contextlib
import logging
import os
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask
from distributed import Client, LocalCluster
from distributed.security import Security

from quadexp.errors import QuadexpError, UsageError
from quadexp.files.cache import cache_folder
from quadexp.sweeps.engine_settings import CERTIFICATES, DaskConfig, JobsConfig
from quadexp.sweeps.server import SAFE, THREADS, safe_path

# The web server of a scheduler and of a worker, which Dask starts with or without a dashboard.
LOOPBACK = "127.0.0.1:0"
CONNECT = 20.0  # s to wait for a scheduler
SYSTEMS = {"slurm": "SLURMCluster", "pbs": "PBSCluster", "lsf": "LSFCluster", "sge": "SGECluster"}
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
def open_cluster(config: DaskConfig | JobsConfig, workers: int) -> Iterator[Client]:
    """A client of the configured cluster; everything that was started for it ends with the context.

    workers: number of processes to start. Raises UsageError for a wrong configuration, QuadexpError where the cluster
    cannot be reached.
    """
    if not os.environ.get("QUADEXP_DEBUG"):
        for name in ("distributed", "dask_jobqueue"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
    connect = {"distributed.comm.timeouts.connect": f"{CONNECT:g}s"}
    address = getattr(config, "address", None)
    with contextlib.ExitStack() as stack:
        stack.enter_context(safe_path())
        stack.enter_context(dask.config.set({**SETTINGS, **connect}))
        try:
            security = _certificates(config) if address else Security.temporary()
            cluster = address or stack.enter_context(_started(config, workers, security))
            client = Client(cluster, security=security, timeout=CONNECT, set_as_default=False)
        except QuadexpError:
            raise
        except Exception as error:
            where = f"engine.address={address}" if address else f"engine={config.name}"
            said = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
            raise QuadexpError(f"{where} cannot be had: {said[-1]}") from error
        stack.enter_context(client)
        yield client


def _certificates(config: Any) -> Security | None:
    """The certificates of a scheduler that somebody else started; None where it is not encrypted, which is said.

    Raises UsageError for a missing file, or a key that others may read.
    """
    files = {name: getattr(config, name) for name in CERTIFICATES}
    if None in files.values():
        said = "is not encrypted. Anybody who can reach the scheduler or a worker can run code as you"
        print(f"warning: engine.address={config.address}: {said}", file=sys.stderr, flush=True)
        return None
    for name, file in files.items():
        if not Path(file).is_file():
            raise UsageError(f"engine.{name}={file}: no such file")
    if Path(files["tls_key"]).stat().st_mode & 0o077:
        raise UsageError(f"engine.tls_key={config.tls_key}: others may read or change it: chmod go= it")
    own = {"tls_client_cert": files["tls_cert"], "tls_client_key": files["tls_key"]}
    return Security(tls_ca_file=files["tls_ca"], require_encryption=True, **own)


def _started(config: DaskConfig | JobsConfig, workers: int, security: Security | None) -> Any:
    """A cluster of this machine, or of jobs, as a context."""
    if isinstance(config, JobsConfig):
        return _of_jobs(config, workers, security)
    return LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        host="127.0.0.1",
        protocol="tls://",
        security=security,
        dashboard_address=LOOPBACK,
        memory_limit=0,
        silence_logs=logging.CRITICAL,
    )


@contextlib.contextmanager
def _of_jobs(config: JobsConfig, workers: int, security: Security | None) -> Iterator[Any]:
    """Jobs of one worker each. Raises what the queue says where it refuses one."""
    import dask_jobqueue

    usual = {"memory": "2GB", "walltime": "01:00:00", "python": shlex.quote(sys.executable)}
    options = {**usual, "shared_temp_directory": str(cache_folder().path), **config.options}
    folder = Path(options["shared_temp_directory"])
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if folder.stat().st_uid != os.getuid() or folder.stat().st_mode & 0o022:
        raise UsageError(
            f"engine={config.name}: others may write to {folder}, where certificates lie: give another folder that all"
            " nodes see, as engine.options={shared_temp_directory: FOLDER}"
        )
    exported = [f"export {name}={value}" for name, value in ENVIRONMENT.items()]
    options["job_script_prologue"] = [*exported, *options.get("job_script_prologue", ())]
    fixed = {
        "cores": 1,
        "processes": 1,
        "worker_extra_args": ["--memory-limit", "0", "--no-dashboard", "--dashboard-address", LOOPBACK],
        "security": security,
        "protocol": "tls://",
        "scheduler_options": {"dashboard": False, "dashboard_address": LOOPBACK},
        "silence_logs": "critical",
    }
    if taken := sorted(fixed.keys() & options.keys()):
        raise UsageError(f"engine.options={{{taken[0]}: ...}}: is set by this program; leave it out")
    cluster = getattr(dask_jobqueue, SYSTEMS[config.system])(**options, **fixed)
    try:
        for _ in range(workers):
            cluster.worker_spec.update(cluster.new_worker_spec())
        cluster.sync(cluster._correct_state)  # `scale` would only log that the queue refuses a job
        yield cluster
    finally:
        with contextlib.suppress(AssertionError):  # of jobs that never were
            cluster.close()
