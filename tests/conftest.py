"""Fixtures that every test may use."""

import gc
import os
import signal
import tempfile
from collections import Counter
from collections.abc import Generator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("QUADEXP_OPTIMISE", "-Og")  # compiling is half of the tests' work, each function for a few steps
os.environ["QUADEXP_CACHE"] = os.path.join(tempfile.gettempdir(), f"quadexp-tests-{os.getuid()}")

from quadexp.compile.compiler import compiler
from quadexp.errors import QuadexpError
from quadexp.physics.rotor import RotorGeometry
from quadexp.physics.vehicle import Vehicle
from tests import composing  # noqa: F401 - before any test binds what it replaces
from tests.deleted import pytest_ignore_collect, pytest_make_collect_report, pytest_runtest_makereport  # noqa: F401

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a shell's background, and so in all that is started here
    signal.signal(signal.SIGINT, signal.default_int_handler)
gc.set_threshold(200_000, 20, 100)  # looking for cycles was a tenth of the tests' work


def pytest_terminal_summary(terminalreporter) -> None:
    """One line that says what was skipped and why."""
    reasons: Counter[str] = Counter()
    for report in terminalreporter.stats.get("skipped", []):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
        reasons[reason.removeprefix("Skipped: ")] += 1
    if reasons:
        shown = "; ".join(f"{count} x {reason}" for reason, count in reasons.most_common())
        terminalreporter.write_line(f"{reasons.total()} skipped: {shown}")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup() -> Generator[None, None, None]:
    return (yield from _skipped_where_something_lacks())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None, None, None]:
    return (yield from _skipped_where_something_lacks())


def _skipped_where_something_lacks() -> Generator[None, None, None]:
    """Without a compiler a test that asks for compiled code is skipped, without their package one that flies a
    Crazyflie: by what refuses it."""
    try:
        return (yield)
    except QuadexpError as error:
        if compiler() is None and "no C compiler found" in str(error):
            pytest.skip("no C compiler")
        if "numbers of the package crazyflow" in str(error) and not any(map(find_spec, ("crazyflow", "drone_models"))):
            pytest.skip("the extra `drone-models` is not installed")
        raise


@pytest.fixture(scope="session")
def vehicle() -> Vehicle:
    """The quadrotor of Torrente et al. 2021's simplified simulation (x layout)."""
    h = 0.235 / np.sqrt(2)
    return Vehicle(
        name="torrente",
        mass=1.0,
        inertia=((0.03, 0, 0), (0, 0.03, 0), (0, 0, 0.06)),
        rotor_position=((h, -h, 0), (-h, -h, 0), (-h, h, 0), (h, h, 0)),
        rotor_spin=(-1, 1, -1, 1),
        torque_coefficient=0.013,
        thrust_min=0.0,
        thrust_max=20.0,
        rate_max=20.0,
    )


@pytest.fixture(scope="session")
def odd_vehicle() -> Vehicle:
    """Six rotors at odd places, full inertia: nothing cancels by symmetry."""
    angle = np.arange(6) * np.pi / 3 + 0.2
    place = np.stack([0.25 * np.cos(angle) + 0.01, 0.22 * np.sin(angle) - 0.02, 0 * angle], axis=-1)
    return Vehicle(
        name="odd",
        mass=1.7,
        inertia=((0.021, 0.001, -0.002), (0.001, 0.025, 0.0015), (-0.002, 0.0015, 0.04)),
        rotor_position=tuple(map(tuple, place)),
        rotor_spin=(1, -1, 1, -1, 1, -1),
        torque_coefficient=0.017,
        thrust_min=0.1,
        thrust_max=9.0,
        rate_max=20.0,
    )


@pytest.fixture(scope="session")
def blade():
    """True coefficients of Lei & Li 2017, Table 1."""
    from quadexp.plugins.aerodynamics.coefficients import BladeCoefficients

    return BladeCoefficients(lift_slope=3.32, profile_drag=0.22, body_drag=(0.01, 0.01, 0.02))


@pytest.fixture(scope="session")
def lei_li(blade) -> Vehicle:
    """The quadrotor of Lei & Li 2017 (+ layout, Table 1, in FLU)."""
    d = 0.225
    rotor = RotorGeometry(0.12, 0.025, np.pi / 12, 1.205, np.pi * d**2)
    from quadexp.plugins.aerodynamics.blade_element import static_coefficients

    static = static_coefficients(rotor, blade)
    return Vehicle(
        name="lei_li",
        mass=0.985,
        inertia=((0.956e-2, 0, -0.1019e-2), (0, 0.9417e-2, 0.1019e-2), (-0.1019e-2, 0.1019e-2, 1.8762e-2)),
        rotor_position=((d, 0, 0), (0, -d, 0), (-d, 0, 0), (0, d, 0)),
        rotor_spin=(1, -1, 1, -1),
        torque_coefficient=static.torque / static.thrust,
        thrust_min=0.0,
        thrust_max=20.0,
        rate_max=20.0,
        rotor=rotor,
        thrust_coefficient=static.thrust,
    )


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20210131)


@pytest.fixture
def unmeasured(monkeypatch) -> None:
    """The margins of no loop are computed: of what remedies are around, that takes longer than the flight."""
    monkeypatch.setattr("quadexp.plugins.margins.loop_margins.loop_margins", lambda *_: {"unknown": "not asked for"})


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """An empty folder to work in."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
