"""Commands of the documentation: what stands indented by four blanks and begins with `quadexp`."""

from __future__ import annotations

import shlex
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def commands(page: Path) -> list[list[str]]:
    """The words after `quadexp` of every command, in order; a backslash at the end of a line goes on."""
    found, pending = [], ""
    for line in page.read_text(encoding="utf-8").splitlines():
        text = line.removeprefix("    ") if line.startswith("    ") else ""
        if not pending and not text.startswith("quadexp "):
            continue
        pending += text.rstrip("\\")
        if not text.endswith("\\"):
            found.append(shlex.split(pending, comments=True)[1:])
            pending = ""
    return found
