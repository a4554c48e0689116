"""What flights show of the torque, as three things that are not each other.

    w_x' = g_x t_x + o_x - d_x S w_x + f_x S v_y      t: torque of the rotors by the vehicle file's arms (N m), late as
    w_y' = g_y t_y + o_y - d_y S w_y + f_y S v_x         the thrust curve is; S: sum of the rotor speeds over its mean
    w_z' = g_z t_z + o_z - d_z S w_z                  11 constants: gain, offset, damping, flapping

gain      by prediction error with damping and flapping as columns (torque_gain.py), beside 1/J, which it is where the
          vehicle file is right, and beside that of a regression of w' between 1 and 15 Hz. Printed per newton of one
          rotor: times arm, or torque coefficient about z. `quadexp identify` keeps it in its model: plants and
          controllers that take the model turn by it. (Damping and flapping are printed of the regression from 0 Hz on:
          the velocity changes slowly)
torque    RMS of w' - w'_model below 15 Hz on flights left out, the constants by equation error; none: rates held
replay    the constants by output error: rollouts of HORIZON from measured rates, linear in (g, o, f) for a given d,
          Huber's loss, one search over d. The loop that flew hides the gain from this fit, a fifth of the true one is
          common: it predicts flights of this loop and is never stored, no controller or plant can have it. Blind: the
          same without t. Where the motors do not beat blind, the log does not show the torque

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
from scipy.special import huber

from quadexp.errors import DataError, UsageError
from quadexp.log.schema import Flight
from quadexp.models.regression import HUBER, MAD_TO_STD, half_width
from quadexp.parts.options import Folders
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.identification.recorded import read_recorded
from quadexp.plugins.identification.thrust_curve import CurveSettings, ThrustCurve, fit_thrust_samples
from quadexp.plugins.identification.torque_gain import TorqueGain, gains, own_timing
from quadexp.plugins.identification.turning import AXES, LEAST, OTHER, Turning, regressed, speed_of, turnings
from quadexp.plugins.logs.samples import COMMANDS, Samples, gather_to_fit, read_rows
from quadexp.plugins.logs.vehicle_of import own_vehicle
from quadexp.report.pairing import grouped
from quadexp.report.table import Table

LOW = 1.0  # Hz
HIGH = 15.0  # Hz
EDGE = 0.4  # s, where the filters settle
HORIZON = 0.5  # s, of a rollout of the fit
DAMPING = (-2.0, 25.0)  # 1/s, searched
REWEIGHTINGS = 4  # of Huber's loss
HORIZONS = (0.1, 0.5, 1.0)  # s
BETTER = 0.95  # of another error: what is worth naming
NO_YAW = "yaw: no number to use: motor commands do not tell what the rotors' own inertia turns besides"
DOES_NOT_SHOW = "this log does not show the torque"


class AxisModel(NamedTuple):
    """w' = columns @ theta - damping S w. motors: whether the first column is the torque."""

    theta: np.ndarray
    damping: float
    motors: bool

    def acceleration(self, columns: np.ndarray, spin: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """w', (n,), of columns (n, p), S (n,) and w (n,)."""
        return columns @ self.theta - self.damping * spin * rate


def band(values: np.ndarray, dt: float, low: float) -> np.ndarray:
    """Values (k, m) from `low` to HIGH Hz without phase, their mean removed where low is 0; without the edges."""
    high = min(HIGH, 0.4 / dt)
    passed = sosfiltfilt(butter(4, high, fs=1 / dt, output="sos"), values, axis=0)
    slow = values.mean(axis=0)
    if low:
        slow = sosfiltfilt(butter(4, low, fs=1 / dt, output="sos"), values, axis=0)
    edge = round(EDGE / dt)
    return (passed - slow)[edge:-edge]


def equation_error(data: Sequence[Turning], axis: int, low: float) -> tuple[AxisModel, float]:
    """The constants by regression of w' above `low` Hz, and the half width of the gain's 95 % interval."""
    parts = []
    for turning in data:
        columns = np.delete(turning.columns(axis), 1, axis=1)  # the offset is the mean
        columns = np.column_stack([columns, turning.damped(axis), turning.acceleration[:, axis]])
        parts.append(band(columns, turning.dt, low))
    fit = regressed(data, axis, parts, offset=False)
    *slopes, damping = fit.coefficients.tolist()
    model = AxisModel(np.insert(slopes, 1, 0.0), damping, motors=True)
    remaining = [turning.acceleration[:, axis] - predicted(turning, axis, model) for turning in data]
    model.theta[1] = np.concatenate(remaining).mean()
    return model, float(half_width(fit.errors[0], fit.freedom))


def predicted(turning: Turning, axis: int, model: AxisModel) -> np.ndarray:
    """w' of an axis at the measured rates, (k - 1,)."""
    return turning.columns(axis, motors=model.motors) @ model.theta + model.damping * turning.damped(axis)


def output_error(data: Sequence[Turning], axis: int, *, motors: bool) -> AxisModel:
    """The constants that leave least of rollouts over HORIZON."""

    def solved(damping: float) -> tuple[float, np.ndarray]:
        """Huber's loss, by reweighting, and theta."""
        rollouts = [_rollouts(turning, axis, damping, motors) for turning in data]
        design = np.concatenate([columns for columns, _ in rollouts])
        target = np.concatenate([change for _, change in rollouts])
        weight = np.ones(len(target))
        for _ in range(REWEIGHTINGS):
            theta = np.linalg.lstsq(design * weight[:, None], target * weight, rcond=None)[0]
            error = np.abs(target - design @ theta)
            limit = HUBER * MAD_TO_STD * float(np.median(error))
            weight = np.sqrt(np.minimum(1.0, limit / np.maximum(error, 1e-12)))
        return float(huber(limit, error).mean()), theta

    best = minimize_scalar(lambda damping: solved(damping)[0], bounds=DAMPING, method="bounded", options={"xatol": 0.1})
    return AxisModel(solved(best.x)[1], float(best.x), motors)


def _rollouts(turning: Turning, axis: int, damping: float, motors: bool) -> tuple[np.ndarray, np.ndarray]:
    """Design (n, p) and target (n,) of all samples of all rollouts, weighted as their errors grow with time."""
    h = turning.dt
    steps = round(HORIZON / h)
    starts = turning.starts(steps)
    columns = turning.columns(axis, motors=motors)
    rate = turning.rate[:, axis]
    response = np.zeros((len(starts), columns.shape[1]))  # of the rate to theta
    free = rate[starts]  # without it
    design = []
    target = []
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
    starts = turning.starts(ends[-1])
    columns = [turning.columns(axis, motors=model.motors) for axis, model in enumerate(models or ())]
    rate = turning.rate[starts]
    attitude = turning.attitude[starts]
    errors = []
    for step in range(ends[-1]):
        at = starts + step
        change = np.zeros_like(rate)
        for axis, model in enumerate(models or ()):
            change[:, axis] = model.acceleration(columns[axis][at], turning.spin[at], rate[:, axis])
        attitude = attitude * Rotation.from_rotvec(h * (rate + h * change / 2))
        rate = rate + h * change
        if step + 1 in ends:
            errors.append((turning.attitude[at + 1].inv() * attitude).magnitude())
    return np.array(errors)


class TorqueData(NamedTuple):
    """Of flights of one vehicle. curve: of the thrust. variants: see torque_gain.gains; the first is what the rest of
    this module uses."""

    curve: ThrustCurve
    variants: list[list[Turning]]

    @property
    def turnings(self) -> list[Turning]:
        return self.variants[0]


def torque_data(
    flights: Sequence[Flight],
    names: Sequence[str],
    vehicle: Vehicle,
    samples: Samples,
    curve: ThrustCurve | None = None,
    *,
    variants: bool = True,
) -> TorqueData:
    """samples: of all flights. curve: of their thrust, None: fitted here. variants: False for the first only.

    Raises DataError where a signal of every rotor is missing or the flights are too short."""
    if samples.signal.shape[1] != vehicle.n_rotors:
        raise DataError(
            f"{names[0]}: has {samples.kind}, the torque needs a signal of each of {vehicle.n_rotors} rotors"
        )
    first = curve or fit_thrust_samples(samples, CurveSettings(), intervals=False)[0]
    other = CurveSettings(first.reference_voltage, first.voltage_exponent, (2,) if len(first.powers) > 1 else (1, 2))
    curves = [first, fit_thrust_samples(samples, other, intervals=False)[0]]

    def build(dead_time: float, lag: float, another_curve: bool) -> list[Turning]:
        used = curves[another_curve]
        data = list[Turning]()
        mean_speed = float(speed_of(used.of_signal(samples.signal, samples.voltage)).mean())
        for number, (flight, name) in enumerate(zip(flights, names, strict=True)):
            rows = read_rows(flight, name, used.signal, dead_time, lag)
            data += turnings(rows, used, vehicle, number, mean_speed)
        return data

    usual = build(first.delay, first.lag, False)
    if not usual:
        raise DataError(f"{names[0]}: no stretch without a gap takes {LEAST:g} s")
    if not variants:
        return TorqueData(first, [usual])
    timings = [(first.delay, first.lag)]
    if samples.kind in COMMANDS:
        timings.append(own_timing(build))
    every = []
    for dead_time, lag in timings:
        every += [build(dead_time, lag, False), build(dead_time, lag, True)]
    return TorqueData(first, every)


def identify_torque(paths: Sequence[Path], vehicle: Vehicle | None, conf: Folders = None) -> dict[str, Any]:
    """{"axes": gain and errors of each axis, "rollouts": of each model, "shown": whether the flights show the torque,
    "rows", "lines"}. vehicle: None: that recorded in the flights.

    Raises DataError where a signal of every rotor is missing or the flights are too short, UsageError where the
    vehicle is not known."""
    if not paths:
        raise UsageError("identify: no flight given")
    flights = [read_recorded(path) for path in paths]
    names = [str(path) for path in paths]
    vehicle = vehicle or own_vehicle(flights[0], conf)
    if vehicle is None:
        raise UsageError(f"{paths[0]}: its vehicle is not known here, whose arms torque needs; name it: --vehicle NAME")
    data = torque_data(flights, names, vehicle, gather_to_fit(flights, None, names))
    report = judged(data, vehicle) | {"thrust": str(data.curve), "vehicle": vehicle.name}
    report["rows"] = report["axes"]
    if data.curve.signal == "motor_command":
        report["lines"].append(NO_YAW)
    return report


def torque_gain(data: TorqueData, vehicle: Vehicle) -> TorqueGain:
    """Beside the vehicle file, for a model that is stored."""
    inertia = np.diag(vehicle.inertia_matrix)
    ratio, low, high = np.array(gains(data.variants)).T * inertia
    return TorqueGain(ratio, low, high, data.curve.signal == "motor_command")


def judged(torque: TorqueData, vehicle: Vehicle) -> dict[str, Any]:
    """See `identify_torque`."""
    data = torque.turnings
    arms = np.abs(vehicle.allocation[1:]).mean(axis=1)
    inertia = np.diag(vehicle.inertia_matrix)
    held_rms, model_rms = torque_errors(data)
    axes = []
    for axis, gain in enumerate(gains(torque.variants)):
        arm = float(arms[axis])
        in_band, _ = equation_error(data, axis, LOW)
        whole, _ = equation_error(data, axis, 0.0)  # flapping follows the velocity, which changes below 1 Hz
        axes.append({
            "axis": AXES[axis],
            "gain": arm * gain.value,
            "low": arm * gain.low,
            "high": arm * gain.high,
            "in_band": arm * float(in_band.theta[0]),
            "vehicle_file": arm / float(inertia[axis]),
            "damping": whole.damping,
            "flapping": None if OTHER[axis] is None else float(whole.theta[2]),
            "held_rms": float(held_rms[axis]),
            "model_rms": float(model_rms[axis]),
        })  # fmt: skip
    rollouts = replayed(data)
    explained = (model_rms < BETTER * held_rms)[:2].any()
    report = {"axes": axes, "rollouts": rollouts, "shown": bool(explained and beats_blind(rollouts))}
    return report | {"lines": torque_lines(report)}


def torque_errors(data: Sequence[Turning]) -> tuple[np.ndarray, np.ndarray]:
    """RMS below HIGH Hz on flights left out, (3,) each (rad/s^2): of w', and of what equation error leaves of it."""
    held = []
    remaining = []
    for fitted, tested in folds(data):
        models = [equation_error(fitted, axis, 0.0)[0] for axis in range(3)]
        for turning in tested:
            guess = np.column_stack([predicted(turning, axis, model) for axis, model in enumerate(models)])
            target = band(turning.acceleration, turning.dt, 0.0)
            held.append(target)
            remaining.append(target - band(guess, turning.dt, 0.0))
    return _rms_of_axes(held), _rms_of_axes(remaining)


def _rms_of_axes(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0))


HELD = "rates held"
BLIND = "blind to the motors"
REPLAY = "replay model"


def replayed(data: Sequence[Turning]) -> dict[str, list[float]]:
    """Mean attitude error (rad) at HORIZONS on flights left out, of rates held, blind and the replay model."""
    angles = []
    for fitted, tested in folds(data):
        blind = [output_error(fitted, axis, motors=False) for axis in range(3)]
        replay = [output_error(fitted, axis, motors=True) for axis in range(3)]
        for turning in tested:
            angles.append((HELD, attitude_errors(turning, None)))
            angles.append((BLIND, attitude_errors(turning, blind)))
            angles.append((REPLAY, attitude_errors(turning, replay)))
    return {name: np.concatenate(each, axis=1).mean(axis=1).tolist() for name, each in grouped(angles).items()}


def beats_blind(rollouts: dict[str, list[float]]) -> bool:
    """Whether the motors predict the attitude of half a second better than without them."""
    return rollouts[REPLAY][1] < BETTER * rollouts[BLIND][1]


def replay_lines(rollouts: dict[str, list[float]]) -> list[str]:
    """The table of `replayed`."""
    rolled = [[name, *(f"{angle:.3f}" for angle in angles)] for name, angles in rollouts.items()]
    title = (
        "attitude (rad) on flights left out, predicted from measured rates; for rollouts only, never a plant's torque"
    )
    return Table(["", *(f"{horizon:g} s" for horizon in HORIZONS)], rolled, title).lines()


def folds(data: Sequence[Turning]) -> list[tuple[list[Turning], list[Turning]]]:
    """Fitted and tested: each flight left out once; of one flight each half."""
    numbers = sorted({turning.flight for turning in data})
    if len(numbers) == 1:
        first = [turning.part(0, len(turning.rate) // 2) for turning in data]
        second = [turning.part(len(turning.rate) // 2, len(turning.rate)) for turning in data]
        return [(first, second), (second, first)]
    folds = []
    for number in numbers:
        fitted = [turning for turning in data if turning.flight != number]
        folds.append((fitted, [turning for turning in data if turning.flight == number]))
    return folds


def torque_lines(report: dict[str, Any]) -> list[str]:
    """The three things, in words."""
    rows = []
    errors = []
    for row in report["axes"]:
        rows.append([
            row["axis"],
            f"{row['gain']:.4g}",
            f"[{row['low']:.4g}, {row['high']:.4g}]",
            f"{row['vehicle_file']:.4g}",
            f"{row['gain'] / row['vehicle_file']:.2f}",
            f"{row['in_band']:.4g}",
            f"{row['damping']:.3g}",
            "" if row["flapping"] is None else f"{row['flapping']:.3g}",
        ])  # fmt: skip
        share = 100 * (row["model_rms"] / row["held_rms"] - 1)
        errors.append([row["axis"], f"{row['held_rms']:.3g}", f"{row['model_rms']:.3g}", f"{share:+.0f} %"])
    heads = ["axis", "gain", "95 %", "arm c / J of the file", "ratio", "1 to 15 Hz", "damping (1/s)"]
    title = "gain, rad/s^2 per N of one rotor; the interval holds other timings and thrust curves"
    lines = Table([*heads, "flapping (rad/(m s))"], rows, title).lines()
    title = "torque on flights left out, RMS below 15 Hz (rad/s^2): none (rates held) and by equation error"
    lines += Table(["axis", "rates held", "equation error", ""], errors, title).lines()
    lines += replay_lines(report["rollouts"])
    if not report["shown"]:
        lines.append(f"{DOES_NOT_SHOW}: rotor commands predict its turning no better than without them")
    return lines
