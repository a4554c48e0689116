"""The numbers of a Crazyflie's vehicle and plant, from the files of the package that identified it.

The package is crazyflow, or drone-models that was merged into it (both: University of Toronto, utiasDSL; MIT licence).
Its files are read as data; it is not imported. An option asks for them by `numbers`, see quadexp/parts/options.py.
"""

from __future__ import annotations

import importlib.util
import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import UsageError

RPM = math.pi / 30  # rad/s
GRAVITY = 9.81  # m/s^2, which both packages have
DIGITS = 14  # of coefficients that are computed from a curve, in hover
FILES = {"crazyflow": "dynamics/first_principles/params.toml", "drone_models": "data/params.toml"}  # the first counts


def crazyflie_numbers(group: str, drone: str) -> dict[str, Any]:
    """Keys of the vehicle, or else of the plant, of one of the package's drones.

    Raises UsageError where no package is installed, it has no such drone, or its file says something else of it.
    """
    path = _file(drone)
    try:
        stated = tomllib.loads(path.read_text(encoding="utf-8"))[drone]
        return vehicle_of(stated) if group == "vehicle" else _plant(stated)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise UsageError(f"{path}: not the numbers of {drone} in the first-principles model: {error!r}") from None


def _file(drone: str) -> Path:
    for package, name in FILES.items():
        spec = importlib.util.find_spec(package)
        for folder in (spec and spec.submodule_search_locations) or ():
            path = Path(folder) / name
            if path.is_file():
                return path
    raise UsageError(
        f"{drone} has the numbers of the package crazyflow, or of drone-models, which was merged into it, and neither"
        " is installed: pip install crazyflow, or 'quadexp[drone-models]'"
    )


def vehicle_of(stated: dict[str, Any]) -> dict[str, Any]:
    """Keys of the vehicle, of a section of the package's file."""
    roll, pitch, spin = np.array(stated["mixing_matrix"], float)
    hover = stated["mass"] * GRAVITY / len(spin)
    k_0, k_1, k_2 = stated["rpm2thrust"]
    rpm = (math.sqrt(k_1**2 - 4 * k_2 * (k_0 - hover)) - k_1) / (2 * k_2)
    reaction = np.polynomial.Polynomial(stated["rpm2torque"])(rpm) / hover
    return {
        "mass": stated["mass"],
        "inertia": stated["J"],
        "rotor_position": (stated["L"] * np.column_stack([-pitch, roll, np.zeros(len(spin))])).tolist(),
        "rotor_spin": spin.tolist(),
        "torque_coefficient": stated.get("thrust2torque", float(f"{reaction:.{DIGITS}g}")),
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
