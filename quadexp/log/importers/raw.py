"""What a reader hands over: streams on their own clocks, already in SI units, ENU and FLU, named by quantity.

A stream's time is the log's own (s), its values are (k, m).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.log.signal import Stream, increasing

# Quantity -> columns of a flight; {} stands for the number of a rotor.
QUANTITIES: dict[str, tuple[str, ...]] = {
    "position": ("p_x", "p_y", "p_z"),
    "attitude": ("q_w", "q_x", "q_y", "q_z"),
    "velocity": ("v_x", "v_y", "v_z"),
    "rate": ("w_x", "w_y", "w_z"),
    "acceleration": ("acc_x", "acc_y", "acc_z"),
    "motor_command": ("motor_command_{}",),
    "rotor_speed": ("rotor_speed_{}",),
    "rotor_thrust": ("u_{}",),
    "thrust_acceleration": ("thrust_acceleration",),
    "battery_voltage": ("battery_voltage",),
    "wind": ("wind_x", "wind_y", "wind_z"),
    "reference_position": ("ref_p_x", "ref_p_y", "ref_p_z"),
    "reference_velocity": ("ref_v_x", "ref_v_y", "ref_v_z"),
    "reference_attitude": ("ref_q_w", "ref_q_x", "ref_q_y", "ref_q_z"),
}
ROTORS = ("motor_command", "rotor_speed", "rotor_thrust")


def columns_of(quantity: str, width: int) -> tuple[str, ...]:
    """Names of the flight's columns that a stream of `width` values fills."""
    names = QUANTITIES[quantity]
    return tuple(names[0].format(i) for i in range(width)) if quantity in ROTORS else names


@dataclass(frozen=True)
class Crop:
    """What is cut off. mode: "auto" (ground phases, from height and motion), "height", or "none".

    height: of the vehicle above which it flies (m). margin: cut off both ends of the flight besides (s).
    """

    mode: str = "auto"
    height: float | None = None
    margin: float = 0.0


@dataclass
class RawLog:
    """One log, read. mapping: name of the mapping, or of the reader's convention. layout: position of each of the log's
    motors ("front_right", ...), or None where they stand in the vehicle's own order. about: for the flight's record."""

    format: str
    streams: dict[str, Stream]
    mapping: str = ""
    layout: tuple[str, ...] | None = None
    crop: Crop = field(default_factory=Crop)
    notes: list[str] = field(default_factory=list)
    about: dict[str, Any] = field(default_factory=dict)


MOST_COPIES = 0.2  # share of the rows that may be copies of earlier ones, time and all


def clean_stream(path: Path, name: str, t: np.ndarray, values: np.ndarray, notes: list[str]) -> Stream:
    """A stream without rows that are not numbers or repeat a time; what was dropped is noted.

    Raises DataError where no number is left, or the clock runs backwards.
    """
    values = values.reshape(len(t), -1)
    good = np.isfinite(t)
    for column in values.T:
        good &= np.isfinite(column)
    count = int(good.sum())
    if not count:
        raise DataError(f"{path}: {name}: not one row of {len(t)} is a number throughout")
    if count < len(t):
        notes.append(f"{name}: {len(t) - count} of {len(t)} rows are empty or not numbers")
        t, values = t[good], values[good]
    step = np.diff(t)
    if len(step) and step.min() <= 0:
        t, values = _forward(path, name, t, values, step, notes)
    return Stream(t, values)


def _forward(
    path: Path, name: str, t: np.ndarray, values: np.ndarray, step: np.ndarray, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Rows whose time is later than that of all rows before; few may be lost, but for copies of earlier rows."""
    _, first = np.unique(np.column_stack([t, values]), axis=0, return_index=True)
    if (1 - MOST_COPIES) * len(t) <= len(first) < len(t):
        notes.append(
            f"{name}: {len(t) - len(first)} of {len(t)} rows are copies of earlier ones, time and all: dropped"
        )
        first = np.sort(first)
        t, values = t[first], values[first]
        step = np.diff(t)
        if not len(step) or step.min() > 0:
            return t, values
    back = np.flatnonzero(step < 0)
    late = increasing(t)
    lost = len(t) - int(late.sum())
    if len(back) and lost > max(2, 0.01 * len(t)):
        row = int(back[0]) + 1
        raise DataError(
            f"{path}: {name}: time goes backwards at row {row} ({t[row - 1]:.9g} -> {t[row]:.9g} s;"
            f" {lost} of {len(t)} rows are out of order)"
        )
    what = "repeat a time or go back in it" if len(back) else "repeat the time of the row before"
    notes.append(f"{name}: {lost} of {len(t)} rows {what}: dropped")
    return t[late], values[late]
