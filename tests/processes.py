"""The processes of this machine, from /proc."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


def processes() -> Iterator[tuple[int, list[str]]]:
    """Process id and the fields of /proc/PID/stat behind the name: state, parent, group and so on."""
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            yield int(entry.parent.name), entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue


def descendants(pid: int) -> list[tuple[int, str]]:
    """Process ids and command lines of all that a process started, from /proc."""
    children: dict[int, list[int]] = {}
    commands = {}
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            children.setdefault(parent, []).append(int(entry.name))
            commands[int(entry.name)] = (entry / "cmdline").read_text().replace("\0", " ")
    found, waiting = [], list(children.get(pid, []))
    while waiting:
        child = waiting.pop()
        found.append((child, commands.get(child, "")))
        waiting += children.get(child, [])
    return found
