"""Motors and battery: which columns, in which range, and which motor is where.

Where: the angular acceleration is linear in the thrusts, wx' ~ sum y_i T_i, wy' ~ -sum x_i T_i, so the signs of a
regression (quadexp/log/check/rotors.py) are those of the arms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quadexp.log.check.rotors import Fit, stretch
from quadexp.log.hypotheses.conventions import Table
from quadexp.log.importers.mapping_reader import PLACES
from quadexp.log.importers.names import unit_of
from quadexp.log.signal.crop import runs
from quadexp.log.units import axes_matrix

LEAST_EXPLAINED = 0.08  # of the angular acceleration, for the places of motors to be stated
BY_SIGNS = {signs: place for place, signs in PLACES.items()}  # of x and y, FLU

Lines = dict[str, tuple[Any, float, str]]  # by quantity: value in the mapping, confidence, evidence


def find_motors(
    names: Sequence[str], table: Table, named: Mapping[str, list[list[int]]], free: list[list[int]],
    fields: Mapping[str, Any],
) -> Lines:  # fmt: skip
    """The motors' commands or speeds. named: columns by what their names say; free: four side by side whose names say
    nothing; fields: values of the mapping's other lines."""
    columns_of = {key: [names.index(str(n)) for n in value["columns"]] for key, value in fields.items()
                  if isinstance(value, dict) and "columns" in value}  # fmt: skip
    taken = {i for columns in columns_of.values() for i in columns}
    groups = [(kind, g) for kind in ("rotor_speed", "motor") for g in named.get(kind, [])]
    groups = [(kind, g) for kind, g in groups if table.x[:, g].min() >= -0.2 * table.x[:, g].max()]
    groups = [(kind, g) for kind, g in groups if not set(g) & taken]
    by_name = bool(groups)
    groups = groups or [("motor", g) for g in free if not set(g) & taken and _alike(table.means[:, g])]
    force, rate = columns_of.get("acceleration"), columns_of.get("rate")
    candidates = []
    for kind, columns in groups:
        if np.ptp(table.x[:, columns], axis=0).min() == 0:
            continue
        layout = _layout(table, columns, rate, fields) if rate is not None and len(columns) == 4 else None
        agreement = 0.0
        if force is not None:
            up = int(np.argmax(np.abs(table.means[:, force].mean(axis=0))))
            squares = (table.means[:, columns] ** 2).sum(axis=1)
            agreement = abs(float(np.nan_to_num(np.corrcoef(squares, table.means[:, force[up]])[0, 1])))
        if by_name or agreement > 0.5 or layout is not None:
            rank = 0.0 if by_name else agreement + (layout is not None)
            candidates.append((rank, kind, columns, agreement, layout))
    made: Lines = {}
    for _, kind, columns, agreement, layout in sorted(candidates, key=lambda c: -c[0]):
        quantity, entry, sure, why = _range(names, columns, kind, table.x[:, columns])
        if quantity in made or (made and not by_name):
            continue
        why += f"; the sum of squares correlates {agreement:.2f} with the thrust" if force is not None else ""
        if layout is not None:
            entry["layout"] = layout[0]
            why += f"; places from the angular acceleration, {layout[1]:.0%} of it explained"
        elif len(columns) == 4:
            why += "; which is where is not clear: taken in the vehicle's order unless a `layout` is given"
        value = {"columns": [names[i] for i in columns], **entry}
        made[quantity] = value, sure if by_name else min(sure, 0.55), why
    return made


def _alike(x: np.ndarray) -> bool:
    """Whether four columns could be motors: positive, of one size, and moving."""
    mean, spread = x.mean(axis=0), x.std(axis=0)
    if x.min() < 0 or mean.min() <= 0 or spread.min() < 0.01 * mean.mean():
        return False
    return bool(np.ptp(mean) < 0.4 * mean.mean() and spread.max() < 4 * spread.min())


def _range(
    names: Sequence[str], columns: list[int], kind: str, x: np.ndarray
) -> tuple[str, dict[str, Any], float, str]:
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


def _layout(table: Table, columns: list[int], rate: list[int], fields: Mapping[str, Any]) -> Any:
    """Places of four motors in FLU, and the share of the angular acceleration they explain; None where not clear."""
    frame = str(fields["rate"].get("frame", fields.get("body", "FLU"))).removeprefix("body ")
    omega = table.x[:, rate] @ axes_matrix("body", frame, "rate").T
    squares = (table.x[:, columns] / table.x[:, columns].mean()) ** 2
    mean = squares.mean(axis=1)
    first, last = max(runs(mean > 0.1 * np.percentile(mean, 95)), key=lambda run: run[1] - run[0])
    apart = squares - mean[:, None]  # what all motors do together turns nothing
    made = stretch(table.t[first:last], omega[first:last], apart[first:last], np.eye(3))
    if made is None:
        return None
    found, shares = Fit(*made).columns()
    places = [BY_SIGNS[int(np.sign(x)) or 1, int(np.sign(y)) or 1] for x, y in zip(-found[1], found[0], strict=True)]
    explained = float(shares[:2].min())
    return (places, explained) if len(set(places)) == 4 and explained > LEAST_EXPLAINED else None


def find_battery(names: Sequence[str], table: Table, named: Mapping[str, list[list[int]]]) -> Lines:
    """The battery's voltage by its name, its unit by its name or size; empty where none is named."""
    for columns in named.get("battery_voltage", []):
        middle = float(np.median(table.x[:, columns[0]]))
        unit = unit_of(names[columns[0]])[1]
        if unit not in ("V", "mV", "cV", "dV"):
            unit = "V" if middle < 60 else "dV" if middle < 280 else "cV" if middle < 6000 else "mV"
        if middle > 0:
            value = {"column": names[columns[0]], "unit": unit}
            return {"battery_voltage": (value, 0.8, f"median {middle:.4g}")}
    return {}
