"""The wheel, installed: what is in it is enough for README's first command."""

import os
import re
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

from tests.docs.commands import ROOT, commands


@pytest.mark.slow  # builds, installs and compiles
def test_the_installed_wheel_runs_the_first_command_of_readme(tmp_path):
    """In an environment of its own. Its dependencies are those of this environment; with QUADEXP_EMPTY=1 they are
    installed too, which loads gigabytes."""
    empty = os.environ.get("QUADEXP_EMPTY") == "1"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    built = subprocess.run(
        [*pip, "wheel", "--quiet", "--no-deps", "--wheel-dir", tmp_path, ROOT], capture_output=True, text=True
    )
    if built.returncode and re.search("hatchling|connect|index", built.stderr):
        pytest.skip("no wheel can be built here: hatchling is not found")
    assert built.returncode == 0, built.stderr[-2000:]
    (wheel,) = tmp_path.glob("quadexp-*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {"quadexp/conf/references.bib", "quadexp/conf/controller/policy.yaml"} <= names
    assert not [name for name in names if name.startswith(("tests/", "docs/"))]
    place = tmp_path / "venv"
    venv.create(place, with_pip=False, symlinks=True)
    python = place / "bin" / "python"
    (site,) = (place / "lib").glob("python*/site-packages")
    if not empty:
        others = [path for path in sys.path if path.endswith("site-packages")]
        (site / "dependencies.pth").write_text("\n".join(others) + "\n")
    chosen = [] if empty else ["--no-deps"]
    target = [*pip, "--python", python, "install", "--quiet", "--ignore-installed", *chosen, wheel]
    done = subprocess.run(target, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    clean = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    where = subprocess.run([python, "-c", "import quadexp; print(quadexp.__file__)"], cwd=tmp_path, env=clean,
                           capture_output=True, text=True)  # fmt: skip
    assert Path(where.stdout.strip()).is_relative_to(place), where.stdout + where.stderr
    first = next(words for words in commands(ROOT / "README.md") if words[0] == "simulate" and "--conf" not in words)
    flown = subprocess.run([place / "bin" / "quadexp", *first], cwd=tmp_path, env=clean, capture_output=True, text=True)
    assert flown.returncode == 0, flown.stderr
    assert "outcome     ok" in flown.stdout and (tmp_path / first[first.index("--out") + 1]).is_file()
