"""Attacks on the cache of compiled functions: folders that others can swap, compilers and processors that differ."""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import casadi as ca
import pytest

from quadexp import cache
from quadexp.compile.backend import realise
from quadexp.compile.compiler import compiler
from quadexp.errors import QuadexpError
from tests.faults.command import FLY, ROOT, apart, one_line, run
from tests.faults.test_compile_cache import folder, script  # noqa: F401

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")


@pytest.fixture
def reachable():
    """A folder of ours that other users may enter: below /tmp, as pytest's own folder is private."""
    place = Path(tempfile.mkdtemp(dir="/tmp"))
    place.chmod(0o755)
    yield place
    shutil.rmtree(place)


@pytest.mark.parametrize("who", ["others", "another user", "sticky", "private"])
def test_who_could_put_another_folder_in_its_place(reachable, monkeypatch, who):
    """A folder above the cache that others write to, or own, is refused, unless it is sticky or in a private one."""
    above = reachable / "above"
    (above / "cache").mkdir(parents=True)
    (above / "cache").chmod(0o700)
    if who == "another user":
        if os.getuid():
            pytest.skip("needs the superuser")
        os.chown(above, 12345, -1)
    else:
        above.chmod(0o1777 if who == "sticky" else 0o777)
    if who == "private":
        reachable.chmod(0o700)
    monkeypatch.setenv("QUADEXP_CACHE", str(above / "cache"))
    x = ca.SX.sym("x")
    square = ca.Function("square", [x], [x**2])
    if who in ("others", "another user"):
        with pytest.raises(QuadexpError, match=f"{above}: (others may write there|belongs to another user)"):
            realise(square, "compiled")
        assert not any((above / "cache").iterdir())
    else:
        assert float(realise(square, "compiled")(3.0)) == 9.0


def test_the_usual_folder_gives_way_to_one_that_nobody_else_can_swap(reachable, monkeypatch, tmp_path):
    """And the system's temporary folder is looked at as any other."""
    reachable.chmod(0o777)
    monkeypatch.delenv("QUADEXP_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(reachable / "home"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert cache.cache_folder() == tmp_path / f"quadexp-{os.getuid()}"
    monkeypatch.setattr(tempfile, "tempdir", str(reachable))
    with pytest.raises(QuadexpError, match="others may write there"):
        cache.cache_folder()


ARM = "processor\t: 0\nBogoMIPS\t: {speed}\nFeatures\t: fp asimd {more}\nCPU implementer\t: 0x41\nCPU part\t: 0xd0c\n"


@pytest.mark.parametrize("system", ["aarch64", "macos"])
def test_processors_without_the_flags_of_an_x86_are_told_apart(tmp_path, system):
    """By emulation: what the system says of its processor is replaced."""
    keys = []
    for speed, more in ((50, "aes"), (60, "aes"), (50, "aes sve")):
        texts = tmp_path / "cpuinfo"
        texts.write_text(ARM.format(speed=speed, more=more))
        (tmp_path / "sysctl").write_text(f"#!/bin/sh\necho hw.optional.arm: {more}\n")
        (tmp_path / "sysctl").chmod(0o755)
        script = f"""
import os, pathlib, platform
real, there = pathlib.Path.read_text, pathlib.Path.exists
is_cpuinfo = lambda path: str(path) == "/proc/cpuinfo"
def read_text(path, *given, **named):
    if is_cpuinfo(path) and {system == "macos"}:
        raise FileNotFoundError(path)
    return real(pathlib.Path({str(texts)!r}) if is_cpuinfo(path) else path, *given, **named)
pathlib.Path.read_text = read_text
pathlib.Path.exists = lambda path: {system != "macos"} if is_cpuinfo(path) else there(path)
from quadexp.compile.compiler import toolchain
print(toolchain())
"""
        path = f"{tmp_path}:{os.environ['PATH']}"
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "PATH": path}
        done = subprocess.run(
            [sys.executable, "-c", script], capture_output=True, text=True, env=environment, check=True
        )
        keys.append(done.stdout)
    assert keys[0] == keys[1] != keys[2]


@pytest.mark.parametrize(
    ("command", "code", "says"),
    [("gcc'", 2, "CC=gcc': is no command (No closing quotation)"), ("/bin/true", 1, "/bin/true made no library of")],
)
def test_a_compiler_that_is_none(tmp_path, command, code, says):
    words = ("trajectory=hover", "trajectory.duration=0.4", "controller=nominal_mpc", "plant=ideal")
    done = apart(
        "simulate", *words, "--out", tmp_path / "a.parquet",
        environment={"CC": command, "QUADEXP_CACHE": str(tmp_path / "cache")},
    )  # fmt: skip
    assert done.returncode == code and says in one_line(done)


@pytest.mark.slow
def test_our_own_c_has_no_undefined_behaviour(tmp_path):
    """A plant without inner states copies nothing, from nowhere."""
    words = [word for word in FLY if "backend" not in word]
    wrapper = script(
        tmp_path / "cc",  # what CasADi generates takes minutes with a sanitizer
        'case "$*" in *ffp-contract*|*-shared*) exec gcc -fsanitize=undefined "$@";; esac\nexec gcc "$@"',
    )
    environment = {"CC": str(wrapper), "QUADEXP_CACHE": str(tmp_path / "cache")}
    done = apart(*words, "--out", tmp_path / "a.parquet", environment=environment)
    if "lubsan" in done.stderr:
        pytest.skip("no sanitizer")
    assert done.returncode == 0 and "runtime error" not in done.stderr, done.stderr


def test_the_libraries_stay_below_their_bound(folder, monkeypatch):  # noqa: F811
    """Those that were not used for longest go; use is what counts."""
    monkeypatch.setenv("CC", "gcc")
    x = ca.SX.sym("x")
    functions = {name: ca.Function(name, [x], [x + i]) for i, name in enumerate("abc")}
    for i, name in enumerate("abc"):
        realise(functions[name], "compiled")
        (library,) = folder.glob(f"{name}_*.so")
        os.utime(library, (1e9 + i, 1e9 + i))
    realise(functions["a"], "compiled")
    monkeypatch.setattr(cache, "BOUND", int(3.5 * library.stat().st_size))
    realise(ca.Function("d", [x], [x * x]), "compiled")
    assert sorted(path.name[0] for path in folder.glob("*.so")) == ["a", "c", "d"]
    assert len(list(folder.glob("*.sha256"))) == 3
    (folder / "mine.so").write_text("mine")
    shown = run("cache", "--json").stdout
    assert '"libraries": 3' in shown and str(folder) in shown
    assert '"libraries": 0' in run("cache", "--clear", "--json").stdout
    assert os.listdir(folder) == ["mine.so"]
