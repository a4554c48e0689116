"""Keys and options of earlier versions: each is refused by name, with what stands for it today (docs/migrating.md)."""

from __future__ import annotations

from quadexp.errors import UsageError

_HOSTS = "start `dask scheduler` and `dask worker` on the hosts, and give engine=dask engine.address=tls://HEAD:PORT"
_TLS = "what is started here is always encrypted, and engine.address says by tls:// or tcp:// whether it is"
_JOBS = "engine=jobs 'engine.options={{{}}}'"

FORMER = {
    "engine=slurm": "engine=jobs (engine.system=slurm), and what its queue takes in engine.options",
    "engine.tls": _TLS,
    "engine.hosts": _HOSTS,
    "engine.remote_python": _HOSTS,
    "engine.queue": _JOBS.format("queue: NAME"),
    "engine.account": _JOBS.format("account: NAME"),
    "engine.walltime": _JOBS.format("walltime: HH:MM:SS"),
    "engine.job_memory": _JOBS.format("memory: 3GB"),
    "engine.directives": _JOBS.format("job_extra_directives: [...]"),
    "engine.prologue": _JOBS.format("job_script_prologue: [...]"),
    "engine.shared": _JOBS.format("shared_temp_directory: FOLDER"),
    "engine.interface": _JOBS.format("interface: ib0"),
    "engine.python": _JOBS.format("python: PATH"),
}


def refuse_former(text: str) -> None:
    """UsageError where a key, or GROUP=OPTION, is one of an earlier version."""
    if text in FORMER:
        raise UsageError(f"{text}: is no more: {FORMER[text]}")
