"""Where the motors of a PX4 log are on the vehicle."""

from __future__ import annotations

from collections.abc import Mapping

QUAD_X = ("front_right", "back_left", "front_left", "back_right")


def motor_layout(count: int, parameters: Mapping[str, float], notes: list[str]) -> tuple[str, ...] | None:
    """Where the motors are: by the control allocation's parameters (FRD), or the order of PX4's quad-x."""
    if not count:
        return None
    places = []
    for i in range(count):
        x, y = parameters.get(f"CA_ROTOR{i}_PX"), parameters.get(f"CA_ROTOR{i}_PY")
        if x is None or y is None or not (x or y):
            break
        reach = 0.2 * max(abs(x), abs(y))
        words = ["front" if x > 0 else "back"] if abs(x) > reach else []
        words += ["right" if y > 0 else "left"] if abs(y) > reach else []
        places.append("_".join(words))
    if len(places) == count and len(set(places)) == count:
        return tuple(places)
    if count == 4:
        notes.append("motors in the order of PX4's quad-x: front right, back left, front left, back right")
        return QUAD_X
    return None
