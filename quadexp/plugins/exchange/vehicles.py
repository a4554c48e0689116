"""A vehicle from the parameter file of another program: crazyflow (TOML), RotorPy (Python).

    crazyflow   a section of first_principles/params.toml, as crazyflies.py reads it; rate_max: not there
    RotorPy     quad_params: k = k_eta, c_tau = k_m / k_eta, T_max = k_eta rotor_speed_max^2, the rest by name

A RotorPy file is Python and is run, as RotorPy itself runs it.
"""

from __future__ import annotations

import runpy
import tomllib
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.plugins.exchange.crazyflies import vehicle_of
from quadexp.plugins.exchange.simulators import MOMENTS, plain

PARAMETERS = "quad_params"
RATE_MAX = 20.0  # rad/s, of references: no file of these has one


def vehicle_keys(path: Path, section: str = "") -> dict[str, Any]:
    """Keys of the vehicle that a file holds. section: of a TOML file with several.

    Raises UsageError where it cannot be read, or is no file of theirs.
    """
    try:
        if path.suffix == ".toml":
            sections = tomllib.loads(path.read_text(encoding="utf-8"))
            return _crazyflow(path, sections, section)
        if path.suffix == ".py":
            if section:
                raise UsageError(f"{path}: a RotorPy file has no sections, {section} was asked for")
            return _rotorpy(runpy.run_path(str(path))[PARAMETERS])
    except OSError as error:
        raise UsageError(f"{path}: cannot be read ({error.strerror})") from None
    except UsageError:
        raise
    except Exception as error:  # of the file's own code, or of what it lacks
        raise UsageError(f"{path}: not parameters of crazyflow or RotorPy: {type(error).__name__}: {error}") from None
    raise UsageError(f"{path}: must be crazyflow's params.toml, or a .py file of RotorPy with {PARAMETERS}")


def _crazyflow(path: Path, sections: dict[str, Any], section: str) -> dict[str, Any]:
    if not section and len(sections) == 1:
        section = next(iter(sections))
    if section not in sections:
        cause = f"{section} is not there" if section else "it has several drones"
        raise UsageError(f"{path}: {cause}: FILE:NAME, with NAME one of {', '.join(sections) or '(none)'}")
    return vehicle_of(sections[section]) | {"rate_max": RATE_MAX}


def _rotorpy(parameters: dict[str, Any]) -> dict[str, Any]:
    inertia = [[0.0] * 3 for _ in range(3)]
    for name, (i, j) in MOMENTS.items():
        inertia[i][j] = inertia[j][i] = float(parameters[name.capitalize()])
    k = float(parameters["k_eta"])
    return {
        "mass": float(parameters["mass"]),
        "inertia": inertia,
        "rotor_position": [plain(position) for position in parameters["rotor_pos"].values()],
        "rotor_spin": [float(spin) for spin in parameters["rotor_directions"]],
        "torque_coefficient": float(parameters["k_m"]) / k,
        "thrust_min": k * float(parameters["rotor_speed_min"]) ** 2,
        "thrust_max": k * float(parameters["rotor_speed_max"]) ** 2,
        "rate_max": RATE_MAX,
        "thrust_coefficient": k,
    }
