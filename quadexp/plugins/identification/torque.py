"""What flights show of the torque, as three things that are not each other.

    w_x' = g_x t_x + o_x - d_x S w_x + f_x S v_y      t: torque of the rotors by the vehicle file's arms (N m), late as
    w_y' = g_y t_y + o_y - d_y S w_y + f_y S v_x         the thrust curve is; S: sum of the rotor speeds over its mean
    w_z' = g_z t_z + o_z - d_z S w_z                  11 constants: gain, offset, damping, flapping

gain      by regression of w' between 1 and 15 Hz, with damping and flapping as columns: beside 1/J, which it is where
          the vehicle file is right. Printed per newton of one rotor: times arm, or torque coefficient about z.
          (Damping and flapping are printed of the regression from 0 Hz on: the velocity changes slowly)
torque    RMS of w' - w'_model below 15 Hz on flights left out, the constants by equation error; none: rates held
replay    the constants by output error: rollouts of HORIZON from measured rates, linear in (g, o, f) for a given d,
          Huber's loss, one search over d. The loop that flew hides the gain from this fit, a fifth of the true one is
          common: it predicts flights of this loop and is never stored, no controller or plant can have it. Blind: the
          same without t. Where the motors do not beat blind, the log does not show the torque

The gain is too small where disturbances rather than the path move the commands, because the loop answers them within
the filters' reach: a simulated flight on a smooth path with five times the usual motor noise gives 0.82 of the true
gain. Its interval does not contain that.

Every fit is scored on flights left out, of one flight on its other half.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError, UsageError
from quadexp.experiment.vehicle_of import own_vehicle
from quadexp.models.regression import half_width, regress
from quadexp.parts.options import Folders
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.identification.identify import read_recorded
from quadexp.plugins.identification.thrust_curve import CurveSettings, ThrustCurve, fit_thrust_samples
from quadexp.plugins.logs.samples import QUATERNION, FlightRows, gather_to_fit, read_rows
from quadexp.report.table import Table

LOW, HIGH = 1.0, 15.0  # Hz
EDGE = 0.4  # s, where the filters settle
HORIZON, STRIDE = 0.5, 0.1  # s: of a rollout of the fit, and between their starts
DAMPING = (-2.0, 25.0)  # 1/s, searched
HUBER = 1.345
HORIZONS = (0.1, 0.5, 1.0)  # s
LEAST = 6.0  # s of a stretch
BETTER = 0.95  # of another error: what is worth naming
AXES = ("roll", "pitch", "yaw")
OTHER = (1, 0, None)  # axis of the velocity that makes the blades flap
DOES_NOT_SHOW = "this log does not show the torque"


class Turning(NamedTuple):
    """A stretch of a flight without gaps. rate: (k, 3), rad/s. attitude: k of them. Of the interval from each sample to
    the next: torque (k - 1, 3) N m, spin (k - 1,) S, velocity (k - 1, 3) body m/s. flight: its number. dt: s."""

    rate: np.ndarray
    attitude: Rotation
    torque: np.ndarray
    spin: np.ndarray
    velocity: np.ndarray
    flight: int
    dt: float

    @property
    def acceleration(self) -> np.ndarray:
        """w', (k - 1, 3), rad/s^2."""
        return np.diff(self.rate, axis=0) / self.dt

    def columns(self, axis: int, *, motors: bool = True) -> np.ndarray:
        """Torque (with motors), one and flapping, (k - 1, p)."""
        parts = [self.torque[:, axis]] if motors else []
        parts.append(np.ones(len(self.spin)))
        other = OTHER[axis]
        if other is not None:
            parts.append(self.spin * self.velocity[:, other])
        return np.column_stack(parts)

    def damped(self, axis: int) -> np.ndarray:
        """-S w, (k - 1,)."""
        return -self.spin * (self.rate[:-1, axis] + self.rate[1:, axis]) / 2

    def part(self, first: int, last: int) -> Turning:
        """Samples first .. last - 1."""
        inner = slice(first, last - 1)
        rows = {name: getattr(self, name)[inner] for name in ("torque", "spin", "velocity")}
        return self._replace(rate=self.rate[first:last], attitude=self.attitude[first:last], **rows)


class AxisModel(NamedTuple):
    """w' = columns @ theta - damping S w. motors: whether the first column is the torque."""

    theta: np.ndarray
    damping: float
    motors: bool


def turnings(rows: FlightRows, curve: ThrustCurve, vehicle: Vehicle, flight: int, mean_speed: float) -> list[Turning]:
    """The stretches of a flight that are long enough. mean_speed: sum of the rotor speeds that S is relative to."""
    samples = rows.samples
    rotors = curve.of_signal(samples.signal, samples.voltage)
    ahead = samples.during(rotors)
    mean = ahead[:-1] if samples.held.all() and not curve.lag else (ahead[:-1] + ahead[1:]) / 2
    spin = _speed(mean) / mean_speed
    velocity = (samples.velocity[:-1] + samples.velocity[1:]) / 2
    attitude = Rotation.from_quat(rows.flight.stack(QUATERNION)[rows.first :], scalar_first=True)
    torque = vehicle.mass * mean @ vehicle.allocation[1:].T
    whole = Turning(rows.rate, attitude, torque, spin, velocity, flight, rows.dt)
    breaks = (np.diff(samples.time) > 1.5 * rows.dt) | (np.diff(samples.segment) != 0)
    ends = [0, *(np.flatnonzero(breaks) + 1), len(samples)]
    pairs = zip(ends[:-1], ends[1:], strict=True)
    return [whole.part(first, last) for first, last in pairs if (last - first) * rows.dt > LEAST]


def _speed(rotors: np.ndarray) -> np.ndarray:
    """Sum of the rotor speeds, each the root of its thrust, (k,)."""
    return np.sqrt(np.maximum(rotors, 0.0)).sum(axis=1)


def band(values: np.ndarray, dt: float, low: float) -> np.ndarray:
    """Values (k, m) from `low` to HIGH Hz without phase, their mean removed where low is 0; without the edges."""
    high = min(HIGH, 0.4 / dt)
    passed = sosfiltfilt(butter(4, high, fs=1 / dt, output="sos"), values, axis=0)
    slow = sosfiltfilt(butter(4, low, fs=1 / dt, output="sos"), values, axis=0) if low else values.mean(axis=0)
    edge = round(EDGE / dt)
    return (passed - slow)[edge:-edge]


def equation_error(data: Sequence[Turning], axis: int, low: float) -> tuple[AxisModel, float]:
    """The constants by regression of w' above `low` Hz, and the half width of the gain's 95 % interval."""
    design, target, stretch, flight = [], [], [], []
    for number, turning in enumerate(data):
        columns = np.delete(turning.columns(axis), 1, axis=1)  # the offset is the mean
        columns = np.column_stack([columns, turning.damped(axis), turning.acceleration[:, axis]])
        passed = band(columns, turning.dt, low)
        design.append(passed[:, :-1])
        target.append(passed[:, -1])
        stretch.append(np.full(len(passed), number))
        flight.append(np.full(len(passed), turning.flight))
    names = ["torque", *(["flapping"] if OTHER[axis] is not None else []), "damping"]
    fit = regress(
        np.concatenate(design), np.concatenate(target), names, np.concatenate(stretch), np.concatenate(flight),
        what=f"torque about {AXES[axis]}",
    )  # fmt: skip
    theta, damping = np.insert(fit.coefficients[:-1], 1, 0.0), float(fit.coefficients[-1])
    model = AxisModel(theta, damping, motors=True)
    theta[1] = np.concatenate(
        [turning.acceleration[:, axis] - predicted(turning, axis, model) for turning in data]
    ).mean()
    return model, float(half_width(fit.errors[0], fit.freedom))


def predicted(turning: Turning, axis: int, model: AxisModel) -> np.ndarray:
    """w' of an axis at the measured rates, (k - 1,)."""
    return turning.columns(axis, motors=model.motors) @ model.theta + model.damping * turning.damped(axis)


def output_error(data: Sequence[Turning], axis: int, *, motors: bool) -> AxisModel:
    """The constants that leave least of rollouts over HORIZON."""

    def solved(damping: float) -> tuple[float, np.ndarray]:
        parts = [_rollouts(turning, axis, damping, motors) for turning in data]
        design, target = (np.concatenate(each) for each in zip(*parts, strict=True))
        weight = np.ones(len(target))
        for _ in range(4):
            theta = np.linalg.lstsq(design * weight[:, None], target * weight, rcond=None)[0]
            error = np.abs(target - design @ theta)
            limit = HUBER * 1.4826 * float(np.median(error))
            weight = np.sqrt(np.minimum(1.0, limit / np.maximum(error, 1e-12)))
        return float(np.where(error < limit, error**2 / 2, limit * (error - limit / 2)).mean()), theta

    best = minimize_scalar(lambda damping: solved(damping)[0], bounds=DAMPING, method="bounded", options={"xatol": 0.1})
    return AxisModel(solved(best.x)[1], float(best.x), motors)


def _rollouts(turning: Turning, axis: int, damping: float, motors: bool) -> tuple[np.ndarray, np.ndarray]:
    """Design (n, p) and target (n,) of all samples of all rollouts, weighted as their errors grow with time."""
    h, steps = turning.dt, round(HORIZON / turning.dt)
    starts = np.arange(0, len(turning.spin) - steps, max(1, round(STRIDE / h)))
    columns, rate = turning.columns(axis, motors=motors), turning.rate[:, axis]
    response, free = np.zeros((len(starts), columns.shape[1])), rate[starts]
    design, target = [], []
    for step in range(steps):
        at = starts + step
        kept = 1 - h * damping * turning.spin[at]
        response = kept[:, None] * response + h * columns[at]
        free = kept * free
        weight = 1 / np.sqrt(1.0 + step)
        design.append(weight * response)
        target.append(weight * (rate[at + 1] - free))
    return np.concatenate(design), np.concatenate(target)


def attitude_errors(turning: Turning, models: Sequence[AxisModel] | None) -> np.ndarray:
    """Angles between predicted and measured attitude at HORIZONS, (3, starts) (rad). models: of the axes; None: rates
    held. The velocity is measured."""
    h = turning.dt
    ends = [max(1, round(horizon / h)) for horizon in HORIZONS]
    starts = np.arange(0, len(turning.spin) - ends[-1], max(1, round(STRIDE / h)))
    columns = [turning.columns(axis, motors=models[axis].motors) for axis in range(3)] if models else []
    rate, attitude = turning.rate[starts], turning.attitude[starts]
    errors = []
    for step in range(ends[-1]):
        at, change = starts + step, np.zeros_like(rate)
        for axis, model in enumerate(models or ()):
            change[:, axis] = columns[axis][at] @ model.theta - model.damping * turning.spin[at] * rate[:, axis]
        attitude = attitude * Rotation.from_rotvec(h * (rate + h * change / 2))
        rate = rate + h * change
        if step + 1 in ends:
            errors.append((turning.attitude[at + 1].inv() * attitude).magnitude())
    return np.array(errors)


def identify_torque(paths: Sequence[Path], vehicle: Vehicle | None, conf: Folders = None) -> dict[str, Any]:
    """{"axes": gain and errors of each axis, "rollouts": of each model, "shown": whether the flights show the torque,
    "lines"}. vehicle: None: that recorded in the flights.

    Raises DataError where a signal of every rotor is missing or the flights are too short, UsageError where the
    vehicle is not known."""
    if not paths:
        raise UsageError("identify: no flight given")
    flights, names = [read_recorded(path) for path in paths], [str(path) for path in paths]
    vehicle = vehicle or own_vehicle(flights[0], conf)
    if vehicle is None:
        raise UsageError(f"{paths[0]}: its vehicle is not known here, whose arms torque needs; name it: --vehicle NAME")
    samples = gather_to_fit(flights, None, names)
    if samples.signal.shape[1] != vehicle.n_rotors:
        raise DataError(
            f"{paths[0]}: has {samples.kind}, the torque needs a signal of each of {vehicle.n_rotors} rotors"
        )
    curve = fit_thrust_samples(samples, CurveSettings(), intervals=False)[0]
    mean_speed = float(_speed(curve.of_signal(samples.signal, samples.voltage)).mean())
    data: list[Turning] = []
    for number, (flight, name) in enumerate(zip(flights, names, strict=True)):
        rows = read_rows(flight, name, curve.signal, curve.delay, curve.lag)
        data += turnings(rows, curve, vehicle, number, mean_speed)
    if not data:
        raise DataError(f"{paths[0]}: no stretch without a gap takes {LEAST:g} s")
    return judged(data, vehicle) | {"thrust": str(curve), "vehicle": vehicle.name}


def judged(data: Sequence[Turning], vehicle: Vehicle) -> dict[str, Any]:
    """See `identify_torque`."""
    arms = np.abs(vehicle.allocation[1:]).mean(axis=1)
    inverse = 1 / np.diag(vehicle.inertia_matrix)
    axes: list[dict[str, Any]] = []
    for axis, name in enumerate(AXES):
        model, half = equation_error(data, axis, LOW)
        gain, by_file = arms[axis] * model.theta[0], arms[axis] * inverse[axis]
        whole = equation_error(data, axis, 0.0)[0]  # flapping follows the velocity, which changes below 1 Hz
        row = {"axis": name, "gain": float(gain), "half": float(arms[axis] * half), "vehicle_file": float(by_file)}
        flapping = None if OTHER[axis] is None else float(whole.theta[2])
        axes.append(row | {"damping": whole.damping, "flapping": flapping})
    held, left = np.zeros((2, 3)), 0
    angles: dict[str, list[np.ndarray]] = {"rates held": [], "blind to the motors": [], "replay model": []}
    for fitted, tested in _folds(data):
        regressions = [equation_error(fitted, axis, 0.0)[0] for axis in range(3)]
        blind = [output_error(fitted, axis, motors=False) for axis in range(3)]
        replay = [output_error(fitted, axis, motors=True) for axis in range(3)]
        for turning in tested:
            for axis, model in enumerate(regressions):
                both = np.column_stack([turning.acceleration[:, axis], predicted(turning, axis, model)])
                target, guess = band(both, turning.dt, 0.0).T
                held[:, axis] += np.sum(target**2), np.sum((target - guess) ** 2)
            left += len(target)
            for name, models in zip(angles, (None, blind, replay), strict=True):
                angles[name].append(attitude_errors(turning, models))
    for axis, row in enumerate(axes):
        row["held_rms"], row["model_rms"] = np.sqrt(held[:, axis] / left).tolist()
    rollouts = {name: np.concatenate(each, axis=1).mean(axis=1).tolist() for name, each in angles.items()}
    explained = any(row["model_rms"] < BETTER * row["held_rms"] for row in axes[:2])
    beats_blind = rollouts["replay model"][1] < BETTER * rollouts["blind to the motors"][1]
    report = {"axes": axes, "rollouts": rollouts, "shown": explained and beats_blind}
    return report | {"lines": torque_lines(report)}


def _folds(data: Sequence[Turning]) -> list[tuple[list[Turning], list[Turning]]]:
    """Fitted and tested: each flight left out once; of one flight each half."""
    numbers = sorted({turning.flight for turning in data})
    if len(numbers) == 1:
        middles = [len(turning.rate) // 2 for turning in data]
        first = [turning.part(0, middle) for turning, middle in zip(data, middles, strict=True)]
        second = [turning.part(middle, len(turning.rate)) for turning, middle in zip(data, middles, strict=True)]
        return [(first, second), (second, first)]
    folds = []
    for number in numbers:
        fitted = [turning for turning in data if turning.flight != number]
        folds.append((fitted, [turning for turning in data if turning.flight == number]))
    return folds


def torque_lines(report: dict[str, Any]) -> list[str]:
    """The three things, in words."""
    gains, errors = [], []
    for row in report["axes"]:
        ratio = row["gain"] / row["vehicle_file"]
        numbers = [f"{row['gain']:.4g} +- {row['half']:.2g}", f"{row['vehicle_file']:.4g}", f"{ratio:.2f}"]
        flapping = "" if row["flapping"] is None else f"{row['flapping']:.3g}"
        gains.append([row["axis"], *numbers, f"{row['damping']:.3g}", flapping])
        share = 100 * (row["model_rms"] / row["held_rms"] - 1)
        errors.append([row["axis"], f"{row['held_rms']:.3g}", f"{row['model_rms']:.3g}", f"{share:+.0f} %"])
    rolled = [[name, *(f"{angle:.3f}" for angle in angles)] for name, angles in report["rollouts"].items()]
    heads = ["axis", "flights", "arm c / J of the file", "ratio", "damping (1/s)", "flapping (rad/(m s))"]
    lines = Table(heads, gains, "gain, rad/s^2 per N of one rotor, 1 to 15 Hz, 95 % interval").lines()
    title = "torque on flights left out, RMS below 15 Hz (rad/s^2): none (rates held) and by equation error"
    lines += Table(["axis", "rates held", "equation error", ""], errors, title).lines()
    title = (
        "attitude (rad) on flights left out, predicted from measured rates; for rollouts only, never a plant's torque"
    )
    lines += Table(["", *(f"{horizon:g} s" for horizon in HORIZONS)], rolled, title).lines()
    if not report["shown"]:
        lines.append(f"{DOES_NOT_SHOW}: rotor commands predict its turning no better than without them")
    return lines
