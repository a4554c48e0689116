"""A real Slurm on this machine for a check: munged, slurmctld and one slurmd, on the loopback, ended afterwards.

Debian: apt-get install --no-install-recommends slurmctld slurmd slurm-client munge (run as root; nothing needs to be
configured or enabled).
"""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import textwrap
import time
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel")
CONF = """
    ClusterName=check
    SlurmctldHost={host}(127.0.0.1)
    SlurmctldPort={controller}
    SlurmdPort={daemon}
    CommunicationParameters=NoInAddrAny
    AuthType=auth/munge
    AuthInfo=socket={folder}/munge.socket
    CredType=cred/munge
    SlurmUser=root
    StateSaveLocation={folder}/state
    SlurmdSpoolDir={folder}/spool
    SlurmctldPidFile={folder}/slurmctld.pid
    SlurmdPidFile={folder}/slurmd.pid
    SlurmctldLogFile={folder}/slurmctld.log
    SlurmdLogFile={folder}/slurmd.log
    ProctrackType=proctrack/linuxproc
    TaskPlugin=task/none
    SelectType=select/cons_tres
    SelectTypeParameters=CR_Core
    SchedulerType=sched/backfill
    ReturnToService=2
    MpiDefault=none
    AccountingStorageType=accounting_storage/none
    JobAcctGatherType=jobacct_gather/none
    NodeName={host} NodeAddr=127.0.0.1 CPUs={cores} RealMemory=8000 State=UNKNOWN
    PartitionName=main Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


def missing() -> str:
    """What stands in the way of a Slurm here; empty if nothing does."""
    absent = [name for name in PROGRAMS if _path(name) is None]
    if absent:
        return f"{absent[0]} is not installed"
    return "" if os.getuid() == 0 else "slurmd runs as root"


class Slurm:
    """environment: what a process needs to use it."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._started = folder, []
        for name in ("state", "spool"):
            (folder / name).mkdir(parents=True)
        folder.chmod(0o755)
        conf = textwrap.dedent(CONF).strip() + "\n"
        ports = [_free_port(), _free_port()]
        (folder / "slurm.conf").write_text(
            conf.format(
                host=socket.gethostname().partition(".")[0],
                folder=folder,
                controller=ports[0],
                daemon=ports[1],
                cores=len(os.sched_getaffinity(0)),
            )
        )
        self.environment = {**os.environ, "SLURM_CONF": str(folder / "slurm.conf")}
        (folder / "munge.key").write_bytes(os.urandom(1024))
        (folder / "munge.key").chmod(0o400)
        places = [f"--{n}={folder}/munge.{n.split('-')[0]}" for n in ("key-file", "pid-file", "log-file", "seed-file")]
        self._start("munged", "--foreground", "--force", f"--socket={folder}/munge.socket", *places)
        self._await(lambda: (folder / "munge.socket").exists(), "munged")
        self._start("slurmctld", "-D")
        self._start("slurmd", "-D", "-N", socket.gethostname().partition(".")[0])
        self._await(lambda: "idle" in self.say("sinfo", "-h", "-o", "%T"), "a node")

    def say(self, program: str, *arguments: str) -> str:
        done = subprocess.run([_path(program), *arguments], env=self.environment, capture_output=True, text=True)
        return done.stdout

    def jobs(self) -> list[str]:
        return self.say("squeue", "-h", "-o", "%i").split()

    def stop(self) -> None:
        for job in self.jobs():
            self.say("scancel", job)
        for process in reversed(self._started):
            process.terminate()
            try:
                process.wait(timeout=10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _start(self, program: str, *arguments: str) -> None:
        with open(self._folder / f"{program}.out", "w") as out:
            self._started.append(
                subprocess.Popen([_path(program), *arguments], env=self.environment, stdout=out, stderr=out)
            )

    def _await(self, there, what: str) -> None:
        deadline = time.monotonic() + 30
        while not there():
            if time.monotonic() > deadline or any(process.poll() is not None for process in self._started):
                logs = "".join(path.read_text()[-1500:] for path in self._folder.glob("*.out"))
                self.stop()
                raise RuntimeError(f"no {what}: {logs}")
            time.sleep(0.1)


def _path(program: str) -> str | None:
    return shutil.which(program, path=f"{os.environ['PATH']}:/usr/sbin:/sbin")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
