"""The unit of a gyro or an accelerometer, from its column's name and the size of its values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from quadexp.log.importers.names import unit_of
from quadexp.log.importers.units import UNITS


def rate_unit(names: Sequence[str], columns: list[int], x: np.ndarray) -> tuple[str, float, str]:
    """Unit of a gyro that nothing can be compared with: the name's, or by its size."""
    written = unit_of(names[columns[0]])[1]
    if written in UNITS["rate"]:
        return str(written), 0.85, "the name says the unit"
    spread = float(np.percentile(np.abs(x - np.median(x, axis=0)), 99))
    unit = "deg/s" if spread > 15 else "rad/s"
    return unit, 0.6 if spread > 60 or spread < 8 else 0.4, f"99 % of its values within {spread:.3g}"


def force_unit(names: Sequence[str], columns: list[int], mean: float) -> tuple[dict[str, Any], float, str]:
    """Unit of an accelerometer from the size of its mean, which in flight is about that of gravity."""
    written = unit_of(names[columns[0]])[1]
    sizes = {"g": 1.0, "m/s^2": 9.81, "cm/s^2": 981.0, "mg": 1000.0}
    counts = {2048.0: "2048 counts a g", 4096.0: "4096 counts a g", 512.0: "512 counts a g", 8192.0: "8192 counts a g"}
    near = min([*sizes.values(), *counts], key=lambda size: abs(np.log(max(mean, 1e-9) / size)))
    clear = abs(np.log(max(mean, 1e-9) / near)) < 0.4
    why = f"its mean length is {mean:.4g}"
    if near in counts and written not in sizes:
        return {"unit": "g", "scale": 1 / near}, 0.75 if clear else 0.4, f"{why}: {counts[near]}"
    if mean < 0.5 and written != "g":
        return {"unit": "m/s^2", "kind": "coordinate"}, 0.4, f"{why}: gravity is not in it"
    unit = next((name for name, size in sizes.items() if size == near), "m/s^2")
    if written in sizes and written != unit:
        return {"unit": written}, 0.4, f"{why}, which would be {unit}; but the name says {written}"
    return {"unit": unit}, 0.95 if clear else 0.4, why
