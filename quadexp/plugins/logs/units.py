"""Units and axes that a log may use, and what they are in SI, ENU (world) and FLU (body)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadexp.errors import UsageError

STANDARD_GRAVITY = 9.80665  # m/s^2, what "g" means on an accelerometer
_TURN = 2 * np.pi

# What a unit is in SI, by dimension; the first is SI.
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3, "ft": 0.3048},
    "velocity": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1 / 3.6, "kn": 1852 / 3600, "ft/s": 0.3048},
    "rate": {"rad/s": 1.0, "deg/s": np.pi / 180, "mrad/s": 1e-3, "mdeg/s": np.pi / 180e3},
    "acceleration": {"m/s^2": 1.0, "g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY, "cm/s^2": 1e-2},
    "angle": {"rad": 1.0, "deg": np.pi / 180, "cdeg": np.pi / 18000},
    "rotor_speed": {"rad/s": 1.0, "rpm": _TURN / 60, "krpm": _TURN / 60e-3, "Hz": _TURN, "deg/s": np.pi / 180,
                    "erpm": _TURN / 60},
    "voltage": {"V": 1.0, "mV": 1e-3, "cV": 1e-2, "dV": 1e-1},
    "force": {"N": 1.0, "mN": 1e-3, "gf": 1e-3 * STANDARD_GRAVITY},
    "none": {"1": 1.0},
}  # fmt: skip
ELECTRICAL = "erpm"  # turns of the motor's field: pole pairs times those of the rotor

# Axes of a frame in ENU or FLU, as the log's components: "y x -z" says ENU = (log y, log x, -log z).
WORLD_FRAMES = {"enu": "x y z", "nwu": "-y x z", "ned": "y x -z", "nue": "z x y", "eus": "x -z y"}
BODY_FRAMES = {"flu": "x y z", "frd": "x -y -z", "rfu": "y -x z", "rdf": "z -x -y", "luf": "z x y"}
FRAMES = dict.fromkeys(WORLD_FRAMES, "world") | dict.fromkeys(BODY_FRAMES, "body")  # name -> of what
AXES = ("x", "y", "z")


def unit_factor(dimension: str, unit: str, where: str) -> float:
    """What one `unit` is in SI."""
    known = UNITS[dimension]
    if unit not in known:
        raise UsageError(f"{where}: unit {unit!r} is not known; allowed are {', '.join(known)}")
    return known[unit]


def axes_matrix(kind: str, frame: str, where: str) -> np.ndarray:
    """Signed permutation S, (3, 3): vector in ENU (kind "world") or FLU ("body") = S (vector as logged).

    frame: a name ("NED"), or what each axis of ENU or FLU is in the log, such as "y x -z".
    """
    names = WORLD_FRAMES if kind == "world" else BODY_FRAMES
    text = str(frame).lower()
    words = names.get(text, text).replace(",", " ").split()
    matrix = np.zeros((3, 3))
    for row, word in zip(matrix, words, strict=False):
        if word.lstrip("+-") in AXES and len(word) <= 2:
            row[AXES.index(word[-1])] = -1.0 if word[0] == "-" else 1.0
    if len(words) != 3 or not np.array_equal(matrix @ matrix.T, np.eye(3)):
        allowed = ", ".join(names).upper()
        example = 'or three signed axes such as "y x -z"'
        raise UsageError(f"{where}: frame {frame!r} is not known; allowed are {allowed}, {example}")
    return matrix


def axes_words(matrix: np.ndarray) -> str:
    """A signed permutation, (3, 3), in the words of axes_matrix: "y x -z"."""
    words = []
    for row in matrix:
        sign = "-" if row.min() < 0 else ""
        words.append(sign + AXES[int(np.argmax(np.abs(row)))])
    return " ".join(words)


def mounting_matrix(angles: Sequence[float]) -> np.ndarray:
    """R_z(yaw) R_y(pitch) R_x(roll), (3, 3), of roll, pitch, yaw in degrees: from a sensor's axes to the body's."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("ZYX", angles[::-1], degrees=True).as_matrix()
