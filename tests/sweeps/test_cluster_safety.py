"""Who may run code on a cluster: its owner, and nobody else on the machine or the network."""

from __future__ import annotations

import asyncio
import os
import socket
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
pytest.importorskip("cryptography", reason="the extra `cluster` is not installed")

from distributed.security import Security

from quadexp.config.compose import compose, expand
from quadexp.errors import QuadexpError, UsageError
from quadexp.sweeps.cluster.engines import build_engine
from quadexp.sweeps.sweep import run_sweep
from tests.experiment.same import same_results
from tests.faults.command import FLY, apart, one_line
from tests.sweeps import cells
from tests.sweeps.dask_cluster import ROOT, Cluster, descendants

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


@pytest.mark.parametrize("tls", [None, "engine.tls=false"])
def test_who_runs_code_on_a_cluster_of_this_machine(tls, tmp_path, capfd):
    """Without a word: certificates. Only where going without is asked for by name does the attack do anything, which
    also shows that it is one."""
    mark = tmp_path / "mark"
    (tmp_path / "intruder.py").write_text(INTRUDER)
    addresses, ports, said = set(), [], []

    def intrude(done, total):
        if done != 2:
            return
        addresses.update(listening())
        ports.extend(str(port) for host, port in addresses if not answers_http(host, port))  # a web page runs nothing
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, str(tmp_path / "intruder.py"), str(mark), *ports]
        said.append(subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900, cwd=tmp_path))

    engine = build_engine(compose(["engine=dask", "evaluate.workers=1", *([tls] if tls else [])]))
    result = run_sweep(expand([GRID]), tmp_path / "r", function=cells.slow_cell, engine=engine, progress=intrude)
    assert result.flown == 12 and not result.not_flown
    assert len(ports) >= 3, "scheduler, nanny, worker"
    assert {host for host, _ in addresses} == {"127.0.0.1"}, "the dashboard too listens on the loopback only"
    intruder = os.getuid() or NOBODY
    assert said[0].stdout.splitlines()[-1:] == [f"tried {len(ports)} as {intruder}"], said[0].stderr
    open_to_all = tls == "engine.tls=false"
    assert mark.exists() == open_to_all, f"code of another user was run as {mark.read_text()}" if mark.exists() else ""
    warnings = [line for line in capfd.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert len(warnings) == open_to_all and all("engine.tls=false" in line for line in warnings)


@pytest.fixture
def certificate(tmp_path):
    """Files of a certificate, its own authority, as overrides."""
    return written(tmp_path / "certificate")


def written(folder):
    made = Security.temporary()
    folder.mkdir(mode=0o700)
    (folder / "ca.pem").write_text(made.tls_ca_file)
    (folder / "key.pem").write_text(made.tls_client_key)
    (folder / "key.pem").chmod(0o600)
    return {"tls_ca": folder / "ca.pem", "tls_cert": folder / "ca.pem", "tls_key": folder / "key.pem"}


def overrides(certificate):
    return [f"engine.{name}={path}" for name, path in certificate.items()]


def test_a_scheduler_that_runs_already(certificate, tmp_path):
    """With its certificates it flies as at home; with others it is not to be had."""
    cluster = Cluster(tmp_path / "cluster", workers=1, certificate=certificate)
    try:
        assert cluster.address.startswith("tls://")
        address = ["engine=dask", f"engine.address={cluster.address}"]
        engine = build_engine(compose([*address, *overrides(certificate)]))
        away = run_sweep(expand([GRID]), tmp_path / "away", function=cells.quick_cell, engine=engine)
        assert away.flown == 12 and not away.not_flown
        same_results(run_sweep(expand([GRID]), tmp_path / "home", function=cells.quick_cell, workers=1), away)
        other = build_engine(compose([*address, *overrides(written(tmp_path / "other"))]))
        with pytest.raises(QuadexpError, match="cannot be had") as error:
            run_sweep(expand([GRID]), tmp_path / "r", function=cells.quick_cell, engine=other)
        assert "\n" not in str(error.value) and not (tmp_path / "r").exists()
    finally:
        cluster.stop()


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (["engine.address=tcp://127.0.0.1:1"], "is not encrypted; give a tls:// address .* or engine.tls=false"),
        (["engine.address=head:8786"], "is not encrypted"),
        (["engine.address=tls://127.0.0.1:1"], "needs engine.tls_ca, engine.tls_cert and engine.tls_key"),
        (["engine.address=tls://127.0.0.1:1", "engine.tls=false"], "contradicts engine.tls=false"),
        (["engine.tls=false", "engine.tls_ca=a", "engine.tls_cert=b", "engine.tls_key=c"], "contradicts the certif"),
        (["engine.tls_ca=a"], "give all three"),
    ],
)
def test_a_request_without_a_clear_answer(given, says):
    with pytest.raises(UsageError, match=says) as error:
        compose(["engine=dask", *given])
    assert "\n" not in str(error.value)


def test_a_key_that_others_may_read(certificate, tmp_path):
    certificate["tls_key"].chmod(0o640)
    engine = build_engine(compose(["engine=dask", *overrides(certificate)]))
    with pytest.raises(UsageError, match=r"key.pem: others may read or change it: chmod go="):
        run_sweep(expand([GRID]), tmp_path / "r", function=cells.quick_cell, engine=engine)


@pytest.mark.parametrize("shared", [None, "open"])
def test_slurm_needs_a_folder_for_certificates_that_nobody_else_writes_to(shared, tmp_path):
    folder = tmp_path / "open"
    folder.mkdir()
    folder.chmod(0o1777)
    given = [f"engine.shared={folder}"] if shared else []
    engine = build_engine(compose(["engine=slurm", *given]))
    with pytest.raises(UsageError, match="others may write there" if shared else "engine.shared=FOLDER"):
        run_sweep(expand([GRID]), tmp_path / "r", function=cells.quick_cell, engine=engine)


@pytest.mark.parametrize("engine", ["dask", pytest.param("slurm", marks=pytest.mark.slow)])
def test_without_cryptography_nothing_is_flown(engine, tmp_path):
    """One line and exit code 2, not a cluster without certificates."""
    command = ("evaluate", "--sweep", *FLY[1:], f"engine={engine}", "--out", tmp_path / "r")
    done = apart(*command, before="import sys; sys.modules['cryptography'] = None")
    assert done.returncode == 2 and f"engine={engine} needs cryptography" in one_line(done)
    assert "pip install 'quadexp[cluster]'" in done.stderr and not (tmp_path / "r").exists()


class TestHostsOverSSH:
    """A real SSH connection, to a server of this machine that runs what it is told to."""

    @pytest.fixture
    def home(self, tmp_path, monkeypatch):
        """A home whose SSH configuration leads to the server."""
        asyncssh = pytest.importorskip("asyncssh", reason="the extra `cluster` is not installed")
        home = tmp_path / "home"
        (home / ".ssh").mkdir(parents=True, mode=0o700)
        mine, theirs = (asyncssh.generate_private_key("ssh-ed25519") for _ in range(2))
        mine.write_private_key(home / ".ssh" / "id_ed25519")
        mine.write_public_key(home / ".ssh" / "id_ed25519.pub")
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "HOME": str(home), "OMP_NUM_THREADS": "1"}

        async def obey(process):
            child = await asyncio.create_subprocess_shell(
                process.command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment
            )
            try:
                await process.redirect(stdin=child.stdin, stdout=child.stdout, stderr=child.stderr)
                ended = {asyncio.ensure_future(child.wait()), asyncio.ensure_future(process.channel.wait_closed())}
                await asyncio.wait(ended, return_when=asyncio.FIRST_COMPLETED)
                if child.returncode is not None:
                    process.exit(child.returncode)
            finally:
                if child.returncode is None:
                    child.terminate()
                    await child.wait()

        async def serve(ready, done):
            server = await asyncssh.create_server(
                asyncssh.SSHServer, "127.0.0.1", 0, server_host_keys=[theirs], process_factory=obey, encoding=None,
                authorized_client_keys=str(home / ".ssh" / "id_ed25519.pub"),
            )  # fmt: skip
            port = server.get_port()
            (home / ".ssh" / "config").write_text(f"Host *\n  Port {port}\n  IdentityFile {home}/.ssh/id_ed25519\n")
            public = theirs.export_public_key().decode().strip()
            (home / ".ssh" / "known_hosts").write_text(f"[127.0.0.1]:{port} {public}\n")
            ready.set()
            while not done.is_set():
                await asyncio.sleep(0.1)
            server.close()
            await server.wait_closed()

        ready, done = threading.Event(), threading.Event()
        thread = threading.Thread(target=lambda: asyncio.run(serve(ready, done)), daemon=True)
        thread.start()
        assert ready.wait(30)
        monkeypatch.setenv("HOME", str(home))
        yield home
        done.set()
        thread.join(30)

    @pytest.mark.slow
    def test_their_certificate_is_made_handed_out_and_taken_back(self, home, tmp_path):
        pattern = f"quadexp-{32 * '[0-9a-f]'}"
        before = set(Path("/tmp").glob(pattern))
        seen, addresses = [], set()

        def look(done, total):
            if done == 2:
                folders = set(Path("/tmp").glob(pattern)) - before
                seen.extend((path, stat.S_IMODE(path.stat().st_mode)) for path in folders)
                seen.extend((path, stat.S_IMODE(path.stat().st_mode)) for f in folders for path in f.iterdir())
                addresses.update((host, answers_http(host, port)) for host, port in listening())

        engine = build_engine(compose(["engine=dask", "engine.hosts=[127.0.0.1]", "evaluate.workers=1"]))
        away = run_sweep(expand([GRID]), tmp_path / "away", function=cells.slow_cell, engine=engine, progress=look)
        assert away.flown == 12 and not away.not_flown
        assert [(path.name.partition("-")[0], mode) for path, mode in seen] == [("quadexp", 0o700), ("tls.pem", 0o600)]
        assert not any(path.exists() for path, _ in seen), "the key is left behind"
        same_results(run_sweep(expand([GRID]), tmp_path / "home_r", function=cells.quick_cell, workers=1), away)
        assert {host for host, answers in addresses if answers} == {"127.0.0.1"}, "web pages beyond the loopback"
        assert {host for host, _ in addresses} != {"127.0.0.1"}, "the scheduler is to be reached from other hosts"

    def test_a_host_that_cannot_be_reached(self, home, tmp_path):
        (home / ".ssh" / "known_hosts").write_text("")
        engine = build_engine(compose(["engine=dask", "engine.hosts=[127.0.0.1]"]))
        with pytest.raises(QuadexpError, match=r"engine.hosts: 127.0.0.1: .*trusted") as error:
            run_sweep(expand([GRID]), tmp_path / "r", function=cells.quick_cell, engine=engine)
        assert "\n" not in str(error.value)
