"""The cache of compiled functions: nothing damaged is loaded, and any number of processes may build at once."""

import os
import re
import shutil
import subprocess
import sys
import time

import casadi as ca
import pytest

from quadexp.cache import cache_folder
from quadexp.compile.backend import compiler, realise
from quadexp.errors import QuadexpError
from tests.faults.command import ROOT

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")

CODE = """
import casadi as ca
from quadexp.compile.backend import realise
x = ca.SX.sym("x")
function = realise(ca.Function("cube", [x], [x**3 + 0.1]), "compiled")
print(repr(float(function(1.5))))
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("QUADEXP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def process(folder, wrapper=None, before="", **changes):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "QUADEXP_CACHE": str(folder), **changes}
    if wrapper:
        environment["CC"] = str(wrapper)
    if folder is None:
        del environment["QUADEXP_CACHE"]
    return subprocess.Popen(
        [sys.executable, "-c", before + CODE],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )


def answer(started):
    out, err = started.communicate(timeout=900)
    assert started.returncode == 0, err
    return float(out)


@pytest.mark.parametrize("damage", ["a bit", "the end", "its hash", "both"])
def test_a_damaged_library_is_made_anew(folder, damage):
    """A damaged library would crash or, worse, compute."""
    assert answer(process(folder)) == pytest.approx(1.5**3 + 0.1)
    (library,) = folder.glob("*.so")
    content, digest = library.read_bytes(), library.with_suffix(".sha256")
    if damage in ("a bit", "both"):
        library.write_bytes(content[:4000] + bytes([content[4000] ^ 1]) + content[4001:])
    elif damage == "the end":
        library.write_bytes(content[:-100])
    if damage in ("its hash", "both"):
        digest.write_bytes(b"\xff" + digest.read_bytes()[1:])
    assert answer(process(folder)) == pytest.approx(1.5**3 + 0.1)
    assert digest.read_text().isalnum() and library.stat().st_size == len(content)


def test_processes_that_build_the_same_entry(folder):
    started = [process(folder) for _ in range(4)]
    assert {answer(one) for one in started} == {1.5**3 + 0.1}
    assert sorted(path.suffix for path in folder.iterdir()) == [".o", ".sha256", ".sha256", ".so"]


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
    for left in folder.glob(".build-*"):
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


def refused(started):
    """The one error that ends the process, without what led to it."""
    error = started.communicate(timeout=900)[1].strip().splitlines()[-1]
    assert started.returncode == 1 and error.startswith("quadexp.errors.QuadexpError: "), error
    return error.removeprefix("quadexp.errors.QuadexpError: ")


def script(path, body):
    path.write_text(f"#!/bin/sh\n{body}\n")
    path.chmod(0o755)
    return path


def test_a_compiler_of_several_words(folder):
    """CC="ccache gcc" is how many have it."""
    assert answer(process(folder, "env gcc")) == pytest.approx(1.5**3 + 0.1)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("sleep 60", "it took longer than 1 s"),
        ('case "$*" in *--version*) ;; *) exec sleep 60;; esac', "it took longer than 1 s"),
        ("exit 3", "exit code 3"),
        ('case "$*" in *--version*) ;; *) exit 1;; esac', "could not compile"),
        ('case "$*" in *--version*) ;; *) kill -9 $$;; esac', "exit code -9"),
    ],
)
def test_a_compiler_that_does_not_end_well(folder, tmp_path, body, said):
    impatient = "import quadexp.compile.compiler; quadexp.compile.compiler.PATIENCE = 1\n"
    started = process(folder, script(tmp_path / "cc", body), before=impatient)
    assert said in refused(started)
    assert not list(folder.glob("*.so"))


def test_a_file_system_without_locks(folder):
    """As on some clusters: both build, and what lies there in the end is whole."""
    before = (
        "import errno, fcntl\ndef flock(*_): raise OSError(errno.ENOLCK, 'No locks available')\nfcntl.flock = flock\n"
    )
    started = [process(folder, before=before) for _ in range(2)]
    assert {answer(one) for one in started} == {1.5**3 + 0.1}
    assert answer(process(folder)) == 1.5**3 + 0.1


@pytest.fixture
def mounted(tmp_path):
    """Mounts a small file system with some options."""
    place = tmp_path / "mounted"
    place.mkdir()

    def mount(options):
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", place], capture_output=True)
        if done.returncode:
            pytest.skip("no file system can be mounted here")
        return place

    yield mount
    subprocess.run(["umount", place], capture_output=True)


def test_a_home_that_takes_no_files(mounted, tmp_path):
    """As in a container that runs as nobody in particular: the system's temporary folder serves."""
    home = mounted("ro")
    (tmp_path / "t").mkdir()
    started = process(None, HOME=str(home), XDG_CACHE_HOME="", TMPDIR=str(tmp_path / "t"))
    assert answer(started) == pytest.approx(1.5**3 + 0.1)
    (made,) = (tmp_path / "t").glob("quadexp-*")
    assert made.stat().st_mode & 0o777 == 0o700 and list(made.glob("*.so"))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("ro,mode=700", "cannot be kept there .Read-only file system.; set QUADEXP_CACHE to"),
        ("size=4k,mode=700", "No space left on device|gcc could not compile"),
        ("noexec,size=20m,mode=700", "failed to map segment.*set QUADEXP_CACHE to"),
    ],
)
def test_a_chosen_folder_that_cannot_be_used(mounted, options, said):
    assert re.search(said, refused(process(mounted(options))))
