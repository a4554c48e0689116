"""Who may run code on a cluster: its owner, and nobody else on the machine or the network."""

import contextlib
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
pytest.importorskip("cryptography", reason="the extra `cluster` is not installed")

import dask
from distributed.security import Security

from quadexp.errors import QuadexpError
from quadexp.parts.compose import compose, expand
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.experiment.same import same_results
from tests.plugins.cluster.dask_cluster import ROOT, Cluster
from tests.processes import descendants
from tests.sweeps import cells
from tests.sweeps.cells import built_engine

pytestmark = pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs /proc")

GRID = "seed=range(12)"
NOBODY = 65534
# Tries, as another user where it may become one, to run code behind every port, with no certificate and with its own.
INTRUDER = """
import asyncio, os, sys
import cloudpickle
from distributed.core import rpc
from distributed.security import Security

mark, ports = sys.argv[1], sys.argv[2:]
own = Security.temporary()
if os.getuid() == 0:
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)

def payload(mark=mark):
    import os
    with open(mark, "a") as file:
        file.write(f"{os.getuid()} ")

async def attack(address, security, method):
    there = rpc(address, connection_args=security.get_connection_args("client") if security else {}, timeout=5)
    await getattr(there, method)(function=cloudpickle.dumps(payload), args=(), kwargs={}, wait=True)

async def main():
    tries = {
        asyncio.ensure_future(attack(f"{protocol}://127.0.0.1:{port}", security, method)): f"{protocol} {port} {method}"
        for port in ports for protocol, security in (("tcp", None), ("tls", own)) for method in ("run", "run_function")
    }
    for task in (await asyncio.wait(tries, timeout=20))[0]:
        print(tries[task], repr(task.exception()))
    print("tried", len(ports), "as", os.getuid(), flush=True)
    os._exit(0)

asyncio.run(main())
"""


def listening():
    """(address, port) of every TCP socket on which this process or what it started listens."""
    own = {os.getpid(), *(pid for pid, _ in descendants(os.getpid()))}
    inodes = set()
    for pid in own:
        try:
            links = [os.readlink(entry.path) for entry in os.scandir(f"/proc/{pid}/fd")]
        except OSError:
            continue
        inodes |= {link[8:-1] for link in links if link.startswith("socket:")}
    found = set()
    for file, family in (("/proc/net/tcp", socket.AF_INET), ("/proc/net/tcp6", socket.AF_INET6)):
        for line in Path(file).read_text().splitlines()[1:] if Path(file).exists() else ():
            words = line.split()
            if words[3] == "0A" and words[9] in inodes:
                host, port = words[1].split(":")
                raw = b"".join(bytes.fromhex(host[i : i + 8])[::-1] for i in range(0, len(host), 8))
                found.add((socket.inet_ntop(family, raw), int(port, 16)))
    return found


def answers_http(host, port):
    """Whether a web server listens there."""
    with socket.create_connection((host, port), timeout=5) as connection:
        try:
            connection.sendall(b"GET / HTTP/1.0\r\n\r\n")
            return connection.recv(4) == b"HTTP"
        except OSError:
            return False


def test_nobody_else_runs_code_on_a_cluster_of_this_machine(tmp_path, capfd):
    """The attack that does something to a scheduler without certificates (the next test) does nothing here."""
    addresses, ports, said = set(), [], []

    def intrude(done, total):
        if done == 2:
            addresses.update(listening())
            ports.extend(str(port) for host, port in addresses if not answers_http(host, port))  # a page runs nothing
            said.append(intrusion(tmp_path, ports))

    engine = built_engine(compose(["engine=dask", "evaluate.workers=1"]))
    result = run_sweep(
        expand([GRID]), tmp_path / "r", SweepRequest(function=cells.slow_cell, engine=engine, progress=intrude)
    )
    assert result.flown == 12 and not result.not_flown
    assert len(ports) >= 3, "scheduler, nanny, worker"
    assert {host for host, _ in addresses} == {"127.0.0.1"}, "the dashboard too listens on the loopback only"
    assert said == [[f"tried {len(ports)} as {os.getuid() or NOBODY}"]]
    mark = tmp_path / "mark"
    assert not mark.exists(), f"code of another user was run as {mark.read_text()}"
    assert "warning: " not in capfd.readouterr().err


def test_an_address_without_certificates_is_warned_of_and_everybody_runs_code_there(tmp_path, capfd):
    cluster, said = Cluster(tmp_path / "cluster", workers=1), []
    engine = built_engine(compose(["engine=dask", f"engine.address={cluster.address}"]))
    port = cluster.address.rpartition(":")[2]
    try:
        run_sweep(
            expand(["seed=range(4)"]), tmp_path / "r", SweepRequest(function=cells.slow_cell, engine=engine,
            progress=lambda done, total: said.append(intrusion(tmp_path, [port])) if done == 1 else None),
        )  # fmt: skip
    finally:
        cluster.stop()
    assert said == [[f"tried 1 as {os.getuid() or NOBODY}"]] and (tmp_path / "mark").exists()
    warnings = [line for line in capfd.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert len(warnings) == 1 and cluster.address in warnings[0]


def intrusion(folder, ports):
    """The last line of an intruder that tries these ports, and writes to `mark` where its code is run."""
    (folder / "intruder.py").write_text(INTRUDER)
    command = [sys.executable, str(folder / "intruder.py"), str(folder / "mark"), *ports]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900, cwd=folder)
    return done.stdout.splitlines()[-1:] or [done.stderr]


def certificate(folder):
    """Files of a certificate, its own authority: names of Dask's settings -> paths."""
    temporary = Security.temporary()
    folder.mkdir(mode=0o700)
    (folder / "ca.pem").write_text(temporary.tls_ca_file)
    (folder / "key.pem").write_text(temporary.tls_client_key)
    return {"tls_ca": folder / "ca.pem", "tls_cert": folder / "ca.pem", "tls_key": folder / "key.pem"}


def settings(files):
    """As Dask's own files and environment state them."""
    names = {"ca-file": "tls_ca", "client.cert": "tls_cert", "client.key": "tls_key"}
    return dask.config.set({f"distributed.comm.tls.{name}": str(files[which]) for name, which in names.items()})


def test_a_scheduler_that_runs_already(tmp_path):
    """With its certificates it flies as at home; with others, or none, it is not to be had."""
    own = certificate(tmp_path / "own")
    cluster = Cluster(tmp_path / "cluster", workers=1, certificate=own)
    engine = built_engine(compose(["engine=dask", f"engine.address={cluster.address}"]))
    try:
        with settings(own):
            away = run_sweep(expand([GRID]), tmp_path / "away", SweepRequest(function=cells.quick_cell, engine=engine))
        assert away.flown == 12 and not away.not_flown
        same_results(
            run_sweep(expand([GRID]), tmp_path / "home", SweepRequest(function=cells.quick_cell, workers=1)), away
        )
        for others in (settings(certificate(tmp_path / "other")), contextlib.nullcontext()):
            with others, pytest.raises(QuadexpError, match="is not found") as error:
                run_sweep(expand([GRID]), tmp_path / "r", SweepRequest(function=cells.quick_cell, engine=engine))
            assert "\n" not in str(error.value) and not (tmp_path / "r").exists()
    finally:
        cluster.stop()
