"""Commands of the documentation, and what they are said to print: what stands indented by four blanks.

A line that begins with `quadexp` or `python examples/` is a command, and goes on where a backslash ends it; what stands
indented below it, up to the next command, is what it prints.
"""

import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
STARTS = ("quadexp ", "python examples/")
OTHERS = (
    "make", "python ", "pip ", "dask ", "DASK", "apt-get", "QUADEXP", "git ", "chromium", "conf/", "log (", "defaults:",
    "[",
)  # fmt: skip
INLINE = re.compile(r"`(quadexp [^`]+)`")


class Step(NamedTuple):
    """program: "quadexp", or the script that Python runs. words: its arguments. into: the file that the shell sends
    its output to, or "". said: the lines it is said to print."""

    program: str
    words: list[str]
    into: str
    said: list[str]


def steps(page: Path) -> list[Step]:
    """Every command of a page, in order."""
    found: list[Step] = []
    pending, listening = "", False
    for line in page.read_text(encoding="utf-8").splitlines():
        text = line.removeprefix("    ") if line.startswith("    ") else ""
        if pending or text.startswith(STARTS):
            pending += text.rstrip("\\")
            if not text.endswith("\\"):
                found.append(_step(pending))
                pending, listening = "", True
        elif text.startswith(OTHERS):
            listening = False
        elif text and listening and not text.startswith(" " * 8):
            found[-1].said.append(text)
        elif line and not text:
            listening = False
    return found


def _step(text: str) -> Step:
    words = shlex.split(text, comments=True)
    into = words[words.index(">") + 1] if ">" in words else ""
    words = words[: words.index(">")] if into else words
    return Step(words[1] if words[0] == "python" else words[0], words[2 if words[0] == "python" else 1 :], into, [])


def commands(page: Path) -> list[list[str]]:
    """The words after `quadexp` of every command, in order."""
    return [step.words for step in steps(page) if step.program == "quadexp"]


def inline(page: Path) -> list[list[str]]:
    """The words after `quadexp` of every command in running text that stands there whole."""
    texts = [" ".join(text.split()) for text in INLINE.findall(page.read_text(encoding="utf-8"))]
    return [shlex.split(text)[1:] for text in texts if not re.search(r"\.\.\.|\b[A-Z]{2,}\b|…", text)]


def run(program: str, words: list[str]) -> str:
    """What the command prints on standard output; it must end well."""
    from typer.testing import CliRunner

    from quadexp.cli.app import app

    if program != "quadexp":
        done = subprocess.run([sys.executable, program, *words], capture_output=True, text=True)
        assert done.returncode == 0, (program, words, done.stderr)
        return done.stdout
    found = CliRunner().invoke(app, words)
    assert found.exit_code == 0, (words, found.stderr or found.output)
    return found.stdout
