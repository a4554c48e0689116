"""Replay test: the path of a log, flown again by a controller in a plant identified from flights.

    plant     thrust late by the dead time and lag of the identified curve, forces of the model, torques of the rotors'
              arms, and white noise of force and torque
    ensemble  in each member but the first the model's coefficients are drawn from N(c, C + C_flights): the covariance
              of the fit, and for linear drag the spread of the flights that it was fitted to; the noise in each

The noise is what the model leaves on the log. With S(f) the two-sided power spectral density of e = f - f_model, the
thrust scale tracked, f once as the accelerometer reads it and once as R^T (dv/dt + g) (each has a measuring error of
its own, so the lesser counts), and of the torque e = J w' + w x J w - G u,

    density = sqrt(mean of S over NOISE_BAND), of the force times m         N / sqrt(Hz), N m / sqrt(Hz)

A torque of the rotors that explains the turning no better than none is no measure of a disturbance: then there is no
noise of torque, and the report says so. World ENU, body FLU, SI.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError, UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import fly_one
from quadexp.log.runs import longest
from quadexp.log.schema import Flight, is_recorded
from quadexp.log.store import read_flight
from quadexp.models.checkpoint import load_model, load_report, save_model
from quadexp.parts.options import Folders
from quadexp.parts.schema import Config, controller_name
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.identification import validation
from quadexp.plugins.identification.config_for import config_for
from quadexp.plugins.identification.predictors import Predictor, predictors
from quadexp.plugins.identification.replay_log import LoggedPath, Noise
from quadexp.plugins.identification.torque_gain import TorqueGain
from quadexp.plugins.identification.turning import between_samples
from quadexp.plugins.identification.validation import POINT, WORLD_VELOCITY
from quadexp.plugins.identification.vehicle_model import VehicleModel
from quadexp.plugins.logs.samples import QUATERNION, FlightRows, read_rows
from quadexp.provenance import provenance, versions
from quadexp.report.pairing import grouped
from quadexp.writer import check_output, write_text

SMOOTH = 0.3  # s between the knots of the path's spline
SHORTEST = 4.0  # s of a log
NOISE_BAND = (0.2, 5.0)  # Hz: offsets lie below, the noise of the sensors above
BETTER = 0.95  # of what no torque leaves: a torque that leaves more explains nothing
REPORT_FILE = "replay.json"
OF_THE_TEST = ("plant", "trajectory", "seed")  # what the log, the model and the member decide


def replay_test(
    log: Path, model_path: Path, words: Sequence[str] = (), conf: Folders = None, *, members: int = 8,
    out: Path | None = None, force: bool = False, progress: Callable[[float, float], None] = lambda done, total: None,
) -> dict[str, Any]:  # fmt: skip
    """Fly the path of a log `members` times in the plant of a model, and compare with the log.

    words: overrides, such as controller=geometric; a simulated log's own controller flies where they name none.
    Returns the report with `lines`; it and a figure are written to `out`, if given.
    Raises UsageError or DataError, in one line, for a log or a model that cannot be used.
    """
    from quadexp.plugins.identification.replay_report import comparison, finished, report_lines, summary, warnings_of

    if members < 1:
        raise UsageError(f"--members {members}: at least 1 is needed")
    if out is not None:
        check_output(out, force=force, folder=True)
    _refuse_groups(words)
    flight = read_flight(log, whole=True)
    of_vehicle = [word for word in words if word.startswith("vehicle")]
    stated = flight.metadata.get("vehicle") or {}
    if not stated.get("name") and not of_vehicle:
        raise UsageError(f"{log}: does not say its vehicle: give vehicle=NAME")
    vehicle = build_vehicle(config_for([log], of_vehicle, conf).vehicle)
    model = load_model(model_path, vehicle=vehicle, unknown=True)
    best = 0
    if isinstance(model, VehicleModel):
        best = 1 + list(model.models).index(model.best)
    predictor = predictors(model, model_path.name, vehicle, None)[best]
    curve = predictor.curve
    sent = read_rows(flight, log.stem, curve.signal)
    rows = read_rows(flight, log.stem, curve.signal, curve.delay, curve.lag)
    path = logged_path(sent, predictor, str(log))
    torque = model.torque if isinstance(model, VehicleModel) else None
    noise = noise_of(rows, predictor, vehicle, torque)
    flights = []
    with tempfile.TemporaryDirectory() as folder:
        track = Path(folder) / "path.csv"
        write_track(track, path)
        for member in range(members):
            progress(member, members)
            plant = model_path
            if member and isinstance(model, VehicleModel):
                drawn = drawn_model(model, load_report(model_path), np.random.default_rng(member))
                plant = save_model(Path(folder) / f"member_{member}", drawn)
            overrides = [
                "plant=from_model", f"plant.model={plant}", f"plant.force_noise_density={noise.force!r}",
                f"plant.torque_noise_density={noise.torque!r}", "trajectory=file", f"trajectory.path={track}",
                f"trajectory.smooth={SMOOTH}", f"seed={member}", *_late(curve.delay, curve.lag, words),
            ]  # fmt: skip
            config = composed(flight, [*overrides, *words], conf)
            flights.append(fly_one(config))
        progress(members, members)
    kept = [flown for flown in flights if flown.metadata["outcome"] == "ok"]
    if not kept:
        cause = flights[0].metadata["cause"] or flights[0].metadata["outcome"]
        raise DataError(f"{log}: no member of the ensemble flew the path to its end; the first: {cause}")
    table = summary([comparison(path, flown, vehicle) for flown in kept])
    report = finished(table, path) | {
        "log": str(log), "model": str(model_path), "controller": controller_name(config), "members": members,
        "completed": len(kept), "seconds": float(path.t[-1]), "noise": noise._asdict(), "rows": table,
        "dead_time": curve.delay, "lag": curve.lag, "coefficients_drawn": isinstance(model, VehicleModel),
        "warnings": warnings_of(log, path, predictor, model_path, config, kept, noise),
        "versions": versions(), "provenance": provenance(),
    }  # fmt: skip
    files = {}
    if out is not None:
        from quadexp.plugins.drawing.style import save
        from quadexp.plugins.identification.replay_report import replay_figure

        write_text(out / REPORT_FILE, json.dumps(report, indent=1, default=str) + "\n", force=force)
        figure = save(replay_figure(path, kept, vehicle, log.name), out / "replay")
        files = {"report": str(out / REPORT_FILE), "figure": str(figure)}
    return {**report, "lines": report_lines(report), "files": files}


def _refuse_groups(words: Sequence[str]) -> None:
    for word in words:
        key = word.partition("=")[0]
        if key.partition(".")[0] in OF_THE_TEST and key != "trajectory.smooth":
            raise UsageError(f"replay-test: {word}: the log and the model decide this; only trajectory.smooth is free")


def _late(dead_time: float, lag: float, words: Sequence[str]) -> list[str]:
    """Overrides that let the thrust act as late as the curve says; not those of a group that the words choose."""
    groups = {word.partition("=")[0].partition(".")[0] for word in words}
    late = []
    if dead_time > 0 and "link" not in groups:
        late += ["link=latency", f"link.latency={dead_time!r}"]
    if lag > 0 and "actuator" not in groups:
        late += ["actuator=first_order", f"actuator.time_constant_up={lag!r}", f"actuator.time_constant_down={lag!r}"]
    return late


def composed(flight: Flight, words: Sequence[str], conf: Folders) -> Config:
    """The configuration of a member: the log's vehicle and, of a simulated log, its controller, changed by words."""
    from quadexp.parts.compose import session
    from quadexp.plugins.margins.recorded import recorded_words

    recorded = flight.metadata.get("config") or {}
    flown = {}
    if "controller" in recorded and not is_recorded(flight):
        flown["controller"] = recorded["controller"]
    if not any(word.startswith("vehicle=") for word in words):
        if recorded.get("vehicle"):
            flown["vehicle"] = recorded["vehicle"]
        else:
            words = [f"vehicle={flight.metadata['vehicle']['name']}", *words]
    with session(conf) as composer:
        words = recorded_words(composer, flown, words, flight.metadata.get("classes") or {})
        return composer.compose(words, "simulate")


def logged_path(rows: FlightRows, predictor: Predictor, name: str) -> LoggedPath:
    """The path of a log, and what it did on it. rows: with the commands as they were sent.

    Raises DataError where less than SHORTEST seconds lie between gaps."""
    samples = rows.samples
    joined = (np.diff(samples.time) <= 1.5 * rows.dt) & (np.diff(samples.segment) == 0)
    first = 0
    last = 0
    if joined.any():
        first, last = longest(joined)
    stretch = slice(first, last + 1)
    at = slice(rows.first + first, rows.first + last + 1)
    t = samples.time[stretch]
    seconds = t[-1] - t[0]
    if not seconds >= SHORTEST:
        raise DataError(f"{name}: its longest stretch without a gap takes {seconds:.3g} s; {SHORTEST:g} are needed")
    flight = rows.flight

    def reference(names: Sequence[str]) -> np.ndarray | None:
        columns = [f"ref_{name}" for name in names]
        if not set(columns) <= set(flight.columns):
            return None
        values = flight.stack(columns)[at]
        return values if np.isfinite(values).all() else None

    attitude = reference(QUATERNION)
    if attitude is None:
        attitude = flight.stack(QUATERNION)[at]
    w, x, y, z = attitude.T
    # The level part of y_body is (-sin yaw, cos yaw).
    minus_sine = 2 * (x * y - w * z)
    cosine = 1 - 2 * (x * x + z * z)
    yaw = np.unwrap(np.arctan2(-minus_sine, cosine))
    wind = None if is_recorded(flight) else 0.0
    if flight.wind is not None:
        wind = float(np.linalg.norm(flight.wind[at].mean(axis=0)))
    return LoggedPath(
        t - t[0],
        position=flight.stack(POINT)[at],
        target=reference(POINT),
        yaw=yaw,
        rate=rows.rate[stretch],
        rotors=predictor.curve.of_signal(samples.signal, samples.voltage)[stretch],
        wind=wind,
    )


def write_track(file: Path, path: LoggedPath) -> None:
    """The path as a sampled track; see quadexp/plugins/logs/positions.py."""
    points = path.position if path.target is None else path.target
    yaw = np.remainder(path.yaw + np.pi, 2 * np.pi) - np.pi  # beyond a turn a track may be in degrees
    rows = np.column_stack([path.t, points, yaw])
    np.savetxt(file, rows, fmt="%.9f", delimiter=",", header="t,p_x,p_y,p_z,yaw", comments="")


def drawn_model(model: VehicleModel, report: Mapping[str, Any], rng: np.random.Generator) -> VehicleModel:
    """The model with other coefficients of its best kind, drawn as the module states."""
    terms = model.model()
    drawn = []
    for axis, names, value, covariance in zip("xyz", terms.terms, terms.coefficients, terms.covariance, strict=True):
        of_fit = np.reshape(covariance, (len(names), len(names)))
        total = of_fit + np.diag(_between_flights(report, axis, names))
        drawn.append(rng.multivariate_normal(value, total, method="eigh"))
    return replace(model, **{model.best: replace(terms, coefficients=tuple(drawn))})


def _between_flights(report: Mapping[str, Any], axis: str, names: Sequence[str]) -> np.ndarray:
    """Variance from flight to flight of linear drag and offset, (p,): that of the values less that of their errors."""
    variances = np.zeros(len(names))
    if "quadratic" in names or "hub" in names:  # another drag than that which was fitted flight by flight
        return variances
    rows = [row for flight in report.get("flights", []) for row in flight.get("coefficients", [])]
    by_term = grouped(((row["axis"], row["term"]), row) for row in rows)
    for i, name in enumerate(names):
        of_term = by_term.get((axis, name), [])
        if len(of_term) > 1:
            values = np.array([row["value"] for row in of_term])
            errors = np.array([row["error"] for row in of_term])
            variances[i] = max(np.var(values, ddof=1) - np.mean(errors**2), 0.0)
    return variances


def noise_of(rows: FlightRows, predictor: Predictor, vehicle: Vehicle, torque: TorqueGain | None = None) -> Noise:
    """What the model leaves on a log; see the module. rows: with the commands as late as they act. torque: its gain."""
    samples = rows.samples
    step = validation.one_step(predictor, rows)
    mean_rotors = between_samples(samples, step.rotors)
    mean_velocity = (samples.velocity[:-1] + samples.velocity[1:]) / 2
    of_air = predictor.beyond(mean_velocity, rows.rate[:-1], mean_rotors)
    by_motion = _force_of_motion(rows, vehicle.gravity) - of_air
    by_motion[:, 2] -= step.scale[:-1] * mean_rotors.sum(axis=1)
    by_accelerometer = step.error(tracked=True)
    force = vehicle.mass * min(_density(by_accelerometer, rows), _density(by_motion, rows))
    if step.rotors.shape[1] != vehicle.n_rotors or predictor.curve.signal == "thrust_acceleration":
        return Noise(force, 0.0, False)
    rate = (rows.rate[:-1] + rows.rate[1:]) / 2
    needed = np.diff(rows.rate, axis=0) / rows.dt @ vehicle.inertia_matrix
    needed += np.cross(rate, rate @ vehicle.inertia_matrix)
    delivered = vehicle.mass * mean_rotors @ vehicle.allocation[1:].T
    if torque is not None:
        delivered *= np.where(torque.is_known, torque.ratio, 1.0)
    remaining = _density((needed - delivered)[:, :2], rows)
    shows = remaining < BETTER * _density(needed[:, :2], rows)
    return Noise(force, remaining if shows else 0.0, shows)


def _force_of_motion(rows: FlightRows, gravity: float) -> np.ndarray:
    """R^T (dv/dt + g) from each sample to the next, (k - 1, 3), body (m/s^2)."""
    velocity = rows.flight.stack(WORLD_VELOCITY)[rows.first :]
    attitude = Rotation.from_quat(rows.flight.stack(QUATERNION)[rows.first :], scalar_first=True)
    world = np.diff(velocity, axis=0) / rows.dt + [0.0, 0.0, gravity]
    return (attitude[:-1].apply(world, inverse=True) + attitude[1:].apply(world, inverse=True)) / 2


def _density(error: np.ndarray, rows: FlightRows) -> float:
    """sqrt(mean of S over NOISE_BAND and the axes) of errors (k, m), their unit / sqrt(Hz)."""
    from scipy.signal import welch

    length = min(len(error), round(1 / NOISE_BAND[0] / rows.dt))
    frequency, one_sided = welch(error, 1 / rows.dt, nperseg=length, axis=0)
    inside = (frequency >= NOISE_BAND[0]) & (frequency <= NOISE_BAND[1])
    return float(np.sqrt(one_sided[inside].mean() / 2))
