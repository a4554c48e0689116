"""The C of an exported controller, compiled from its folder, flown by the bench: controller=exported model=FOLDER."""

from __future__ import annotations

import ctypes
import json
import shutil
import tempfile
import weakref
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.compile.backend import resolve
from quadexp.compile.compiler import run_compiler
from quadexp.compile.symbolic import ca
from quadexp.control.base import Measurement, Window
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import StepRecord
from quadexp.control.part import ControllerPart
from quadexp.errors import DataError, QuadexpError
from quadexp.models.build_context import BuildContext
from quadexp.models.residual import Residual
from quadexp.names import sha256_of
from quadexp.parts.settings import keyed
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.vehicle.export import FORMAT, MANIFEST, as_text
from quadexp.plugins.vehicle.record import packed
from quadexp.plugins.vehicle.texts import SOURCES

FLAGS = ("-std=c11", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared")
OK = 0  # what reset and step answer


@keyed
class Exported(ControllerPart):
    """A controller that was exported as C, flown from its folder, `model`."""

    makes = "quadexp export-controller controller=NAME --out FOLDER"

    @property
    def learned(self) -> tuple[str, ...]:
        """See ControllerPart: the folder stands where others have a checkpoint."""
        return ("exported",)

    @property
    def folders(self) -> tuple[str, ...]:
        """See Part."""
        return ()

    def build(self, context: BuildContext) -> ExportedController:
        """See ControllerPart. Raises DataError for a folder that was changed, or is of another vehicle."""
        return ExportedController(Path(context.folder), context.vehicle)


class ExportedController:
    """A Controller (see control.base) that is a library. folder: that `export-controller` wrote."""

    reference_period = 0.0

    def __init__(self, folder: Path, vehicle: Vehicle) -> None:
        self.folder, self.vehicle = folder, vehicle
        self.about = manifest_of(folder)
        stated = self.about["vehicle"]
        if stated["fingerprint"] != vehicle.fingerprint:
            raise DataError(
                f"{folder}: exported for vehicle '{stated['name']}' ({stated['fingerprint']}), not for '{vehicle.name}'"
                f" ({vehicle.fingerprint})"
            )
        resolve("compiled")  # raises without a compiler
        self.backend = "compiled"
        self.control_period: float = self.about["period"]
        self.node_times = np.array(self.about["node_times"])
        self.residual_name, self.source = self.about["knows"], self.about["source"]
        self.residual = residual_of(self.about["air"])
        self._real = np.dtype("f8" if self.about["real"] == "double" else "f4")
        self._library = loaded(folder, self)
        self._command = np.zeros(vehicle.n_rotors, self._real)

    def forget(self) -> None:
        """See Controller.forget."""

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset. Raises QuadexpError where the library refuses the state or the reference."""
        state, reference = self._given(x), self._given(packed(window, self.vehicle.n_rotors))
        if self._call("reset", state, reference) != OK:
            raise QuadexpError(f"{self.folder}: the state, or the reference, is refused as a flight begins")

    def step(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, StepRecord]:
        """See Controller.step."""
        state, reference = self._given(measurement.state), self._given(packed(window, self.vehicle.n_rotors))
        force, speed = self._given(measurement.specific_force), self._given(measurement.rotor_speed)
        answer = self._call("step", state, force, speed, reference, self._command)
        thrusts = self._command.astype(float)
        if self._real == np.float32:  # a limit in single precision may lie beyond the rotor's
            thrusts = np.clip(thrusts, self.vehicle.thrust_min, self.vehicle.thrust_max)
        limited = int(((thrusts <= self.vehicle.thrust_min) | (thrusts >= self.vehicle.thrust_max)).sum())
        status = Status.OK if answer == OK else Status.FAILED
        return thrusts, StepRecord(0.0, status, 0, limited, 0.0)

    def log(self) -> dict[str, float]:
        """See Controller.log."""
        return {}

    @property
    def rates(self) -> tuple[np.ndarray, np.ndarray, float] | None:
        """Body rates of the first two nodes of an MPC's prediction, (3,) each (rad/s), and the time between these (s);
        None of a law."""
        function = getattr(self._library, f"{self.about['prefix']}_rates")
        function.restype = ctypes.POINTER(ctypes.c_double if self._real == np.float64 else ctypes.c_float)
        place = function()
        if not place:
            return None
        numbers = np.array(place[:7], float)
        return numbers[:3], numbers[3:6], numbers[6]

    def _given(self, values: Any) -> np.ndarray | None:
        return None if values is None else np.ascontiguousarray(values, self._real)

    def _call(self, name: str, *arrays: np.ndarray | None) -> int:
        function = getattr(self._library, f"{self.about['prefix']}_{name}")
        places = [None if array is None else ctypes.c_void_p(array.ctypes.data) for array in arrays]
        return int(function(*places))


def manifest_of(folder: Path) -> dict[str, Any]:
    """What is said of an exported controller. Raises DataError where its files are no longer those."""
    file = folder / MANIFEST
    try:
        about: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
        known = about["exported"] == FORMAT
        files: dict[str, str] = about["files"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            f"{file}: no exported controller ({type(error).__name__}); make one: {Exported.makes}"
        ) from None
    if not known:
        raise DataError(f"{file}: is of format {about['exported']}, this program reads {FORMAT}: export it again")
    if about.pop("sha256", "") != sha256_of(as_text(about)):
        raise DataError(f"{file}: is not as it was exported; export it again")
    for name, content in files.items():
        path = folder / Path(name).name
        if not path.is_file() or sha256_of(path.read_bytes()) != content:
            raise DataError(f"{path}: is not as it was exported; export it again")
    return about


def residual_of(air: dict[str, Any]) -> Residual | None:
    """The model of the air that references contain."""
    if not air:
        return None
    function, ranges = ca.Function.deserialize(air["function"]), air["ranges"] or None
    return Residual(air["name"], function, np.array(air["theta"]), air["source"], ranges=ranges)


def loaded(folder: Path, owner: Any) -> ctypes.CDLL:
    """The library of a folder. Its memory is static, so every controller has a copy of its own, which goes with it."""
    scratch = tempfile.mkdtemp(prefix="quadexp-exported-")
    weakref.finalize(owner, shutil.rmtree, scratch, ignore_errors=True)
    built = Path(scratch) / "controller.so"
    sources = [str(folder / name) for name in SOURCES if name in owner.about["files"]]
    run_compiler([*FLAGS, *sources, "-o", str(built), "-lm"], f"compile {folder}", scratch)
    try:
        return ctypes.CDLL(str(built))
    except OSError as error:
        raise QuadexpError(f"{folder}: the compiled controller cannot be loaded: {error}") from None
