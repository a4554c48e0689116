"""The cache of compiled functions: nothing damaged is loaded, and any number of processes may build at once."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time

import casadi as ca
import pytest

from quadexp.backend import cache_folder, compiler, realise
from quadexp.errors import QuadexpError
from tests.faults.command import ROOT

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")

CODE = """
import casadi as ca
from quadexp.backend import realise
x = ca.SX.sym("x")
function = realise(ca.Function("cube", [x], [x**3 + 0.1]), "compiled")
print(repr(float(function(1.5))))
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("QUADEXP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def process(folder, wrapper=None):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "QUADEXP_CACHE": str(folder)}
    if wrapper:
        environment["CC"] = str(wrapper)
    return subprocess.Popen(
        [sys.executable, "-c", CODE], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )


def answer(started):
    out, err = started.communicate(timeout=120)
    assert started.returncode == 0, err
    return float(out)


@pytest.mark.parametrize("damage", ["a bit", "the end", "everything", "its hash", "both"])
def test_a_damaged_library_is_made_anew(folder, damage):
    """A damaged library would crash or, worse, compute."""
    assert answer(process(folder)) == pytest.approx(1.5**3 + 0.1)
    (library,) = folder.glob("*.so")
    content, digest = library.read_bytes(), library.with_suffix(".sha256")
    if damage in ("a bit", "both"):
        library.write_bytes(content[:4000] + bytes([content[4000] ^ 1]) + content[4001:])
    elif damage == "the end":
        library.write_bytes(content[:-100])
    elif damage == "everything":
        library.write_bytes(b"")
    if damage in ("its hash", "both"):
        digest.write_bytes(b"\xff" + digest.read_bytes()[1:])
    assert answer(process(folder)) == pytest.approx(1.5**3 + 0.1)
    assert digest.read_text().isalnum() and library.stat().st_size == len(content)


def test_processes_that_build_the_same_entry(folder):
    started = [process(folder) for _ in range(4)]
    assert {answer(one) for one in started} == {1.5**3 + 0.1}
    assert sorted(path.suffix for path in folder.iterdir()) == [".sha256", ".so"]


def test_killed_while_compiling(folder, tmp_path):
    """What it leaves keeps nobody from building, and is swept up in time."""
    slow = tmp_path / "slow-gcc"
    slow.write_text(f'#!/bin/sh\ncase "$*" in *--version*) ;; *) sleep 60;; esac\nexec {shutil.which("gcc")} "$@"\n')
    slow.chmod(0o755)
    started = process(folder, slow)
    deadline = time.monotonic() + 60
    while not list(folder.glob(".build-*/built.c")) and time.monotonic() < deadline:
        time.sleep(0.05)
    started.kill()
    started.communicate()
    (left,) = folder.glob(".build-*")
    os.utime(left, (time.time() - 1e6,) * 2)
    assert answer(process(folder)) == pytest.approx(1.5**3 + 0.1)
    assert not list(folder.glob(".build-*"))


def test_a_folder_that_others_may_write_to_is_refused(folder):
    folder.mkdir()
    folder.chmod(0o777)
    with pytest.raises(QuadexpError, match="others may write there"):
        cache_folder()
    x = ca.SX.sym("x")
    with pytest.raises(QuadexpError, match="others may write there"):
        realise(ca.Function("square", [x], [x**2]), "compiled")


def test_a_new_folder_is_private(folder):
    assert cache_folder().stat().st_mode & 0o777 == 0o700
