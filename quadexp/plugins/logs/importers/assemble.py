"""From streams to a flight: one clock, gaps as segments, velocity where there is none, ground phases cut off.

A log whose streams share one uniform clock keeps its numbers to the last bit.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.log.runs import period_of
from quadexp.names import distinct, named
from quadexp.physics.state import norms
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.logs.importers.ground import LEAST_ROWS, without_ground
from quadexp.plugins.logs.importers.mapping import Crop
from quadexp.plugins.logs.importers.quantities import ROTORS, columns_of, place_of
from quadexp.plugins.logs.importers.raw import RawLog
from quadexp.plugins.logs.signal import GAP_PERIODS, Stream, derivative, numbered
from quadexp.plugins.logs.signal.resample import Resampled, resample
from quadexp.plugins.logs.units import UNITS

HELD = ("motor_command", "rotor_thrust", "battery_voltage", "wind")
SLOW = ("battery_voltage", "wind")  # known before their first sample and after their last
LEAST_SHARE = {"reference": 0.95, "core": 0.1}  # of the flight that a stream must cover to have a say in its length
CORE = ("acceleration", "rate", "attitude", "velocity", "position")
QUATERNIONS = ("attitude", "reference_attitude")
UNIFORM = 1e-3  # of a period: how far the steps of a clock may differ for it to be taken as uniform
SHORTEST = 5  # rows of a segment
MOST_ROWS = 8_000_000  # 2 h at 1 kHz
MOST_EMPTY = 20.0  # times as long as what has data: more is no gap, but a clock that jumps
LONGEST = 7 * 86400.0  # s
SLOWEST = 20.0  # Hz, of the rows of a log whose unit of time is wrong
FASTEST = 9000.0  # Hz, likewise


def assemble(
    path: Path, log: RawLog, vehicle: Vehicle | None, *, rate: float | None, cropping: bool
) -> tuple[dict[str, np.ndarray], bool]:
    """Columns of a flight: a log brought to one clock of `rate` (Hz; None: its own), in the vehicle's order of rotors.
    And whether the velocity is the derivative of the position.

    cropping: whether to cut ground phases off as the log's mapping says. What was done is added to the notes and to
    what there is to say about the log. Raises DataError where too little is left.
    """
    notes = log.notes
    streams = {name: stream for name, stream in log.streams.items() if len(stream.t) >= 2}
    notes += [f"{name}: one row only: left out" for name in log.streams if name not in streams]
    _short_ones_out(streams, notes)
    core = [name for name in CORE if name in streams]
    if not core:
        raise DataError(f"{path}: has neither {', '.join(CORE[:-1])} nor {CORE[-1]} in two rows or more")
    _sort_rotors(path, streams, log.layout, vehicle, notes)
    rates = {name: 1 / period_of(stream.t) for name, stream in streams.items()}
    start = min(streams[name].t[0] for name in core)
    for name in core:
        check_clock(path, name, streams[name].t)
    period = _shared_period(streams)
    log.about["resampled"] = period is None or rate is not None
    if period is not None and (rate is None or abs(rate * period - 1) < UNIFORM):
        rate = 1 / period
        t = streams[core[0]].t
        values = {name: stream.values for name, stream in streams.items()}
        segment = np.zeros(len(t), np.int32)
    else:
        rate = rate or _common_rate({name: rates[name] for name in core})
        t, values, segment = _one_clock(path, streams, core, rate, notes)
    if len(t) < LEAST_ROWS:
        raise DataError(f"{path}: {len(t)} rows, {LEAST_ROWS} at least are needed")
    kept = without_ground(t, values, log.crop if cropping else Crop("none"), notes)
    for before, after in log.resets:  # what lies between is interpolated across it
        kept &= (t <= before) | (t >= after)
        segment = segment + (t > before) + (t >= after)
    if log.resets:
        kept &= np.bincount(segment)[segment] >= SHORTEST
    derived = "velocity" not in values and "position" in values
    if derived:
        velocity = derivative(t, values["position"], segment=segment, window=max(0.1, 5 / rate))
        values["velocity"] = velocity.values
        notes.append(f"velocity: derivative of the position, to {velocity.bandwidth:.3g} Hz")
    columns = {"t": t[kept] - t[kept][0]}
    names = [name for name in (*CORE[::-1], *values) if name in values]
    for name in distinct(names):
        columns |= named(columns_of(name, values[name].shape[1]), values[name][kept].T)
    columns["segment"] = numbered(segment, kept)
    cropped = [float(t[kept][i] - start) for i in (0, -1)]
    log.about |= {"rate": float(rate), "rates": rates, "cropped": cropped}
    return columns, derived


def _short_ones_out(streams: dict[str, Stream], notes: list[str]) -> None:
    """Leave out what was logged for a small part of the flight: all streams are cut to the time they share."""

    def leave_out(name: str, covered: float, whole: float, share: float) -> None:
        if covered < share * whole:
            notes.append(f"{name}: {covered:.3g} s of {whole:.3g} s: left out")
            del streams[name]

    spans = {name: np.ptp(streams[name].t) for name in CORE if name in streams}
    for name, span in spans.items():
        leave_out(name, span, max(spans.values()), LEAST_SHARE["core"])
    clocks = [streams[name].t for name in CORE if name in streams]
    if not clocks:
        return
    begin = max(t[0] for t in clocks)
    finish = min(t[-1] for t in clocks)
    for name in [name for name in streams if name.startswith("reference")]:
        t = streams[name].t
        step = np.diff(t[(t >= begin) & (t <= finish)])
        covered = 0.0
        if len(step):
            no_gap = step <= GAP_PERIODS * np.median(step)
            covered = step[no_gap].sum()
        leave_out(name, covered, finish - begin, LEAST_SHARE["reference"])


def check_clock(path: Path, name: str, t: np.ndarray) -> None:
    """Raises DataError where most of the time of a stream, (k,) s, passes between few rows."""
    length = np.ptp(t)
    step = np.diff(t)
    period = period_of(t)
    covered = np.minimum(step, 10 * period).sum()
    if length <= min(MOST_EMPTY * covered, LONGEST):
        return
    row = int(np.argmax(step))
    what = "its clock jumps, or the unit of its time is wrong"
    for unit in ("ms", "us", "ns"):
        rate = 1 / (period * UNITS["time"][unit])
        if SLOWEST <= rate <= FASTEST:
            what += f": in {unit} its rows come at {rate:.4g} Hz, which `unit: {unit}` under `time:` says"
            break
    raise DataError(f"{path}: {name} spans {length:.6g} s, {step[row]:.6g} s of it after row {row}: {what}")


def _shared_period(streams: dict[str, Stream]) -> float | None:
    """The period, where all streams share one uniform clock."""
    t = next(iter(streams.values())).t
    if not all(np.array_equal(stream.t, t) for stream in streams.values()):
        return None
    step = np.diff(t)
    period = float(np.ptp(t)) / len(step)
    return period if np.abs(step - period).max() < UNIFORM * period else None


def _common_rate(rates: dict[str, float]) -> float:
    """Rate of the accelerometer or gyro, but at most twice that of pose and velocity; a round number near it (Hz)."""
    slow = [rates[name] for name in ("attitude", "velocity", "position") if name in rates]
    fast = [rates[name] for name in ("acceleration", "rate") if name in rates]
    limits = fast[:1]
    if slow:
        limits.append(2 * min(slow) if fast else min(slow))
    wanted = min(limits)
    for digits in (1, 2, 3):
        near = float(f"{wanted:.{digits}g}")
        if abs(near - wanted) < 0.005 * wanted:
            return near
    return wanted


def _one_clock(path: Path, streams: dict[str, Stream], core: list[str], rate: float, notes: list[str]) -> Resampled:
    """All streams at the rate (Hz), over the time the core has data."""
    begin = max(streams[name].t[0] for name in core)
    end = min(streams[name].t[-1] for name in core)
    if (end - begin) * rate > MOST_ROWS:
        raise DataError(f"{path}: {end - begin:.4g} s at {rate:.4g} Hz are more than {MOST_ROWS} rows: lower --rate")
    for name, (t, values) in list(streams.items()):
        if name in SLOW:  # its first and last value are held to both ends
            rows = np.concatenate([[t[0] > begin], np.ones(len(t), bool), [t[-1] < end]])
            padded = np.pad(values, ((1, 1), (0, 0)), mode="edge")
            streams[name] = Stream(np.concatenate([[begin], t, [end]])[rows], padded[rows])
        elif name not in core and (t[0] > end or t[-1] < begin):
            notes.append(f"{name}: has no time in common with {core[0]}: left out")
            del streams[name]
        elif name in QUATERNIONS:
            beside = np.abs(norms(values) - 1)
            row = int(np.argmax(beside))
            if not beside[row] < 0.1:
                norm = norms(values)[row]
                raise DataError(f"{path}: {name}: quaternion norm {norm:.4g} at row {row}, 1 is needed")
    gaps = dict.fromkeys(SLOW, np.inf)
    try:
        resampled = resample(streams, rate, quaternions=QUATERNIONS, held=HELD, gaps=gaps)
    except DataError as error:
        raise DataError(f"{path}: {error}") from None
    lost = int(np.round((end - begin) * rate)) + 1 - len(resampled.t)
    if resampled.segment[-1] or lost > 1:
        notes.append(f"gaps: {resampled.segment[-1] + 1} segments, {max(lost, 0) / rate:.3g} s without data")
    return resampled


def _sort_rotors(
    path: Path, streams: dict[str, Stream], layout: tuple[str, ...] | None, vehicle: Vehicle | None, notes: list[str]
) -> None:
    """Bring the streams of the rotors into the vehicle's order."""
    for name in [name for name in ROTORS if name in streams]:
        if vehicle is None:
            notes.append("rotors stand in the log's order: no --vehicle says which is where")
            return
        t, values = streams[name]
        if values.shape[1] != vehicle.n_rotors:
            raise DataError(f"{path}: {name} of {values.shape[1]} rotors, but {vehicle.name} has {vehicle.n_rotors}")
        if layout:
            streams[name] = Stream(t, values[:, rotor_order(layout, vehicle)])


def rotor_order(layout: tuple[str, ...], vehicle: Vehicle) -> list[int]:
    """For every rotor of the vehicle, which of the log's motors it is.

    Raises UsageError where a place has no rotor.
    """
    order = []
    for i, (x, y, _) in enumerate(vehicle.rotor_position):
        place = place_of(x, y)
        if layout.count(place) != 1:
            where = f"rotor {i} of {vehicle.name} is at x={x:g}, y={y:g} m"
            raise UsageError(f"the log's motors are {', '.join(layout)}, but {where}")
        order.append(layout.index(place))
    return order
