"""Motors and battery: which columns, in which range, and which motor is where.

Where: the angular acceleration is linear in the thrusts, wx' ~ sum y_i T_i, wy' ~ -sum x_i T_i, so the signs of a fit
of the rates' derivatives to the motors' squares are those of the arms.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.log.importers.evidence import Samples, correlations
from quadexp.log.importers.names import unit_of
from quadexp.log.importers.proposal import Groups, Proposal

LEAST_EXPLAINED = 0.08  # of the angular acceleration, for the places of motors to be said
PLACES = {(1, -1): "front_right", (-1, -1): "back_right", (-1, 1): "back_left", (1, 1): "front_left"}


def find_motors(
    names: list[str], s: Samples, usable: list[int], said: Groups,
    force: list[int] | None, rate: list[int] | None, fields: dict[str, Proposal],
) -> dict[str, Proposal]:  # fmt: skip
    """The motors' commands or speeds."""
    taken = {
        names.index(str(n)) for p in fields.values() if isinstance(p.value, dict) for n in p.value.get("columns", [])
    }
    made: dict[str, Proposal] = {}
    groups = [("rotor_speed", g) for g in said.get("rotor_speed", [])] + [("motor", g) for g in said.get("motor", [])]
    groups = [(kind, g) for kind, g in groups if not set(g) & taken and s.x[:, g].min() >= -0.2 * s.x[:, g].max()]
    named = bool(groups)
    if not groups:
        groups = [
            ("motor", g)
            for i in range(len(names) - 3)
            if set(g := list(range(i, i + 4))) <= set(usable) - taken and _alike(s.x[:, g])
        ]
    candidates = []
    for kind, columns in groups:
        x = s.x[:, columns]
        if np.ptp(x, axis=0).min() == 0:
            continue
        layout = _layout(s, x, rate, fields) if rate is not None and len(columns) == 4 else None
        agreement = 0.0
        if force is not None:
            up = s.x[:, force][:, int(np.argmax(np.abs(s.x[:, force].mean(axis=0))))]
            agreement = abs(float(correlations((x**2).sum(axis=1, keepdims=True), up[:, None])[0, 0]))
        if named or agreement > 0.5 or layout is not None:
            candidates.append(
                (agreement + (1.0 if layout else 0.0) if not named else 0.0, kind, columns, agreement, layout)
            )
    for _, kind, columns, agreement, layout in sorted(candidates, key=lambda c: -c[0]):
        quantity, entry, sure, why = _range(names, columns, kind, s.x[:, columns])
        if quantity in made or (made and not named):
            continue
        why += f"; the sum of squares correlates {agreement:.2f} with the thrust" if force is not None else ""
        if layout is not None:
            entry["layout"] = layout[0]
            why += f"; places from the angular acceleration, {layout[1]:.0%} of it explained"
        elif len(columns) == 4:
            why += "; which is where is not clear: taken in the vehicle's order unless a `layout` is given"
        made[quantity] = Proposal(
            {"columns": [names[i] for i in columns], **entry}, sure if named else min(sure, 0.55), why
        )
    return made


def _alike(x: np.ndarray) -> bool:
    """Whether four columns could be motors: positive, of one size, and moving."""
    mean, spread = x.mean(axis=0), x.std(axis=0)
    if x.min() < 0 or mean.min() <= 0 or spread.min() < 0.01 * mean.mean():
        return False
    return bool(np.ptp(mean) < 0.4 * mean.mean() and spread.max() < 4 * spread.min())


def _range(names: list[str], columns: list[int], kind: str, x: np.ndarray) -> tuple[str, dict[str, Any], float, str]:
    """Quantity and range or unit, by the size of the values."""
    written = unit_of(names[columns[0]])[1]
    largest, middle = float(x.max()), float(np.median(x))
    why = f"median {middle:.4g}, largest {largest:.5g}"
    if written == "erpm" or (kind == "rotor_speed" and "erpm" in names[columns[0]].lower()):
        why += "; electrical turns: pole_pairs is a guess, magnets of the motor over two"
        return "rotor_speed", {"unit": "erpm", "pole_pairs": 7}, 0.4, why
    if written in ("rpm", "rad/s", "Hz"):
        return "rotor_speed", {"unit": written}, 0.9, f"the name says the unit; {why}"
    if kind == "rotor_speed" and largest > 1.5:
        unit = "rpm" if middle > 3500 or "rpm" in names[columns[0]].lower() else "rad/s"
        return "rotor_speed", {"unit": unit}, 0.7, f"named as speeds, {why}"
    for limit, low, high in ((1.5, 0, 1), (110, 0, 100), (260, 0, 255)):
        if largest <= limit:
            return "motor_command", {"range": [low, high]}, 0.7, why
    if any(name.startswith(("axisP[", "loopIteration")) for name in names):
        return "motor_command", {"range": [48, 2047]}, 0.7, f"{why}: Betaflight counts"
    if largest <= 2200:
        if np.percentile(x, 1) > 850:
            return "motor_command", {"range": [1000, 2000]}, 0.8, f"{why}: pulse widths in us"
        return "motor_command", {"range": [0, 2000]}, 0.6, f"{why}: DShot or Betaflight counts"
    if largest > 30_000:
        return "motor_command", {"range": [0, 65535]}, 0.8, f"{why}: 16 bits"
    return "rotor_speed", {"unit": "rpm"}, 0.5, why


def _layout(s: Samples, x: np.ndarray, rate: list[int], fields: dict[str, Proposal]) -> tuple[list[str], float] | None:
    """Places of four motors in FLU, and the share of the angular acceleration they explain."""
    from quadexp.log.importers.units import axes_matrix

    entry = fields["rate"].value
    frame = str(entry.get("frame", fields["body"].value if "body" in fields else "FLU")).removeprefix("body ")
    omega = s.x[:, rate] @ axes_matrix("body", frame, "rate").T
    slope = s.rate_of(omega)[:, :2]
    squares = (x / x.mean()) ** 2
    running = x.mean(axis=1) > 0.3 * np.percentile(x.mean(axis=1), 95)
    best = max((_arms(squares, slope, running, lag) for lag in range(_lags(s))), key=lambda made: made[1])
    arms, explained = best
    places = [PLACES[int(np.sign(a)) or 1, int(np.sign(b)) or 1] for a, b in arms - arms.mean(axis=0)]
    return (places, explained) if len(set(places)) == 4 and explained > LEAST_EXPLAINED else None


def _lags(s: Samples) -> int:
    """How many samples the motors may be late."""
    return 1 + int(0.12 / float(s.t[1] - s.t[0]))


def _arms(squares: np.ndarray, slope: np.ndarray, running: np.ndarray, lag: int) -> tuple[np.ndarray, float]:
    """x and y of the rotors up to a scale, (4, 2), and the share explained of the axis that is explained less."""
    keep = running[: len(running) - lag]
    a, b = squares[: len(squares) - lag][keep], slope[lag:][keep]
    if len(a) < 50:
        return np.zeros((4, 2)), -1.0
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    found, *_ = np.linalg.lstsq(a, b, rcond=None)
    left = b - a @ found
    explained = 1 - (left**2).sum(axis=0) / np.maximum((b**2).sum(axis=0), 1e-12)
    return np.stack([-found[:, 1], found[:, 0]], axis=1), float(explained.min())


def find_battery(names: list[str], s: Samples, usable: list[int], said: Groups) -> dict[str, Proposal]:
    """The battery's voltage by its name, its unit by its name or size; empty where none is named."""
    for columns in said.get("battery_voltage", []):
        x = s.x[:, columns[0]]
        middle = float(np.median(x))
        unit = unit_of(names[columns[0]])[1]
        if unit not in ("V", "mV", "cV", "dV"):
            unit = "V" if middle < 60 else "dV" if middle < 280 else "cV" if middle < 6000 else "mV"
        if middle > 0:
            return {
                "battery_voltage": Proposal({"column": names[columns[0]], "unit": unit}, 0.8, f"median {middle:.4g}")
            }
    return {}
