"""The tests of the core in a copy of the checkout in which folders of plug-ins are deleted.

    python -m tests.without worlds                              # all of them: minutes
    python -m tests.without worlds remedies -- tests/world -n 2   # some, with words of pytest

A test that flies a part of a deleted plug-in is skipped (tests/deleted.py); none may fail.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from tests.house import ROOT, plugins

CORE = ("--ignore-glob=*/plugins/*/*", "tests", "examples")


def copied(target: Path, without: Iterable[str]) -> Path:
    """A copy of the files of the checkout, but for those of some plug-ins and of their tests."""
    listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(listed, cwd=ROOT, capture_output=True, check=True, text=True).stdout.split("\0")
    deleted = tuple(f"{folder}/plugins/{name}/" for name in without for folder in ("quadexp", "tests"))
    for name in filter(None, names):
        if not name.startswith(deleted) and (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)
    return target


def main(words: Sequence[str]) -> int:
    """Exit code of the tests. words: names of plug-ins, then, after --, words of pytest."""
    names, _, given = " ".join(words).partition("--")
    deleted = names.split()
    unknown = sorted({*deleted} - {*plugins()})
    if unknown or not deleted:
        print(f"{' '.join(unknown) or 'no plug-in'}: must be some of {', '.join(plugins())}", file=sys.stderr)
        return 2
    with tempfile.TemporaryDirectory() as folder:
        copy = copied(Path(folder), deleted)
        asked = given.split() or CORE
        command = [sys.executable, "-m", "pytest", "-m", "not slow", "-p", "no:cacheprovider", *asked]
        return subprocess.run(command, cwd=copy, env={**os.environ, "PYTHONPATH": str(copy)}).returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
