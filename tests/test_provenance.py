"""Which sources decide a flight, and what is said of versions."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from quadexp import provenance
from tests.test_layout import PACKAGE, ROOT, imports, modules

# Parsed when the tests are collected: beside threads, which tests of clusters leave for a while, the parser of Python
# 3.11 may fail ("AST constructor recursion depth mismatch").
IMPORTS = imports()
# Modules that import others by names that are put together, and what follows them instead.
BY_NAME = {
    "quadexp.parts.former": "a module by the name that it had: where it is now is followed like any other",
    "quadexp.models.base": "the kind that a checkpoint names: identity counts all models where one is read",
    "quadexp.parts.user_modules": "a user's own: identity follows them",
}


def followed(*names):
    folder = provenance.package_folder()
    return set(provenance.follow(names, provenance.shipped_modules(folder).get)[0])


def test_what_is_followed_is_what_python_sees():
    """All imports of every module, as its syntax tree has them, but for the files beside the rooms, which say, show and
    store what was flown."""
    beside = {name for name in modules() if "/" not in str(modules()[name].relative_to(PACKAGE))}
    for name in set(IMPORTS) - beside:
        found, waiting = set(), [name]
        while waiting:
            module = waiting.pop()
            if module not in found | beside:
                found.add(module)
                waiting += [*IMPORTS[module], module.rpartition(".")[0] or module]
        assert found == followed(name), name


def test_names_that_are_put_together_are_accounted_for():
    called = re.compile(r"import_module\((?!\s*[\"'][\w.]+[\"'])")
    flying = followed(provenance.FLYING)
    assert {name for name in flying if called.search(modules()[name].read_text())} == {*BY_NAME}


def test_c_sources_are_among_them():
    """Each decides the flights of the modules that name it."""
    kernels = provenance._kernels(PACKAGE)
    assert {file for files in kernels.values() for file in files} == {*PACKAGE.rglob("*.c")}


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
        ("plugins/drawing/style.py", False),
        ("cli/fly.py", False),
        ("plugins/cluster/cluster.py", False),
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
