"""Which sources decide a flight, and what is said of versions."""

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

from quadexp import provenance
from tests.test_layout import PACKAGE, ROOT, imports, modules

# Imported by what flies a cell, and not among the sources that decide a flight: name -> why.
ASIDE = {
    "quadexp": "the version, which a row names beside the sources",
    "quadexp.cache": "where compiled functions lie",
    "quadexp.names": "refuses files whose names are none",
    "quadexp.writer": "how files are written",
    "quadexp.errors": "words",
    "quadexp.messages": "words",
    "quadexp.progress": "words",
    "quadexp.provenance": "what is said of a flight",
    "quadexp.parts": "empty",
    "quadexp.experiment": "empty",
    "quadexp.log": "names",
    "quadexp.log.schema": "what a flight is on disk, like the next two",
    "quadexp.log.store": "",
    "quadexp.log.integrity": "refuses files",
    "quadexp.report": "empty",
    "quadexp.report.table": "how a table is printed",
}


# Parsed when the tests are collected: beside threads, which tests of clusters leave for a while, the parser of Python
# 3.11 may fail ("AST constructor recursion depth mismatch").
IMPORTS = imports()


def flying():
    """Modules that are imported, anywhere in them, by what flies a cell."""
    found, waiting = set(), ["quadexp.experiment.evaluate"]
    while waiting:
        module = waiting.pop()
        if module not in found:
            found.add(module)
            parts = module.split(".")
            waiting += [*IMPORTS[module], *(".".join(parts[:i]) for i in range(1, len(parts)))]
    return found


def listed():
    """Files of DECIDING."""
    places = [PACKAGE / name for name in provenance.DECIDING]
    assert all(place.exists() for place in places), "DECIDING names what is there no more"
    return {file for place in places for file in (place.rglob("*") if place.is_dir() else [place])}


def test_all_that_flies_a_cell_decides_it_or_is_excused():
    # What quadexp.parts holds is in the key of the cell.
    lacking = {module for module in flying() if modules()[module] not in listed()}
    lacking = {module for module in lacking if not module.startswith("quadexp.parts.")}
    assert lacking == set(ASIDE), "add it to DECIDING in quadexp/provenance.py, or say here why it decides no flight"


def test_nothing_is_listed_that_flies_no_cell():
    single = {PACKAGE / name for name in provenance.DECIDING if name.endswith(".py")}
    assert single <= {modules()[module] for module in flying()}


def test_c_sources_are_among_them():
    assert {file.name for file in listed() if file.suffix == ".c"} == {p.name for p in PACKAGE.rglob("*.c")}


def test_the_hash_is_over_names_and_contents():
    files = sorted(file for file in listed() if file.suffix in (".py", ".c"))
    digest = hashlib.sha256()
    for file in files:
        content = file.read_bytes()
        digest.update(f"{file.relative_to(PACKAGE).as_posix()}\0{len(content)}\0".encode() + content)
    assert provenance.sources() == digest.hexdigest()[:12]


def hashes(checkout):
    """(sources, package_hash) of another checkout, by a process of its own."""
    code = "from quadexp.provenance import *; print(sources(), package_hash(), package_folder())"
    environment = {**os.environ, "PYTHONPATH": str(checkout), "PYTHONSAFEPATH": "1"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, cwd="/")
    *found, folder = done.stdout.split()
    assert folder == str(checkout / "quadexp"), done.stderr
    return tuple(found)


def test_what_changes_which_hash(tmp_path):
    """Where it lies changes none; a figure or an option none of flights; an equation both."""
    shutil.copytree(PACKAGE, tmp_path / "quadexp", ignore=shutil.ignore_patterns("__pycache__"))
    here = provenance.sources(), provenance.package_hash()
    assert hashes(tmp_path) == here
    for name, decides in (
        ("report/style.py", False),
        ("cli/fly.py", False),
        ("sweeps/cluster.py", False),
        ("report/metrics.py", True),
        ("physics/drag.py", True),
        ("control/mpc/riccati_backward.c", True),
    ):
        file = tmp_path / "quadexp" / name
        before = file.read_bytes()
        file.write_bytes(before + b"\n")
        found = hashes(tmp_path)
        assert (found[0] != here[0]) == decides and found[1] != here[1], name
        file.write_bytes(before)
    assert hashes(tmp_path) == here


def test_a_library_from_elsewhere_is_named(tmp_path):
    """Its version would be that of the one that is installed and not imported."""
    (tmp_path / "casadi.py").write_text("raise SystemExit('imported')\n")
    code = "from quadexp.provenance import versions, libraries; print(libraries())"
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, cwd="/")
    assert f"casadi {provenance.versions()['casadi']} (imported from {tmp_path / 'casadi.py'})" in done.stdout
    assert "imported from" not in provenance.libraries()


def test_the_libraries_of_a_row_are_versions_of_this_process():
    said = dict(part.split(" ", 1) for part in provenance.libraries().split(", "))
    assert said["python"] == ".".join(map(str, sys.version_info[:3]))
    import casadi
    import numpy

    assert (said["numpy"], said["casadi"]) == (numpy.__version__, casadi.__version__)
    assert Path(provenance.package_folder()) == PACKAGE
