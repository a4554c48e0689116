"""What a replay test found: the replay beside the log, number by number, warnings, lines and the figure.

Every quantity is the root mean square over the path but its first SETTLE seconds, in which the replay, that starts on
the path, and the log, that did not, differ for no other reason. Replay: median, least and largest of the ensemble.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.experiment.identity import find_model
from quadexp.log.schema import Flight
from quadexp.models.base import outside
from quadexp.models.checkpoint import load_model
from quadexp.models.dataset import feature_rows
from quadexp.parts.schema import Config
from quadexp.physics.state import norms, root_mean_square
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.drawing.style import Figure, shaded, styled
from quadexp.plugins.identification.predictors import Predictor
from quadexp.plugins.identification.replay_log import LoggedPath, Noise
from quadexp.plugins.identification.validation import POINT
from quadexp.plugins.logs.samples import RATES
from quadexp.report.table import Table

SETTLE = 1.0  # s
STILL = 0.5  # m/s of wind
FARTHER = 0.05  # share of samples outside the data of the plant's fit that is worth a warning
ERROR = "position error"
APART = "distance between the paths"
THRUST = "collective thrust / mass"
Row = dict[str, Any]


def at_times_of(path: LoggedPath, flight: Flight, values: np.ndarray) -> np.ndarray:
    """Values (k, m) of a replay at the times of the log."""
    return np.column_stack([np.interp(path.t, flight.t - flight.t[0], column) for column in values.T])


def comparison(path: LoggedPath, flight: Flight, vehicle: Vehicle) -> list[Row]:
    """{quantity, unit, log (None where it does not say), replay, difference (None where that says nothing)}."""
    counted = path.t >= SETTLE

    def replayed(values: np.ndarray) -> np.ndarray:
        return at_times_of(path, flight, values)[counted]

    flown = path.position[counted]
    sent = path.rotors[counted]
    position = replayed(flight.stack(POINT))
    rotors = replayed(flight.input) / vehicle.mass
    rows = []
    if path.target is not None:
        target = path.target[counted]
        rows.append(_compared(ERROR, "m", norms(flown - target), norms(position - target)))
    apart = root_mean_square(norms(position - flown))
    rows.append({"quantity": APART, "unit": "m", "log": None, "replay": apart, "difference": None})
    thrust = sent.sum(axis=1)
    replay_thrust = rotors.sum(axis=1)
    mean = thrust.mean()
    replay_mean = replay_thrust.mean()
    rows.append(_compared(f"{THRUST}, mean", "m/s^2", mean, replay_mean, together=False))
    rows.append(_compared(f"{THRUST}, about its mean", "m/s^2", thrust - mean, replay_thrust - replay_mean))
    if sent.shape == rotors.shape:
        name = "thrust / mass of a rotor beside the others"
        rows.append(_compared(name, "m/s^2", _uneven(sent), _uneven(rotors), together=False))
    for axis, logged, again in zip(RATES, path.rate[counted].T, replayed(flight.stack(RATES)).T, strict=True):
        rows.append(_compared(axis, "rad/s", logged, again))
    return rows


def _compared(quantity: str, unit: str, log: np.ndarray, replay: np.ndarray, *, together: bool = True) -> Row:
    """RMS of log and replay and, where their samples belong together, of the difference."""
    difference = root_mean_square(replay - log) if together else None
    row = {"quantity": quantity, "unit": unit, "log": root_mean_square(log), "replay": root_mean_square(replay)}
    return row | {"difference": difference}


def _uneven(rotors: np.ndarray) -> np.ndarray:
    """What differs from rotor to rotor, without what always does, (k, n)."""
    apart = rotors - rotors.mean(axis=1, keepdims=True)
    return apart - apart.mean(axis=0)


def summary(members: Sequence[Sequence[Row]]) -> list[Row]:
    """A row each quantity: replay, low, high over the members, and the ratio to the log with its ends."""
    table = []
    for rows in zip(*members, strict=True):
        replays = np.array([row["replay"] for row in rows])
        row = {
            **rows[0],
            "replay": float(np.median(replays)),
            "low": float(replays.min()),
            "high": float(replays.max()),
        }
        if row["difference"] is not None:
            row["difference"] = float(np.median([each["difference"] for each in rows]))
        if row["log"]:
            row["ratio"] = row["replay"] / row["log"]
            row["ratio_low"] = row["low"] / row["log"]
            row["ratio_high"] = row["high"] / row["log"]
        table.append(row)
    return table


def finished(table: Sequence[Row], path: LoggedPath) -> dict[str, Any]:
    """The one number: {number, low, high, meaning}."""
    by_name = {row["quantity"]: row for row in table}
    if path.target is not None and "ratio" in by_name[ERROR]:
        row = by_name[ERROR]
        return {
            "number": row["ratio"],
            "low": row["ratio_low"],
            "high": row["ratio_high"],
            "meaning": "position error of the replay over that of the log, RMS",
        }
    row = by_name[APART]
    return {
        "number": row["replay"],
        "low": row["low"],
        "high": row["high"],
        "meaning": "m between replay and log, RMS: the log has no reference, its own path was flown",
    }


def warnings_of(
    log: Path, path: LoggedPath, predictor: Predictor, model_path: Path, config: Config, flights: Sequence[Flight],
    noise: Noise,
) -> list[str]:  # fmt: skip
    """What makes the comparison say less than it seems to."""
    warnings = []
    plant_flights = {Path(name).stem for name in predictor.seen}
    if log.stem in plant_flights:
        warnings.append(f"the plant was fitted to {log.stem} itself: this is no test of the plant")
    warnings += _shared(config, model_path, plant_flights)
    warnings += _extrapolated(predictor, flights)
    if path.wind is not None and path.wind > STILL:
        warnings.append(f"the log has a mean wind of {path.wind:.1f} m/s, the replay flies in {_air(config)}")
    elif _air(config) != "still air":
        warnings.append(f"the replay flies in {_air(config)}, where the plant extrapolates: it was fitted without")
    elif path.wind is None:
        warnings.append("the log does not say the wind: still air is flown, and any wind of the log is in the plant")
    if not noise.shows_torque:
        warnings.append("this log does not show the torque: rates are those of the vehicle file's arms, without noise")
    return warnings


def _air(config: Config) -> str:
    return "still air" if config.wind.name in ("none", "still") else f"wind={config.wind.name}"


def _shared(config: Config, model_path: Path, plant_flights: set[str]) -> list[str]:
    """Data that the plant and the controller's models have in common, a line each."""
    chosen = find_model(config)
    lines = []
    for file in () if chosen is None else chosen.files:
        if Path(file.path).resolve() == model_path.resolve():
            lines.append(f"plant and controller share the model {file.path}: the controller knows its plant")
            continue
        names = load_model(Path(file.path)).dataset.get("names", ())
        both = sorted(plant_flights & {Path(name).stem for name in names})
        if both:
            lines.append(f"plant and controller share their data: both were fitted to {', '.join(both)}")
    return lines


def _extrapolated(predictor: Predictor, flights: Sequence[Flight]) -> list[str]:
    """Where the replay leaves the data of the plant's fit."""
    if not predictor.ranges:
        return ["the model has no ranges of its data: whether the plant extrapolates is not known"]
    shares: dict[str, float] = {}
    for flight in flights:
        features = feature_rows(flight.air_velocity, flight.stack(list(RATES)), flight.input)
        for name, mask in outside(predictor.ranges, features).items():
            shares[name] = max(shares.get(name, 0.0), float(mask.mean()))
    share = shares.pop("any")
    if share <= FARTHER:
        return []
    worst = max(shares, key=lambda name: shares[name])
    low, high = predictor.ranges[worst]
    said = f"the plant extrapolates in {100 * share:.0f} % of the samples"
    return [f"{said}, most in {worst}, beyond [{low:.3g}, {high:.3g}] of the flights of its fit"]


def report_lines(report: Mapping[str, Any]) -> list[str]:
    """The number, the table, what was flown, and the warnings."""
    ends = f"{report['number']:.3g} [{report['low']:.3g}, {report['high']:.3g}]"
    members = f"{report['completed']} of {report['members']} members completed"
    cells = []
    for row in report["rows"]:
        log = "" if row["log"] is None else f"{row['log']:.3g}"
        ratio = f"{row['ratio']:.2f} [{row['ratio_low']:.2f}, {row['ratio_high']:.2f}]" if "ratio" in row else ""
        difference = "" if row["difference"] is None else f"{row['difference']:.3g}"
        cells.append([f"{row['quantity']} ({row['unit']})", log, f"{row['replay']:.3g}", ratio, difference])
    noise = report["noise"]
    late = f"dead time {1e3 * report['dead_time']:.0f} ms, lag {1e3 * report['lag']:.0f} ms"
    densities = f"noise {noise['force']:.2g} N/sqrt(Hz), {noise['torque']:.2g} N m/sqrt(Hz)"
    spread = "coefficients drawn" if report["coefficients_drawn"] else "one set of coefficients"
    return [
        f"replay / log: {ends}  {report['meaning']}" if "ratio" in report["rows"][0] else
        f"replay: {ends} {report['meaning']}",
        *Table(["RMS", "log", "replay", "replay / log", "of the difference"], cells).lines(),
        f"controller {report['controller']}, {report['seconds']:.1f} s; {members}; {spread}; {late}; {densities}",
        *(f"warning: {text}" for text in report["warnings"]),
    ]  # fmt: skip


@styled
def replay_figure(path: LoggedPath, flights: Sequence[Flight], vehicle: Vehicle, name: str) -> Figure:
    """Log (black) and members of the ensemble (blue) over time: error, or distance, collective thrust, roll rate; and
    both paths from above."""
    figure = Figure(figsize=(9.5, 6.4))
    error, thrust, above, rate = figure.subplots(2, 2).flat
    target = path.position if path.target is None else path.target
    for flight in flights:
        t = flight.t - flight.t[0]
        look = {"color": shaded("blue"), "alpha": 0.4, "lw": 0.8}
        position = at_times_of(path, flight, flight.stack(list(POINT)))
        error.plot(path.t, norms(position - target), **look)
        thrust.plot(t, flight.input.sum(axis=1) / vehicle.mass, **look)
        rate.plot(t, flight["w_x"], **look)
        above.plot(position[:, 0], position[:, 1], **look)
    black = {"color": "black", "lw": 0.9, "label": "log"}
    if path.target is not None:
        error.plot(path.t, norms(path.position - target), **black)
    thrust.plot(path.t, path.rotors.sum(axis=1), **black)
    rate.plot(path.t, path.rate[:, 0], **black)
    above.plot(path.position[:, 0], path.position[:, 1], **black)
    error.set(
        xlabel="t (s)", ylabel="position error (m)" if path.target is not None else f"{APART} (m)", ylim=(0, None)
    )
    thrust.set(xlabel="t (s)", ylabel="collective thrust / mass (m/s²)")
    rate.set(xlabel="t (s)", ylabel="w_x (rad/s)")
    above.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    thrust.legend(loc="upper right")
    figure.suptitle(f"{name}: log (black), replay (blue, {len(flights)} members)")
    return figure
