"""The processes of this machine, from /proc."""

from collections.abc import Iterator
from pathlib import Path


def processes() -> Iterator[tuple[int, list[str]]]:
    """Process id and the fields of /proc/PID/stat behind the name: state, parent, group and so on."""
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            yield int(entry.parent.name), entry.read_text().rpartition(")")[2].split()
        except OSError:
            continue
