"""The gain of the rotors' torque, and an interval that holds what the estimate rests on.

    w_{k+1} - w_k = h (g t_k + o - d S w_k + f S v_k) + e_k,      e_k = r e_{k-1} + white noise        (one axis)

Prediction error (Ljung 1999, System Identification, section 13.4): in a loop, a regression is free of bias where its
errors are white and t_k was sent before e_k. So the columns are not filtered but by 1 - r q^-1, with r of the errors
themselves. A band of 1 to 15 Hz is not causal: within it the loop's answer to a disturbance looks like its cause (0.72
of the true gain on random paths with ten times the usual torque noise, 4 times on a smooth path under an MPC).

What a log does not say moves the gain by more than its scatter: when the torque acts (the thrust's dead time and lag,
or those that leave least of the turning itself, which a loop draws to shorter ones), and the slope of the thrust curve
at the commands flown (c_1 s + c_2 s^2, or the curve that the thrust prefers). Half the interval is the largest
departure of all of them, and of the mean of three flights or more, plus the largest half of their own intervals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import product
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.models.base import Record, Three
from quadexp.models.regression import LEAST_FLIGHTS, half_width
from quadexp.plugins.identification.turning import AXES, Turning, regressed

DEAD_TIMES = (0.0, 0.01, 0.02, 0.03, 0.045, 0.06)  # s, tried for the turning
LAGS = (0.0, 0.02, 0.04, 0.06, 0.08, 0.12)  # s
ROUNDS = 3  # of r
MOST_SECONDS = 120.0  # of flights that the search for a timing uses
KNOWN = 0.25  # of the gain: half an interval with which a plant takes it
Builder = Callable[[float, float, bool], list[Turning]]  # dead time, lag (s), c_1 s + c_2 s^2 -> turnings


class Gain(NamedTuple):
    """value, low, high: rad/s^2 per N m, 95 % interval."""

    value: float
    low: float
    high: float


class TorqueGain(Record, frozen=True):
    """Torque about each axis over that of the vehicle file's arms and inertia, with its 95 % interval.

    of_commands: of a log of motor commands, whose yaw is not that of a drag coefficient: it is the rotors' own inertia
    that turns the vehicle first, and 0.08 of the drag's torque was read where the truth is 1.
    """

    ratio: Three
    low: Three
    high: Three
    of_commands: bool = False

    @property
    def is_known(self) -> np.ndarray:
        """Whether the flights show it to KNOWN, (3,)."""
        told = np.array([True, True, not self.of_commands])
        return told & (self.ratio > 0) & (self.high - self.low < 2 * KNOWN * self.ratio)

    @property
    def used(self) -> list[float | None]:
        """What a plant or a controller takes of each axis; None: the vehicle file's, where flights do not show it."""
        return [float(ratio) if known else None for ratio, known in zip(self.ratio, self.is_known, strict=True)]

    def record(self) -> list[dict[str, Any]]:
        """JSON types, a row an axis."""
        rows = []
        for i, axis in enumerate(AXES):
            rows.append({
                "axis": axis,
                "ratio": float(self.ratio[i]),
                "low": float(self.low[i]),
                "high": float(self.high[i]),
                "used": bool(self.is_known[i]),
            })  # fmt: skip
        return rows

    def __str__(self) -> str:
        parts = []
        for row in self.record():
            text = f"{row['axis']} {row['ratio']:.3g} [{row['low']:.3g}, {row['high']:.3g}]"
            if not row["used"]:
                by_commands = row["axis"] == "yaw" and self.of_commands
                why = "motor commands do not tell it" if by_commands else "not shown well enough"
                text += f" ({why}: the file's is used)"
            parts.append(text)
        return f"over that of the vehicle file's arms and inertia (arm c / J), 95 %: {', '.join(parts)}"


def prediction_error(data: Sequence[Turning], axis: int, *, intervals: bool = True) -> tuple[float, float, float]:
    """Gain, half its 95 % interval, and the mean square of what is left. intervals: see `regress`."""
    parts = []
    for turning in data:
        # The rate at the beginning of an interval: that of its middle holds part of e_k.
        damped = -turning.spin * turning.rate[:-1, axis]
        parts.append(np.column_stack([turning.columns(axis), damped, turning.acceleration[:, axis]]))
    correlation = 0.0
    for number in range(ROUNDS):
        white = [part[1:] - correlation * part[:-1] for part in parts]
        fit = regressed(data, axis, white, intervals=intervals and number == ROUNDS - 1)
        errors = [part[:, -1] - part[:, :-1] @ fit.coefficients for part in parts]
        power = sum(error[:-1] @ error[:-1] for error in errors)
        product = sum(error[1:] @ error[:-1] for error in errors)
        correlation = float(np.clip(product / power, -0.95, 0.95))
    half = half_width(fit.errors[0], fit.freedom)
    return float(fit.coefficients[0]), float(half), float(np.mean(fit.residual**2))


def own_timing(build: Builder) -> tuple[float, float]:
    """Dead time and lag (s) that leave least of roll and pitch."""

    def left(timing: tuple[float, float]) -> float:
        data = []
        seconds = 0.0
        for turning in build(*timing, False):
            if seconds < MOST_SECONDS:
                data.append(turning)
            seconds += len(turning.rate) * turning.dt
        return sum(float(np.log(prediction_error(data, axis, intervals=False)[2])) for axis in range(2))

    return min(product(DEAD_TIMES, LAGS), key=left)


def gains(variants: Sequence[Sequence[Turning]]) -> list[Gain]:
    """Of each axis. variants: turnings under one timing and curve each, the first that of the thrust."""
    every_gain = []
    for axis in range(3):
        pairs = [prediction_error(data, axis)[:2] for data in variants]
        value, _ = pairs[0]
        pairs += _between(variants[0], axis)
        furthest = max(abs(gain - value) for gain, _ in pairs)
        half = furthest + max(half for _, half in pairs)
        every_gain.append(Gain(value, value - half, value + half))
    return every_gain


def _between(data: Sequence[Turning], axis: int) -> list[tuple[float, float]]:
    """Mean over flights and half its interval; [] of too few."""
    each = []
    for number in {turning.flight for turning in data}:
        of_flight = [turning for turning in data if turning.flight == number]
        with suppress(DataError):  # too short alone
            each.append(prediction_error(of_flight, axis, intervals=False)[0])
    if len(each) < LEAST_FLIGHTS:
        return []
    error = np.std(each, ddof=1) / np.sqrt(len(each))
    return [(float(np.mean(each)), float(half_width(error, len(each) - 1)))]
