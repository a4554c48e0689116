"""A controller that is exported as C: against Python, against the bench, against hostile numbers, and with mistakes."""

from __future__ import annotations

import ctypes
import json
import re
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadexp import requests
from quadexp.compile.compiler import run_compiler
from quadexp.control.base import Measurement, Window
from quadexp.control.control_step import stepped
from quadexp.control.readings import ReadingGate
from quadexp.control.wrapped import thrust_at_start
from quadexp.errors import DataError, QuadexpError, UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.loop import controller as python_loop
from quadexp.parts.compose import compose
from quadexp.plugins.vehicle.export import export_controller
from quadexp.plugins.vehicle.exported import ExportedController
from quadexp.plugins.vehicle.record import packed

QUICK = ("trajectory.acceleration=2", "trajectory.radius=2")
MPC = ("controller=perfect_mpc", "trajectory=lemniscate", "trajectory.speed=12", "trajectory.acceleration=6")
LAW = ("controller=geometric", "adaptive=l1", "trajectory=circle", "trajectory.speed=4", *QUICK)
OBSERVING = ("controller=nominal_mpc", "observer=disturbance", "rate_loop=indi", "observer.torque_bandwidth=0")
WINDY = (*OBSERVING, "wind=gust", "trajectory=circle", "trajectory.speed=4", *QUICK)
CASES = {"mpc": MPC, "law": LAW, "observing": WINDY}
FOUND = ("remedies=auto", "world=everything", "trajectory=circle", "trajectory.speed=4", *QUICK)
PLACES = "one", "other"  # of two exports in one build
AUTO = {"auto": ("controller=nominal_mpc", *FOUND), "auto_law": ("controller=geometric", *FOUND)}


class Exports(dict[str, Path]):
    """An export of every case, made when it is first asked for."""

    def __init__(self, place: Path) -> None:
        super().__init__()
        self._place = place

    def __missing__(self, name: str) -> Path:
        self[name] = self._place / name
        export_controller((CASES | AUTO)[name], self[name])
        return self[name]


class Once:
    """The compiler, called once for the same arguments: each controller of a folder has a copy of what it made."""

    def __init__(self, place: Path) -> None:
        self._place, self._kept = place, {}

    def __call__(self, arguments: list[str], purpose: str, scratch: str) -> str:
        at = arguments.index("-o") + 1
        key = (*arguments[:at], *arguments[at + 1 :])
        if key not in self._kept:
            self._kept[key] = self._place / f"{len(self._kept)}.so"
            run_compiler([*arguments[:at], str(self._kept[key]), *arguments[at + 1 :]], purpose, scratch)
        shutil.copyfile(self._kept[key], arguments[at])
        return ""


@pytest.fixture(scope="module", autouse=True)
def _compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as changed:
        changed.setattr("quadexp.plugins.vehicle.exported.run_compiler", Once(tmp_path_factory.mktemp("compiled")))
        yield


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return Exports(tmp_path_factory.mktemp("exports"))


def run(folder: Path, target: str = "test", **variables: str) -> subprocess.CompletedProcess[str]:
    given = [f"{name}={value}" for name, value in {"CFLAGS": "-O0", **variables}.items()]
    return subprocess.run(["make", "-C", str(folder), target, *given], capture_output=True, text=True, check=False)


def flown(*settings: str) -> np.ndarray:
    """Positions of a flight, (k, 3)."""
    columns = requests.simulate(settings).flight.columns
    return np.stack([columns[f"p_{axis}"] for axis in "xyz"], axis=1)


# ------------------------------------------------------------------------------------------------------- its own proof
@pytest.mark.parametrize("name", CASES | AUTO)
def test_folder_passes_its_check(folders: dict[str, Path], name: str) -> None:
    done = run(folders[name])
    assert done.returncode == 0, done.stdout + done.stderr
    said = done.stdout.splitlines()
    for what in ("replay", "closed loop", "hostile"):
        assert next(line for line in said if line.startswith(what)).endswith("ok")


def test_check_sees_another_command(folders: dict[str, Path], tmp_path: Path) -> None:
    folder = copied(folders["mpc"], tmp_path)
    rows = np.fromfile(folder / "vectors.bin")
    rows[rows.size // 2 :] += 1e-8  # N, m and all else
    rows.tofile(folder / "vectors.bin")
    done = run(folder)
    assert done.returncode != 0
    assert "FAILED" in done.stdout


def test_check_sees_another_controller(folders: dict[str, Path], tmp_path: Path) -> None:
    folder = copied(folders["observing"], tmp_path)
    text = (folder / "vehicle.c").read_text()
    changed = text.replace("if (read) copy(l->specific_force, force, 3);", "")  # an observer without its accelerometer
    assert changed != text
    (folder / "vehicle.c").write_text(changed)
    done = run(folder)
    assert done.returncode != 0
    assert "closed loop" in next(line for line in done.stdout.splitlines() if line.endswith("FAILED"))


def copied(folder: Path, to: Path) -> Path:
    """The sources, without what was built."""
    about = json.loads((folder / "model.json").read_text())
    for name in about["files"]:
        (to / name).write_bytes((folder / name).read_bytes())
    (to / "model.json").write_bytes((folder / "model.json").read_bytes())
    return to


def test_two_exports_are_the_same_bytes(folders: dict[str, Path], tmp_path: Path) -> None:
    export_controller(CASES["observing"], tmp_path / "again")
    about = json.loads((folders["observing"] / "model.json").read_text())
    for name in [*about["files"], "model.json"]:
        assert (tmp_path / "again" / name).read_bytes() == (folders["observing"] / name).read_bytes(), name


def test_the_readme_says_what_holds_for_this_controller(folders: dict[str, Path]) -> None:
    """A law has no numbers that may be changed, and no first step unlike the others."""
    mpc, law = ((folders[name] / "README.md").read_text() for name in ("mpc", "law"))
    assert "full steps only" in mpc
    assert "full steps only" not in law
    assert re.search(r"may change in flight \| \w.*, by `qx_numbers\(\)` \|", mpc)
    assert "| may change in flight | nothing |" in law


def test_sources_of_the_bench_are_copied(folders: dict[str, Path]) -> None:
    package = Path(requests.__file__).parent / "control"
    assert (folders["mpc"] / "loop.c").read_bytes() == (package / "loop.c").read_bytes()
    for name in ("stages.c", "active_set.c", "riccati_scalar.c"):
        assert (folders["mpc"] / name).read_bytes() == (package / "mpc" / name).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_sanitizers(folders: dict[str, Path], name: str) -> None:
    done = run(folders[name], "sanitize")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.skipif(shutil.which("clang") is None, reason="needs clang")
def test_clang_has_no_warning(folders: dict[str, Path], tmp_path: Path) -> None:
    done = run(copied(folders["mpc"], tmp_path), "lib", CC="clang")
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.skipif(shutil.which("cmake") is None, reason="needs cmake")
def test_two_exports_are_in_one_build(folders: dict[str, Path], tmp_path: Path) -> None:
    export_controller(("controller=pid", "trajectory=hover", "trajectory.duration=1"), tmp_path / PLACES[1], prefix="p")
    shutil.copytree(folders["mpc"], tmp_path / PLACES[0], ignore=shutil.ignore_patterns("*.o", "check"))
    lines = (
        "cmake_minimum_required(VERSION 3.13)",
        "project(both C)",
        "add_subdirectory(one)",
        "add_subdirectory(other)",
    )
    (tmp_path / "CMakeLists.txt").write_text("\n".join(lines))
    command = ["cmake", "-S", tmp_path, "-B", tmp_path / "build"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


# -------------------------------------------------------------------------------------------------------- in the bench
@pytest.mark.parametrize("name", CASES)
def test_bench_flies_it_along_the_same_path(folders: dict[str, Path], name: str) -> None:
    world = [
        "trajectory=circle",
        "trajectory.speed=5",
        "trajectory.acceleration=2.5",
        "wind=constant",
    ]  # not those of the export
    own = [s for s in CASES[name] if not s.startswith(("trajectory", "wind"))]
    one, other = flown(*own, *world), flown("controller=exported", f"model={folders[name]}", *world)
    assert len(one) == len(other)
    assert np.abs(one - other).max() < 1e-9


@pytest.mark.parametrize("settings", [WINDY, AUTO["auto"]], ids=["observing", "auto"])
def test_single_precision_flies_as_well(tmp_path: Path, settings: tuple[str, ...]) -> None:
    export_controller(settings, tmp_path / "c", real="float", prefix="mine")
    done = run(tmp_path / "c")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "mine_step" in (tmp_path / "c" / "controller.h").read_text()
    run(tmp_path / "c", "lib")
    command = ["nm", "-g", "--defined-only", tmp_path / "c" / "libmine.a"]
    listed = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    names = [line.split()[2].lstrip("_") for line in listed if line.count(" ") == 2]
    assert "mine_step" in names
    assert {name for name in names if not name.startswith("mine_")} == set()  # two libraries go into one program


def test_a_folder_that_was_changed_is_refused(folders: dict[str, Path], tmp_path: Path) -> None:
    folder = copied(folders["law"], tmp_path)
    (folder / "loop.c").write_text((folder / "loop.c").read_text() + "\n")
    with pytest.raises(DataError, match=r"loop\.c: is not as it was exported"):
        exported(folder)


@pytest.mark.parametrize("key", ["period", "vehicle", "files"])
def test_a_manifest_that_was_changed_is_refused(folders: dict[str, Path], tmp_path: Path, key: str) -> None:
    folder = copied(folders["law"], tmp_path)
    about = json.loads((folder / "model.json").read_text())
    about[key] = {"period": 0.02, "vehicle": None, "files": {}}[key]
    (folder / "model.json").write_text(json.dumps(about, indent=1, sort_keys=True) + "\n")
    with pytest.raises(DataError, match=r"model\.json: is not as it was exported"):
        exported(folder)


def test_hover_has_an_error_of_rounding_only(tmp_path: Path) -> None:
    settings = ("controller=perfect_mpc", "trajectory=hover", "trajectory.duration=1", "plant=ideal")
    assert requests.simulate(settings).flight.metadata["row"]["mean_error"] < 1e-9  # m
    export_controller(settings, tmp_path / "c")
    done = run(tmp_path / "c")
    assert done.returncode == 0, done.stdout + done.stderr


def test_another_vehicle_is_refused(folders: dict[str, Path]) -> None:
    with pytest.raises(DataError, match="exported for vehicle 'torrente'"):
        flown("controller=exported", f"model={folders['law']}", "vehicle=crazyflie")


# -------------------------------------------------------------------------------------------------- out of the ordinary
def exported(folder: Path) -> ExportedController:
    config = compose(["vehicle=torrente"], None, "simulate")
    return ExportedController(folder, build_vehicle(config.vehicle))


@pytest.mark.parametrize("away", [0.5, 9.0, 40.0])
def test_it_comes_back_from_far_away(folders: dict[str, Path], away: float) -> None:
    """Beyond the distance limit the reference is shifted, and the first solution is without a line search."""
    loop, c = (
        python_loop("controller=perfect_mpc", "trajectory=hover", "trajectory.duration=20"),
        exported(folders["mpc"]),
    )
    start = loop.start + away * np.array([0.6, 0.0, 0.8, *np.zeros(10)])
    c.residual = loop.controller.residual
    reference = SampledReference(loop.trajectory, c)
    flight = fly(loop.plant, c, reference, np.random.default_rng(0), start=start, lost_distance=100.0)
    assert flight.metadata["outcome"] in ("ok", "left_corridor")
    assert np.abs(flight.state[-1, :3] - loop.start[:3]).max() < 1e-3


def test_what_is_refused_changes_nothing(folders: dict[str, Path]) -> None:
    one, other, loop = exported(folders["observing"]), exported(folders["observing"]), python_loop(*WINDY)
    window, x = loop._reference.window(0), loop.start
    for controller in (one, other):
        controller.reset(x, window)
    force, speed = np.array([0.1, 0.2, 9.9]), None
    one.step(Measurement(0.0, x, force, speed), window)
    other.step(Measurement(0.0, x, force, speed), window)
    bad = x.copy()
    bad[4] = np.nan
    _, record = other.step(Measurement(0.0, bad, force, speed), window)
    assert record.status == 3
    first, _ = one.step(Measurement(0.0, x, force, speed), window)
    second, _ = other.step(Measurement(0.0, x, force, speed), window)
    assert np.array_equal(first, second)


def test_a_reading_may_be_missing_for_a_tenth_of_a_second(folders: dict[str, Path]) -> None:
    c, loop = exported(folders["law"]), python_loop(*LAW)
    window, x, nothing = loop._reference.window(0), loop.start, np.full(3, np.nan)
    c.reset(x, window)
    assert c.step(Measurement(0.0, x, nothing, None), window)[1].status == 3  # none was ever good
    assert c.step(Measurement(0.0, x, np.zeros(3), None), window)[1].status == 0
    statuses = [c.step(Measurement(0.0, x, nothing, None), window)[1].status for _ in range(12)]
    assert statuses[:10] == [0] * 10
    assert statuses[10:] == [3, 3]


def test_missing_readings_are_treated_as_on_the_bench(folders: dict[str, Path]) -> None:
    """Bursts of readings that do not come, or are no numbers, some longer than they may be."""
    loop, c, rng = python_loop(*LAW), exported(folders["law"]), np.random.default_rng(3)
    plant, reference, period = loop.plant, loop._reference, loop.period
    x, force, last, kind = loop.start.copy(), None, thrust_at_start(reference.window(0), loop.vehicle), 0
    noise = plant.begin(x, period, 20.0, rng)
    gate = ReadingGate(4)
    loop.controller.reset(x, reference.window(0))
    c.reset(x, reference.window(0))
    refusals = 0
    for k in range(len(loop.times)):
        kind = rng.integers(3) if k % 12 == 0 else kind  # 0.12 s
        reading = (force, None, np.array([np.nan, 0.0, 9.8]))[kind]
        measurement, window = Measurement(k * period, x, reading, None), reference.window(k)
        thrusts, record = c.step(measurement, window)
        try:
            last = stepped(loop.controller, gate.admit(measurement), window)[0].copy()
            assert record.status == 0
        except QuadexpError:
            refusals += 1
            assert record.status == 3
        assert np.abs(thrusts - last).max() < 1e-9
        x, force = plant.advance(x, last, period, noise)
    assert refusals > 10


def test_a_state_that_is_none_begins_no_flight(folders: dict[str, Path]) -> None:
    c, loop = exported(folders["mpc"]), python_loop(*MPC)
    with pytest.raises(QuadexpError, match="is refused as a flight begins"):
        c.reset(np.zeros(13), loop._reference.window(0))


# ---------------------------------------------------------------------------------------------------------- references
def window_of(values: np.ndarray, rows: int, rotors: int) -> Window:
    """A window as C has it, (k,), as Python has it."""
    states, inputs = values[: 13 * rows].reshape(rows, 13), values[13 * rows :]
    size = rotors * (rows - 1)
    path, yaw = inputs[size : size + 15].reshape(5, 3), inputs[size + 15 :]
    return Window(states, inputs[:size].reshape(rows - 1, rotors), path, yaw[:3], float(yaw[3]))


def test_hold_is_an_equilibrium(folders: dict[str, Path]) -> None:
    c = exported(folders["law"])
    rows, n = len(c.node_times), c.vehicle.n_rotors
    values = np.zeros(13 * rows + n * (rows - 1) + 19)
    c._library.qx_hold.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_double]
    place = np.array([1.0, -2.0, 3.0])
    c._library.qx_hold(values.ctypes.data, place.ctypes.data, 0.7)
    window = window_of(values, rows, n)
    assert np.allclose(window.state[:, :3], place)
    assert np.allclose(window.state[:, 3:7], [np.cos(0.35), 0, 0, np.sin(0.35)])
    c.reset(window.state[0], window)
    thrusts, _ = c.step(Measurement(0.0, window.state[0], None, None), window)
    assert np.allclose(thrusts, c.vehicle.hover_thrust, rtol=1e-9)
    assert np.allclose(c.vehicle.allocation @ window.input[0], [c.vehicle.mass * c.vehicle.gravity, 0, 0, 0])


@pytest.mark.parametrize("name", ["mpc", "law"])
def test_table_is_the_exported_reference(folders: dict[str, Path], name: str) -> None:
    loop, c = python_loop(*CASES[name]), exported(folders[name])
    rows, n = len(c.node_times), c.vehicle.n_rotors
    values = np.zeros(13 * rows + n * max(rows - 1, 1) + 19)
    for k in (0, 7, len(loop.times) - 1, len(loop.times) + 5):
        c._library.qx_table(ctypes.c_void_p(values.ctypes.data), k)
        window, expected = window_of(values, rows, n), loop._reference.window(min(k, len(loop.times) - 1))
        assert np.array_equal(window.state, expected.state)
        assert np.array_equal(window.input, expected.input)
        if name == "law":
            assert np.array_equal(window.position, expected.position)
            assert np.array_equal(window.yaw, expected.yaw)


class Turning:
    """A path with a heading that turns, faster and faster."""

    def __init__(self, path: Any) -> None:
        self.path, self.duration, self.peak_speed = path, path.duration, path.peak_speed

    def flat_output(self, t: np.ndarray) -> Any:
        yaw = np.stack([0.4 + 0.3 * t + 0.05 * t**2, 0.3 + 0.1 * t, np.full(len(t), 0.1)], axis=1)
        return replace(self.path.flat_output(t), yaw=yaw)


def test_flat_outputs_give_the_reference_of_python(folders: dict[str, Path]) -> None:
    from quadexp.experiment.build import build_trajectory
    from quadexp.reference.flatness import flat_reference

    c = exported(folders["mpc"])
    rows, n = len(c.node_times), c.vehicle.n_rotors
    config = compose(["trajectory=circle", "trajectory.speed=9"], None, "simulate")
    trajectory = Turning(build_trajectory(config.trajectory, c.vehicle))
    t = 9.0 + np.array([0.0, *c.node_times])
    flat = trajectory.flat_output(t)
    given = np.concatenate([flat.position.reshape(rows + 1, 15), flat.yaw], axis=1).copy()
    values = np.zeros(13 * rows + n * (rows - 1) + 19)
    pointers = [ctypes.c_void_p(array.ctypes.data) for array in (values, given)]
    assert c._library.qx_flat(*pointers) == 1
    window, expected = window_of(values, rows, n), flat_reference(trajectory, t[1:], c.vehicle)
    assert np.allclose(window.state, expected.state, atol=1e-9)
    assert np.allclose(window.input, expected.input[:-1], atol=1e-9)
    assert np.allclose(window.position, flat.position[0])
    given[:, 8] = -c.vehicle.gravity  # free fall
    given[:, 6:8] = 0.0
    before = values.copy()
    assert c._library.qx_flat(*pointers) == 0
    assert np.array_equal(values, before)


def test_numbers_may_be_changed_in_flight(folders: dict[str, Path]) -> None:
    """The heavier the weight of the position, the larger the command: as in Python."""
    loop, c = python_loop(*MPC), exported(folders["mpc"])
    window, x = loop._reference.window(0), loop.start.copy()
    loop.reset(x)
    c.reset(x, window)
    header = (folders["mpc"] / "controller.h").read_text()
    line = next(line for line in header.splitlines() if line.startswith("#define QX_Q "))
    place, count = int(line.split()[2]), int(line.split()[4])
    c._library.qx_numbers.restype = ctypes.POINTER(ctypes.c_double)
    numbers = c._library.qx_numbers()
    weights = loop.controller.mpc.step.arguments["Q"]
    assert count == weights.size
    assert np.array_equal(numbers[place : place + count], weights.ravel())
    off = x + np.array([0.2, 0, 0, *np.zeros(10)])
    for factor in (1.0, 3.0):
        weights *= factor
        for i in range(count):
            numbers[place + i] *= factor
        for _ in range(4):
            expected = loop.step(off, 0.0)
            thrusts, _ = c.step(Measurement(0.0, off, None, None), window)
        assert np.abs(thrusts - expected).max() < 1e-9
    c.reset(x, window)
    assert np.array_equal(numbers[place : place + count], weights.ravel())


# -------------------------------------------------------------------------------------------------- what is refused
@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (("controller=online_mpc",), "controller=online_mpc decides or learns in Python"),
        (
            ("controller=pid", "delay=prediction", "delay.dead_time=0.03"),
            "delay=prediction decides or learns in Python",
        ),
        (("controller=pid", "controller.backend=interpreted"), "needs a C compiler and backend=compiled"),
    ],
)
def test_what_is_python_only_is_named(tmp_path: Path, settings: tuple[str, ...], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        export_controller(settings, tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_mistakes(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--prefix 9x"):
        export_controller(LAW, tmp_path / "c", prefix="9x")
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "mine.txt").write_text("mine")
    with pytest.raises(UsageError, match="exists already"):
        export_controller(LAW, tmp_path / "c")


def test_a_window_in_c_is_a_window(folders: dict[str, Path]) -> None:
    loop = python_loop(*MPC)
    window = loop._reference.window(3)
    again = window_of(packed(window, 4), len(window.state), 4)
    assert all(np.array_equal(one, other) for one, other in zip(window, again, strict=True))
