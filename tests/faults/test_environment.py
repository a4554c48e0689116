"""Strange surroundings: each ends in the right result or in a clear line."""

import resource
import shutil
import subprocess

import numpy as np
import pytest

from quadexp.log.store import read_flight
from tests.faults.command import FLY, apart, one_line, run

COMPILED = tuple(word.replace("interpreted", "auto") for word in FLY)
APART = {"solve_time"}


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """The file of a flight in ordinary surroundings."""
    path = tmp_path_factory.mktemp("usual") / "a.parquet"
    assert run(*FLY, "--out", path).returncode == 0
    return path


@pytest.fixture(scope="module")
def usual(flown):
    """The flight as it comes in ordinary surroundings."""
    return read_flight(flown)


def same(flight, other):
    return all(np.array_equal(flight[name], other[name]) for name in other.columns if name not in APART)


@pytest.mark.slow
def test_no_home(usual, tmp_path):
    away = dict.fromkeys(("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "QUADEXP_CACHE", "USER", "LOGNAME"))
    done = apart(*FLY, "--out", tmp_path / "a.parquet", environment=away)
    assert done.returncode == 0, done.stderr
    assert same(read_flight(tmp_path / "a.parquet"), usual)


def test_blanks_and_letters_of_other_alphabets(usual, tmp_path):
    folder = tmp_path / "Meine Flüge, 飛行 №1"
    done = apart(*FLY, "--out", folder / "a b=c.parquet", environment={"QUADEXP_CACHE": str(folder / "cache")})
    assert done.returncode == 0, done.stderr
    assert same(read_flight(folder / "a b=c.parquet"), usual)
    shown = run("show", folder / "a b=c.parquet")
    assert shown.returncode == 0 and "hover" in shown.stdout


@pytest.mark.slow
def test_decimal_comma(usual, tmp_path):
    """A host program that sets a locale with a decimal comma before the functions are generated and compiled."""
    names = subprocess.run(["locale", "-a"], capture_output=True, text=True).stdout.split()
    comma = [name for name in names if name.startswith(("de_", "fr_", "es_"))]
    folder = tmp_path / "locales"
    surroundings = {"QUADEXP_CACHE": str(tmp_path / "cache")}
    if not comma and shutil.which("localedef"):
        folder.mkdir()
        made = subprocess.run(
            ["localedef", "-i", "de_DE", "-f", "UTF-8", folder / "de_DE.UTF-8"], capture_output=True, text=True
        )
        if made.returncode <= 1 and (folder / "de_DE.UTF-8").is_dir():
            comma, surroundings["LOCPATH"] = ["de_DE.UTF-8"], str(folder)
    if not comma:
        pytest.skip("no locale with a decimal comma can be had here")
    before = (
        f"import locale; locale.setlocale(locale.LC_ALL, {comma[0]!r});"
        " assert locale.localeconv()['decimal_point'] == ','"
    )
    done = apart(*FLY, "--out", tmp_path / "a.parquet", before=before, environment=surroundings)
    assert done.returncode == 0, done.stderr
    assert same(read_flight(tmp_path / "a.parquet"), usual)
    compiled = apart(*COMPILED, "--out", tmp_path / "b.parquet", before=before, environment=surroundings)
    assert compiled.returncode == 0, compiled.stderr
    found = read_flight(tmp_path / "b.parquet")
    np.testing.assert_allclose(found.state, usual.state, atol=1e-9)


def test_no_compiler(usual, tmp_path):
    """auto says so once and flies interpreted; compiled is refused."""
    nowhere = {"PATH": str(tmp_path), "CC": None, "QUADEXP_CACHE": str(tmp_path / "cache")}
    done = apart(*COMPILED, "--out", tmp_path / "a.parquet", environment=nowhere)
    assert done.returncode == 0 and done.stderr.count("no C compiler found") == 1
    assert same(read_flight(tmp_path / "a.parquet"), usual)
    refused = apart(*FLY, "plant.backend=compiled", "--out", tmp_path / "b.parquet", environment=nowhere)
    assert "no C compiler found" in one_line(refused) and refused.returncode == 2


@pytest.mark.parametrize(
    ("missing", "words"),
    [
        ("rerun", ("export", "{flight}", "--to", "rerun")),
        ("distributed", ("evaluate", "--sweep", "--no-figures", *FLY[1:], "engine=dask")),
    ],
)
def test_half_installed_extras(flown, missing, words, tmp_path):
    """The package is there in name only: its import fails."""
    (tmp_path / missing).mkdir()
    (tmp_path / missing / "__init__.py").write_text("raise ImportError('half installed')\n")
    before = f"import sys; sys.path.insert(0, {str(tmp_path)!r})"
    given = [word.format(flight=flown) for word in words]
    line = one_line(apart(*given, "--out", tmp_path / "out", before=before))
    assert "pip install 'quadexp[" in line and missing in line
    assert not (tmp_path / "out").exists()


def test_512_mb(usual, tmp_path):
    """Address space for what the interpreter maps and 512 MB of data: a flight needs less."""

    def limit():
        resource.setrlimit(resource.RLIMIT_DATA, (512 << 20, 512 << 20))

    done = apart(*FLY, "--out", tmp_path / "a.parquet", limit=limit)
    assert done.returncode == 0, done.stderr
    assert same(read_flight(tmp_path / "a.parquet"), usual)


@pytest.mark.slow
def test_a_clock_that_goes_backwards(usual, tmp_path):
    """Wall time is written into the record and decides nothing."""
    before = (
        "import time, itertools; count = itertools.count()\n"
        "real = time.time\ntime.time = lambda: real() - 3600.0 * next(count)\n"
        "time.perf_counter = lambda: -1e-3 * next(count)"
    )
    done = apart(*FLY, "--out", tmp_path / "a.parquet", before=before)
    assert done.returncode == 0, done.stderr
    assert same(read_flight(tmp_path / "a.parquet"), usual)
