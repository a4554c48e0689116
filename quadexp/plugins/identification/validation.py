"""Error of models on flights that they were not fitted to: sample by sample, and open loop from a measured state.

    e = f - f_model,       f_model = (0, 0, sum_i a_i) + a(v, w, a_1 .. a_n)        body FLU, m/s^2

RMS of the vector, sqrt(mean ||e||^2), and of each axis. Every model (predictors.py) is scored as fitted, and with its
thrust scale tracked in flight from earlier samples (recorded.py). Intervals are over flights of LEAST_FLIGHTS or more,
which differ from one another (regression.between_flights, of the RMS or the ratio of each flight, weighted as in that
of all). Of fewer they are for these flights only: percentile bootstrap over blocks of BLOCK seconds, because
neighbouring errors are correlated.

Open loop, from many starts over horizons:

attitude   v' = R(t) f_model(R(t)^T v, w(t), a(t)) + g,  p' = v        R, w and the rotors' signal as measured
held       all 13 states; constant body rates
full       all 13 states of the rigid body (quadexp.physics.rigid_body) under the rotors' thrusts and arms

In all modes the model gives the specific force. "full" needs the thrust of every rotor and uses the vehicle's inertia,
arms and reaction torques; its attitude drifts with every unmodelled torque, so "held" is the baseline for it.
"attitude" needs no torque model; it uses Heun's method on the samples. A thrust scale tracked up to the start
is held over the prediction. The accelerometer's error (bias, and gravity through its misalignment) does not act on the
motion: it is estimated as the mean of f - R^T (dv/dt + g) over a flight and subtracted from the model's prediction,
because the model was fitted to that accelerometer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from quadexp.compile.symbolic import ca
from quadexp.models.base import outside_shares, rms
from quadexp.models.dataset import feature_rows
from quadexp.models.regression import between_flights
from quadexp.models.residual import AXES
from quadexp.physics.expression import symbols
from quadexp.physics.integrator import rk4_step
from quadexp.physics.rigid_body import state_derivative
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY, norms, root_mean_square
from quadexp.physics.vehicle import GRAVITY, Vehicle
from quadexp.plugins.identification.predictors import NOMINAL, Predictor
from quadexp.plugins.identification.recorded import tracked_scale
from quadexp.plugins.logs.samples import QUATERNION, FlightRows

BLOCK = 2.0  # s, of the bootstrap
DRAWS = 1000  # resamplings of the flights for an interval
CONFIDENCE = 0.95  # of every interval, as in the tables of results
BANDS = 4  # of speed, with as many rows in a table
LEAST_OF_BAND = 20  # samples
LOST_SPEED = 100.0  # m/s: a prediction beyond it is stopped
LOST_RATE = 200.0  # rad/s, the same
TURNING = ("held", "full")
FAR = 10.0  # medians of the distances of errors from their median
STEP = 5.0  # m/s^2
STARTS = 120  # per flight at most, spread evenly
POINT = ("p_x", "p_y", "p_z")
WORLD_VELOCITY = ("v_x", "v_y", "v_z")
Row = dict[str, Any]


class OneStep(NamedTuple):
    """What a predictor has of the samples of a flight. rotors: acceleration by each rotor, (k, n) (m/s^2). unexplained:
    measured specific force less that of the air, (k, 3) (m/s^2). scale: of the thrust, tracked, (k,)."""

    rotors: np.ndarray
    unexplained: np.ndarray
    scale: np.ndarray

    def error(self, *, tracked: bool) -> np.ndarray:
        """Measured less predicted specific force, (k, 3) (m/s^2)."""
        thrust = self.rotors.sum(axis=1)
        if tracked:
            thrust = self.scale * thrust
        error = self.unexplained.copy()
        error[:, 2] -= thrust
        return error


def one_step(predictor: Predictor, row: FlightRows) -> OneStep:
    samples = row.samples
    rotors = predictor.curve.of_signal(samples.signal, samples.voltage)
    unexplained = samples.force - predictor.beyond(samples.velocity, row.rate, rotors)
    scale = tracked_scale(rotors.sum(axis=1), unexplained[:, 2], row.dt)
    return OneStep(rotors, unexplained, scale)


@dataclass(frozen=True)
class Residuals:
    """Errors of a predictor, (k, 3) m/s^2: as fitted (error), with tracked scale (tracked); others (k,)."""

    predictor: str
    error: np.ndarray
    tracked: np.ndarray
    flight: np.ndarray
    block: np.ndarray
    speed: np.ndarray
    outside: float | None


def residuals(predicted: Sequence[tuple[Predictor, FlightRows]]) -> Residuals:
    """One-step residuals of a predictor on flights, each with the predictor as it was fitted for it."""
    parts = []
    blocks = 0
    outside = 0
    rows = 0
    for index, (predictor, row) in enumerate(predicted):
        step = one_step(predictor, row)
        count = len(row.samples)
        block = blocks + (np.arange(count) * row.dt // BLOCK).astype(int)
        blocks = int(block[-1]) + 1
        parts.append((step.error(tracked=False), step.error(tracked=True), np.full(count, index), block, row.speed))
        if predictor.ranges:
            features = feature_rows(row.samples.velocity, row.rate, predictor.mass * step.rotors)
            outside += round(outside_shares(predictor.ranges, features)["any"] * count)
            rows += count
    error, tracked, flight, block, speed = map(np.concatenate, zip(*parts, strict=True))
    share = outside / rows if rows else None
    return Residuals(predicted[0][0].name, error, tracked, flight, block, speed, share)


def score_rows(results: Sequence[Residuals]) -> list[Row]:
    """Per predictor one row as fitted and one tracked: RMS per axis and of the vector, with interval.

    share: ratio to the nominal RMS as fitted. share_alike: ratio to the nominal RMS, tracked if this row is. Both with
    the interval of the ratio over the same resamples.
    """
    base = next((result for result in results if result.predictor == NOMINAL), None)
    rows = []
    for result in results:
        for tracked in (False, True):
            error = result.tracked if tracked else result.error
            row: Row = {"predictor": result.predictor, "thrust_tracked": tracked, "rows": len(error)}
            for axis, component in zip(AXES, error.T, strict=True):
                row[f"rms_{axis}"] = rms(component)
            row["rms"] = rms(error)
            row |= _interval("rms", result, error)
            row["outside"] = result.outside
            if base is not None and len(base.error) == len(error):
                alike = base.tracked if tracked else base.error
                for name, other in (("share", base.error), ("share_alike", alike)):
                    row[name] = rms(error) / rms(other)
                    row |= _interval(name, result, error, other)
            rows.append(row)
    return rows


def _interval(name: str, result: Residuals, error: np.ndarray, base: np.ndarray | None = None) -> dict[str, float]:
    """{name_low, name_high}: of the RMS of errors (k, 3) of a result's samples, or of its ratio to that of others."""
    squares = np.sum(error**2, axis=1)
    others = np.ones(len(error)) if base is None else np.sum(base**2, axis=1)
    above = np.maximum(np.bincount(result.flight, squares), 1e-24)
    below = np.maximum(np.bincount(result.flight, others), 1e-24)
    half = between_flights(0.5 * np.log(above / below), below, CONFIDENCE)
    if np.isnan(half):
        above = np.bincount(result.block, squares)
        below = np.bincount(result.block, others)
        count = len(above)
        weights = np.random.default_rng(0).multinomial(count, np.full(count, 1 / count), DRAWS)
        ratios = np.sqrt((weights @ above) / (weights @ below))
        low, high = np.percentile(ratios, [50 * (1 - CONFIDENCE), 50 * (1 + CONFIDENCE)]).tolist()
    else:
        ratio = np.sqrt(above.sum() / below.sum())
        low = float(ratio * np.exp(-half))
        high = float(ratio * np.exp(half))
    return {f"{name}_low": low, f"{name}_high": high}


def band_rows(results: Sequence[Residuals]) -> list[Row]:
    """RMS of the vector by speed, one row per predictor and band: {predictor, low, high, rows, rms, rms_tracked}."""
    fastest = max(float(result.speed.max()) for result in results)
    # Edges of bands of equal width from standstill to the largest speed, rounded to 0.1 m/s.
    edges = np.round(np.linspace(0.0, fastest + 0.05, BANDS + 1), 1).tolist()
    rows = []
    for result in results:
        band = np.minimum(np.digitize(result.speed, edges), BANDS) - 1
        for number, (low, high) in enumerate(pairwise(edges)):
            inside = (band == number) & (result.speed <= edges[-1] + 0.1)
            if inside.sum() >= LEAST_OF_BAND:
                row = {"predictor": result.predictor, "low": low, "high": high, "rows": int(inside.sum())}
                rows.append(row | {"rms": rms(result.error[inside]), "rms_tracked": rms(result.tracked[inside])})
    return rows


class Track:
    """A flight's measured motion at the samples, and the accelerations by a predictor's thrust curve: `rotors` at the
    accelerometer's reading of each sample, `ahead` over the motion that begins there."""

    def __init__(self, row: FlightRows, predictor: Predictor, gravity: float = GRAVITY) -> None:
        flight = row.flight
        at = slice(row.first, None)
        self.predictor = predictor
        self.name = row.name
        self.dt = row.dt
        self.speed = row.speed
        self.velocity = flight.stack(WORLD_VELOCITY)[at]
        if set(POINT) <= set(flight.columns):
            self.position = flight.stack(POINT)[at]
        else:  # the integral of the velocity
            self.position = cumulative_trapezoid(self.velocity, flight.t[at], axis=0, initial=0)
        self.quaternion = flight.stack(QUATERNION)[at]
        self.rotation = Rotation.from_quat(self.quaternion, scalar_first=True)
        self.matrix = self.rotation.as_matrix()
        self.rate = row.rate
        self.time = row.samples.time
        self.segment = row.samples.segment
        self.wind = np.zeros_like(self.velocity) if flight.wind is None else flight.wind[at]
        self.rotors, _, self.scale = one_step(predictor, row)
        self.ahead = row.samples.during(self.rotors)
        self.gravity = gravity
        self.bias = accelerometer_bias(self.time, self.velocity, self.matrix, row.samples.force, self.segment, gravity)

    def scale_at(self, starts: np.ndarray, *, tracked: bool) -> np.ndarray:
        """Scale of the thrust of predictions from some starts, (starts,)."""
        return self.scale[starts] if tracked else np.ones(len(starts))

    def starts(self, steps: int) -> np.ndarray:
        """Samples followed by `steps` more in the same segment, spread over the flight."""
        last = len(self.time) - steps
        if last <= 0:
            return np.empty(0, int)
        together = self.segment[steps:] == self.segment[:last]
        whole = np.abs(self.time[steps:] - self.time[:last] - steps * self.dt) < 1.5 * self.dt
        found = np.flatnonzero(together & whole)
        return found[:: max(1, len(found) // STARTS)]


def accelerometer_bias(
    time: np.ndarray, velocity: np.ndarray, matrix: np.ndarray, force: np.ndarray, segment: np.ndarray,
    gravity: float = GRAVITY,
) -> np.ndarray:  # fmt: skip
    """Mean of f - R^T (dv/dt + g), (3,) (m/s^2): the accelerometer's mean error.

    dv/dt is taken within each segment, (k,). Samples that are FAR typical deviations from the median are left out:
    there an estimator has set its velocity anew.
    """
    errors = []
    starts = np.flatnonzero(np.diff(segment)) + 1
    for rows in np.split(np.arange(len(time)), starts):
        if len(rows) > 1:
            world = np.gradient(velocity[rows], time[rows], axis=0) + [0.0, 0.0, gravity]
            errors.append(force[rows] - np.einsum("kji,kj->ki", matrix[rows], world))
    error = np.concatenate(errors)
    distance = norms(error - np.median(error, axis=0))
    near = distance <= max(FAR * np.median(distance), STEP)
    return np.mean(error[near], axis=0)


def attitude_rollout(track: Track, starts: np.ndarray, steps: int, *, tracked: bool) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity at the end, each (starts, 3), world, with the measured attitude."""
    gravity = np.array([0.0, 0.0, -track.gravity])
    scale = track.scale_at(starts, tracked=tracked)

    def acceleration(k: np.ndarray, v: np.ndarray, rotors: np.ndarray) -> np.ndarray:
        """At samples k, (starts, 3), world."""
        body = air_velocity(track.quaternion[k], v, track.wind[k])
        force = track.predictor.beyond(body, track.rate[k], rotors[k]) - track.bias
        force[:, 2] += scale * rotors[k].sum(axis=1)
        return np.einsum("kij,kj->ki", track.matrix[k], force) + gravity

    p = track.position[starts]
    v = track.velocity[starts]
    for k in starts + np.arange(steps)[:, None]:
        h = (track.time[k + 1] - track.time[k])[:, None]
        slope = acceleration(k, v, track.ahead)
        ahead = acceleration(k + 1, v + h * slope, track.rotors)
        p = p + h * v + h * h / 6 * (2 * slope + ahead)
        v = v + h / 2 * (slope + ahead)
    return p, v


def full_rollout(
    track: Track, starts: np.ndarray, steps: int, vehicle: Vehicle, *, tracked: bool, mode: str
) -> np.ndarray:
    """States at the end, (starts, 13): the rigid body under the rotors' thrusts and the model's acceleration.

    mode: one of TURNING. NaN after a prediction has exceeded LOST_SPEED or LOST_RATE.
    """
    x, u, y, h = symbols(ca.SX, x=13, u=vehicle.n_rotors, y=6, h=1)
    after = rk4_step(lambda at: state_derivative(at, u, vehicle, y), x, h)
    step = ca.Function("step", [x, u, y, h], [after])
    scale = vehicle.mass * track.scale_at(starts, tracked=tracked)[:, None]
    quaternion = track.rotation[starts].as_quat(scalar_first=True)
    first = np.hstack([track.position[starts], quaternion, track.velocity[starts], track.rate[starts]])
    state = first
    stopped = np.zeros(len(starts), bool)
    for k in starts + np.arange(steps)[:, None]:
        fast = np.abs(state[:, VELOCITY]).max(axis=1) > LOST_SPEED
        lost = fast | (np.abs(state[:, RATE]).max(axis=1) > LOST_RATE)
        stopped |= lost
        state = np.where(lost[:, None], first, state)  # restarted at a finite state, and set to NaN below
        rate = state[:, RATE]
        thrust = scale * track.ahead[k]
        body = air_velocity(state[:, ATTITUDE], state[:, VELOCITY], track.wind[k])
        force = track.predictor.beyond(body, rate, track.ahead[k]) - track.bias
        torque = np.zeros_like(force)
        if mode == "held":  # J w' = 0: what holds w against the rotors' torque and the gyroscopic one
            torque = np.cross(rate, rate @ vehicle.inertia_matrix) - thrust @ vehicle.allocation[1:].T
        duration = track.time[k + 1] - track.time[k]
        state = step(state.T, thrust.T, np.hstack([force, torque]).T, duration[None]).full().T
        state[:, ATTITUDE] /= np.linalg.norm(state[:, ATTITUDE], axis=1, keepdims=True)
    return np.where(stopped[:, None], np.nan, state)


def rollout_errors(
    tracks: Sequence[Track], horizons: Sequence[float], *, tracked: bool, vehicle: Vehicle | None = None,
    mode: str = "full",
) -> list[dict[str, Any]]:  # fmt: skip
    """Errors of a predictor at each horizon: {horizon, starts, lost (share), position (m), velocity (m/s)}.

    The errors are RMS over starts, with their medians beside them. vehicle: None: mode "attitude"; else all 13 states
    by `mode`, with attitude (rad) and rate (rad/s) errors too.
    """
    rows = []
    for horizon in horizons:
        parts = []
        for track in tracks:
            steps = max(1, round(horizon / track.dt))
            starts = track.starts(steps)
            if len(starts):
                parts.append(_end_errors(track, starts, steps, vehicle, tracked=tracked, mode=mode))
        if not parts:
            continue
        row: Row = {
            "predictor": tracks[0].predictor.name,
            "mode": "attitude" if vehicle is None else mode,
            "horizon": float(horizon),
            "thrust_tracked": tracked,
        }
        for name in parts[0]:
            values = np.concatenate([part[name] for part in parts])
            finite = values[np.isfinite(values)]
            row["starts"] = len(values)
            row["lost"] = float(1 - len(finite) / len(values))
            row[name] = root_mean_square(finite) if len(finite) else np.nan
            row[f"{name}_median"] = float(np.median(finite)) if len(finite) else np.nan
        rows.append(row)
    return rows


def _end_errors(
    track: Track, starts: np.ndarray, steps: int, vehicle: Vehicle | None, *, tracked: bool, mode: str
) -> dict[str, np.ndarray]:
    """Size of each error at the end of predictions from some starts, (starts,)."""
    end = starts + steps
    errors = {}
    if vehicle is None:
        position, velocity = attitude_rollout(track, starts, steps, tracked=tracked)
    else:
        last = full_rollout(track, starts, steps, vehicle, tracked=tracked, mode=mode)
        position = last[:, POSITION]
        velocity = last[:, VELOCITY]
        lost = np.isnan(last[:, :1])
        predicted = Rotation.from_quat(np.where(lost, [1.0, 0.0, 0.0, 0.0], last[:, ATTITUDE]), scalar_first=True)
        attitude = np.where(lost[:, 0], np.nan, (predicted.inv() * track.rotation[end]).magnitude())
        errors = {"attitude": attitude, "rate": norms(last[:, RATE] - track.rate[end])}
    position_error = norms(position - track.position[end])
    return errors | {"position": position_error, "velocity": norms(velocity - track.velocity[end])}
