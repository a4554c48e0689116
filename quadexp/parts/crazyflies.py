"""The numbers of a Crazyflie's vehicle and plant, from the files of the package that identified it.

The package is crazyflow, or drone-models that was merged into it (both: University of Toronto, utiasDSL; MIT licence).
Its files are read as data; it is not imported. An entry of a sheet asks for them by `crazyflie: cf2x_L250`, and what it
states besides counts over them.
"""

from __future__ import annotations

import importlib.util
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import UsageError

CRAZYFLIE = "crazyflie"
RPM = math.pi / 30  # rad/s
DIGITS = 14  # of a thrust coefficient that is computed from a curve
# Files of a package, the first that counts first, each with what leads to the numbers of a drone in it.
FILES = {
    "crazyflow": {
        "dynamics/first_principles/params.toml": "{drone}",
        "control/mellinger/params.toml": "{drone}.core",
        "dynamics/params.toml": "",
    },
    "drone_models": {"data/params.toml": "{drone}"},
}


def crazyflie_numbers(group: str, drone: str) -> dict[str, Any]:
    """Keys of the vehicle, or else of the plant, of one of the package's drones.

    Raises UsageError where no package is installed, it has no such drone, or its file says something else of it.
    """
    path, stated = _stated(drone)
    try:
        return _vehicle(stated) if group == "vehicle" else _plant(stated)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise UsageError(f"{path}: {drone}: not the numbers of a first-principles model: {error!r}") from None


def _stated(drone: str) -> tuple[Path, dict[str, Any]]:
    """A file, and what is said of a drone in it and those beside it."""
    for package, files in FILES.items():
        spec = importlib.util.find_spec(package)
        folders = list(spec.submodule_search_locations or ()) if spec else []
        for folder in map(Path, folders):
            first = folder / next(iter(files))
            if first.is_file():
                return first, _joined(folder, files, drone)
    raise UsageError(
        f"{drone} has the numbers of the package crazyflow, or of drone-models, which was merged into it, and none of them"
        " is installed: pip install crazyflow, or 'quadexp[drone-models]'"
    )


def _joined(folder: Path, files: dict[str, str], drone: str) -> dict[str, Any]:
    numbers: dict[str, Any] = {}
    for name, way in files.items():
        path = folder / name
        try:
            content = tomllib.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise UsageError(f"{path}: {error}") from None
        if not numbers and drone not in content:
            raise UsageError(f"{path}: has no drone {drone}; there are {', '.join(sorted(content))}")
        for step in way.format(drone=drone).split(".") if way else ():
            content = content.get(step, {})
        numbers = content | numbers
    return numbers


def _vehicle(stated: dict[str, Any]) -> dict[str, Any]:
    roll, pitch, spin = np.array(stated["mixing_matrix"], float)
    arm = np.array(stated["L"], float)
    gravity = -stated["gravity_vec"][2]
    hover = stated["mass"] * gravity / len(spin)
    k_0, k_1, k_2 = stated["rpm2thrust"]
    rpm = (math.sqrt(k_1**2 - 4 * k_2 * (k_0 - hover)) - k_1) / (2 * k_2)
    return {
        "mass": stated["mass"],
        "gravity": gravity,
        "inertia": stated["J"],
        "rotor_position": np.stack([-arm * pitch, arm * roll, np.zeros(len(spin))], axis=1).tolist(),
        "rotor_spin": spin.tolist(),
        "torque_coefficient": stated["thrust2torque"],
        "thrust_min": stated["thrust_min"],
        "thrust_max": stated["thrust_max"],
        "thrust_coefficient": float(f"{hover / (RPM * rpm) ** 2:.{DIGITS}g}"),
    }


def _plant(stated: dict[str, Any]) -> dict[str, Any]:
    drag = -np.array(stated["drag_matrix"], float)
    if np.any(drag != np.diag(np.diag(drag))):
        raise ValueError("drag_matrix is not diagonal")
    return {
        "thrust_curve": stated["rpm2thrust"],
        "torque_curve": stated["rpm2torque"],
        "spin_up": stated["rotor_dyn_coef"][:2],
        "spin_down": stated["rotor_dyn_coef"][2:],
        "linear_drag": np.diag(drag).tolist(),
        "propeller_inertia": stated["prop_inertia"],
    }
