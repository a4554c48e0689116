"""TLS certificates of a cluster: those of the user, or one made for this run and shared by all parts of the cluster.

A certificate made here never appears on a command line. Processes of this machine receive it through their pipes, Slurm
nodes in files of `engine.shared` that only the user may read, hosts over SSH in such a folder, which is removed later.
"""

from __future__ import annotations

import asyncio
import contextlib
import secrets
import shlex
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from distributed.security import Security

from quadexp.config.engine import ClusterConfig
from quadexp.errors import QuadexpError, UsageError

ROLES = ("client", "scheduler", "worker")
_made: list[Security] = []  # one for all sweeps of this process


def security(config: ClusterConfig) -> Security | None:
    """The certificates by which the parts of a cluster recognise each other; None with engine.tls=false.

    Raises UsageError for a missing file, or a key that others may read.
    """
    if not config.tls:
        return None
    if config.tls_ca is None:
        if not _made:
            _made.append(Security.temporary())
        return _made[0]
    for name in ("tls_ca", "tls_cert", "tls_key"):
        if not Path(getattr(config, name)).is_file():
            raise UsageError(f"engine.{name}={getattr(config, name)}: no such file")
    assert config.tls_key is not None
    if Path(config.tls_key).stat().st_mode & 0o077:
        raise UsageError(f"engine.tls_key={config.tls_key}: others may read or change it: chmod go= it")
    cert = {f"tls_{role}_cert": config.tls_cert for role in ROLES}
    key = {f"tls_{role}_key": config.tls_key for role in ROLES}
    return Security(tls_ca_file=config.tls_ca, require_encryption=True, **cert, **key)


def settings(ca: str, cert: str, key: str) -> dict[str, Any]:
    """Files of certificates as Dask settings, which processes started over SSH inherit."""
    found: dict[str, Any] = {"distributed.comm.require-encryption": True, "distributed.comm.tls.ca-file": ca}
    for role in ROLES:
        found |= {f"distributed.comm.tls.{role}.cert": cert, f"distributed.comm.tls.{role}.key": key}
    return found


@contextlib.contextmanager
def handed_out(made: Security, hosts: Sequence[str], options: dict[str, Any]) -> Iterator[str]:
    """Copy certificate and key to each host, in a file that only the user may read; yields its path, removes it later.

    options: of the SSH connections. Raises QuadexpError where a host refuses it.
    """
    folder = f"/tmp/quadexp-{secrets.token_hex(16)}"  # on the remote hosts, where /tmp is what all of them have
    file = f"{folder}/tls.pem"
    parts = made.get_tls_config_for_role("worker")
    content = f"{parts['cert']}\n{parts['key']}\n"
    try:
        _on_each(hosts, options, f"umask 077 && mkdir -p {folder} && cat > {file}", content)
        yield file
    finally:
        with contextlib.suppress(QuadexpError):
            _on_each(hosts, options, f"rm -rf {folder}", "")


def _on_each(hosts: Sequence[str], options: dict[str, Any], command: str, given: str) -> None:
    """Run a command of a POSIX shell on every host, `given` on its standard input."""
    import asyncssh

    async def on(host: str) -> None:
        try:
            async with asyncssh.connect(host, **options) as connection:
                await connection.run(f"sh -c {shlex.quote(command)}", input=given, check=True)
        except (OSError, asyncssh.Error) as error:
            said = getattr(error, "stderr", "") or str(error) or type(error).__name__
            raise QuadexpError(f"engine.hosts: {host}: {str(said).strip().splitlines()[0]}") from None

    async def on_all() -> None:
        await asyncio.gather(*map(on, dict.fromkeys(hosts)))

    with ThreadPoolExecutor(1) as thread:  # the caller may run an event loop
        thread.submit(asyncio.run, on_all()).result()
