"""A mapping proposed for a table of unknown origin: from the names of its columns, and from what the data obeys.

The names say which columns are what (columns.py): a table whose names say nothing needs a mapping by hand. Units follow
from sizes and gains (units_by_size.py), frames from the search that `quadexp check` has too (frames.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.log.runs import period_of
from quadexp.messages import printable
from quadexp.physics.rotation import continuous
from quadexp.physics.state import norms
from quadexp.plugins.check.candidates import LETTERS, flow
from quadexp.plugins.check.columns import Match, Table
from quadexp.plugins.check.frames import FRAMES, PLAIN, conventions, search_frames
from quadexp.plugins.check.units_by_size import (
    GUESS,
    GYROS,
    IN_HOVER,
    LIKELY,
    SECONDS,
    SURE,
    VOLTS,
    Proposal,
    angle_unit,
    motion_units,
    rate_unit_by_size,
    rotor_range,
    sensor_unit,
    time_unit,
)
from quadexp.plugins.logs.column_names import groups, numbered_quaternion, unit_of
from quadexp.plugins.logs.importers.assemble import check_clock
from quadexp.plugins.logs.importers.quantities import QUANTITIES, ROTORS
from quadexp.plugins.logs.importers.readers import reader_of
from quadexp.plugins.logs.importers.table import numbers, open_table
from quadexp.plugins.logs.signal import increasing
from quadexp.plugins.logs.signal.windows import Windows, changes
from quadexp.plugins.logs.units import UNITS

SLOW = 0.1  # s: rows further apart do not show the motion
TUM = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]  # of a trajectory without a header
LEAST_SAMPLES = 50  # of a column; of fewer a correlation of 0.3 may be chance


@dataclass
class Description:
    """A proposed mapping. fields: by key. warnings: what a user has to know."""

    path: Path
    format: str
    fields: dict[str, Proposal] = field(default_factory=dict)

    @property
    def warnings(self) -> list[str]:
        missing = [name for name in ("position", "attitude", "acceleration") if name not in self.fields]
        lines = [f"no {name} was recognised: what needs it is not possible with this log" for name in missing]
        if not self.fields.keys() & QUANTITIES.keys():
            lines.append("no column was recognised: add the quantities by hand, an import needs one at least")
        if not self.fields.keys() & set(ROTORS):
            lines.append("no motor command or rotor speed was recognised: `quadexp identify` needs one")
        if "attitude" in missing:
            lines.append("without an attitude neither frames nor directions can be checked")
        return lines

    def yaml(self) -> str:
        """The mapping, as `--mapping` takes it, with the evidence before every line."""
        lines = [f"# {printable(self.path.name)}: proposed by `quadexp import --describe`; check what is not sure."]
        lines.append(f"format: {self.format}")
        for key, proposal in self.fields.items():
            lines.append(f"# {key}: {proposal.sureness}: {printable(proposal.why)}")
            lines.append(f"{key}: {flow(proposal.value)}")
        for warning in self.warnings:
            lines.append(f"# note: {printable(warning)}")
        return "\n".join([*lines, ""])

    def record(self) -> dict[str, Any]:
        mapping = {"format": self.format}
        fields = {}
        for key, proposal in self.fields.items():
            mapping[key] = proposal.value
            fields[key] = {"sureness": proposal.sureness, "why": proposal.why}
        return {"path": self.path, "mapping": mapping, "fields": fields, "warnings": self.warnings}


def describe_log(path: Path) -> Description:
    """Propose a mapping for a table. Raises DataError for what is none, or has no clock."""
    reader = reader_of(path)
    if reader != "csv":
        raise DataError(f"{path}: {reader} says itself what its fields are: it needs no mapping, import it as it is")
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        opened = open_table(path)
        names, data = numbers(opened)
        if len(data) < LEAST_SAMPLES:
            raise DataError(f"{path}: {len(data)} rows: too few to propose a mapping from ({LEAST_SAMPLES} do)")
        clock = _clock(path, names, data, [name for name in opened.columns if name not in names])
        unit = time_unit(data[:, clock], unit_of(names[clock])[1])
        t = data[:, clock] * SECONDS[unit.value["unit"]]
        good = np.isfinite(t)
        if good.sum() < LEAST_SAMPLES:
            few = f"{int(good.sum())} rows with a time: too few to propose a mapping from ({LEAST_SAMPLES} do)"
            raise DataError(f"{path}: {few}")
        rises = increasing(t[good])
        check_clock(path, names[clock], t[good][rises])
        named = names
        if names == [str(i) for i in range(8)]:
            off = np.abs(norms(data[:, 4:]) - 1)
            if np.nanquantile(off, 0.9) < 0.02:
                named = TUM
        table = Table(named, t[good] - t[good][0], data[good], clock)
        proposals = _Proposals(names, table)
        proposals.motion()
        proposals.attitude()
        proposals.sensors()
        proposals.frames()
        proposals.rotors()
        proposals.others()
    fields = proposals.fields
    first = {"time": Proposal({"column": names[clock], **unit.value}, unit.sureness, unit.why)}
    first |= {key: fields[key] for key in FRAMES if key in fields}
    crop = Proposal("auto", SURE, "ground phases at the ends are cut off if there are any")
    return Description(path, opened.format, first | fields | {"crop": crop})


def _clock(path: Path, names: Sequence[str], data: np.ndarray, others: Sequence[str]) -> int:
    """The column that increases most steadily, one that is named `time` before others. Raises DataError where no
    column increases from row to row. others: columns that hold no numbers, or have another length."""
    named = {columns[0] for columns in groups(names).get("time", [])}
    steadiness = []
    for i, values in enumerate(data.T):
        steadiness.append(_steadiness(values[np.isfinite(values)], len(data)) + 2 * (i in named))
    if max(steadiness) == -np.inf:
        left = f" (not columns of numbers: {', '.join(others[:8])}; a time must be one number)" if others else ""
        raise DataError(f"{path}: no column increases from row to row: there is no clock{left}")
    return int(np.argmax(steadiness))


def _steadiness(values: np.ndarray, rows: int) -> float:
    """How much a column of finite values (k,) is like a clock, up to 1; a mere counter is less so."""
    steps = np.diff(values)
    if len(values) < max(20, 0.5 * rows) or np.mean(steps < 0) > 0.05 or np.mean(steps > 0) < 0.3:
        return -np.inf
    usual = np.median(steps)
    uneven = np.median(np.abs(steps - usual)) / max(usual, 1e-300)
    counter = values[0] in (0.0, 1.0) and np.all(steps == 1.0)
    return float(np.mean(steps > 0) - min(uneven, 1.0) - 1.5 * counter)


class _Proposals:
    """The lines of the mapping of one table, by quantity, and the streams that they give. streams: letter -> (n, l, m)
    in SI, in the log's own frames."""

    def __init__(self, names: Sequence[str], table: Table) -> None:
        self.names = names
        self.table = table
        self.fields: dict[str, Proposal] = {}
        self.streams: dict[str, np.ndarray] = {}
        self.places: dict[str, list[int]] = {}

    def written(self, columns: list[int], dimension: str) -> str | None:
        """The unit that the first column's name says, if it is one of the dimension."""
        _, unit = unit_of(self.names[columns[0]])
        return unit if unit in UNITS[dimension] else None

    def first_named(self, name: str) -> list[int] | None:
        """The likeliest columns of what is named so."""
        return next(iter(self.table.named.get(name, [])), None)

    def propose(self, quantity: str, columns: list[int], proposal: Proposal) -> None:
        """One quantity; the stream that is read so, where it is one of the motion's."""
        lines = proposal.value
        value = {"columns": [self.names[i] for i in columns], **lines}
        self.fields[quantity] = proposal._replace(value=value)
        self.places[quantity] = columns
        if quantity in LETTERS and quantity != "attitude" and "kind" not in lines:
            factor = UNITS[QUANTITIES[quantity].dimension][lines["unit"]] * lines.get("scale", 1.0)
            self.streams[LETTERS[quantity]] = self.table.windows[..., columns] * factor

    def motion(self) -> None:
        """Position and velocity: as each other's derivative, or by their names."""
        pair = self.table.derivative()
        if pair is not None:
            position, velocity = pair
            x = self.table.x
            written = self.written(position, "length")
            units = motion_units(x[:, position], x[:, velocity.columns], velocity.gain, velocity.correlation, written)
            self.propose("position", position, units[0])
            self.propose("velocity", velocity.columns, units[1])
            return
        for name in ("position", "velocity"):
            columns = self.first_named(name)
            if columns is not None:
                dimension = QUANTITIES[name].dimension
                unit = self.written(columns, dimension) or next(iter(UNITS[dimension]))
                self.propose(name, columns, Proposal({"unit": unit}, LIKELY, "by its name alone"))

    def attitude(self) -> None:
        """A quaternion, or roll, pitch and yaw."""
        columns = self.table.attitude()
        if columns is not None:
            x = self.table.windows[..., columns]
            self.streams["q"] = continuous(x.reshape(-1, 4)).reshape(x.shape)
            self.propose("attitude", columns, Proposal(PLAIN, GUESS, "norm 1"))
            return
        columns = self.first_named("euler")
        if columns is None:
            return
        reading, factor = angle_unit(self.table.x[:, columns], self.written(columns, "angle"))
        self.propose("attitude", columns, reading)
        if self.table.x[:, columns].any():
            angles = self.table.windows[..., columns]
            turns = Rotation.from_euler("ZYX", (angles * factor)[..., ::-1].reshape(-1, 3))
            q = continuous(turns.as_quat(scalar_first=True))
            self.streams["q"] = q.reshape(*angles.shape[:2], 4)

    def sensors(self) -> None:
        """Accelerometer and gyro, in the log's own frames."""
        table = self.table
        velocity = self.streams.get("v")
        if velocity is None and "p" in self.streams:
            velocity = np.gradient(self.streams["p"], period_of(table.t), axis=1)
        motion = None
        if velocity is not None:
            motion = changes(table.times, velocity)
        force = table.acceleration(motion)
        if force is not None:
            self._force(force)
        rate = table.rate(self.streams["q"]) if "q" in self.streams else None
        columns = self.first_named("rate")
        if rate is not None:
            gain = 1 / rate.gain
            why = f"correlation {rate.correlation:.3f} with the attitude's rate, {gain:.4g} rad/s a unit"
            written = self.written(rate.columns, "rate")
            self.propose("rate", rate.columns, sensor_unit(gain, GYROS, "rate", written, why))
        elif columns is not None:
            self.propose("rate", columns, rate_unit_by_size(table.x[:, columns], self.written(columns, "rate")))

    def _force(self, match: Match) -> None:
        """By the accelerometer's mean size, which in flight is about that of gravity."""
        size = float(norms(self.table.means[:, match.columns]).mean())
        written = self.written(match.columns, "acceleration")
        why = f"correlation {match.correlation:.3f}; its mean size is {size:.4g}"
        proposal = sensor_unit(size, IN_HOVER, "acceleration", written, why)
        if size < 0.5 and written != "g":
            proposal = Proposal({"unit": "m/s^2", "kind": "coordinate"}, GUESS, f"{why}: gravity is not in it")
        self.propose("acceleration", match.columns, proposal)

    def frames(self) -> None:
        """Order and direction of the quaternion, world and body, and whether the velocity is in the body."""
        if "q" not in self.streams or not {"p", "v", "f"} & self.streams.keys() or period_of(self.table.t) > SLOW:
            self._body_by_gravity()
            return
        columns = self.places["attitude"]
        by_name = columns in self.table.named.get("attitude", []) and not numbered_quaternion(self.names, columns)
        readings = conventions(len(columns), by_name, "v" in self.streams)
        found = search_frames(Windows(self.table.times, self.streams), readings)
        for key in FRAMES:
            self.fields[key] = Proposal(found.best.correction[key], *found.evidence(key))
        lines, _, why = self.fields["attitude"]
        sureness, evidence = found.evidence("attitude")
        self.fields["attitude"] = Proposal(found.attitude(lines), sureness, f"{why}; {evidence}")
        for key in {"velocity", "acceleration", "rate"} & found.best.correction.keys():
            self.fields[key].value.update(found.best.correction[key])
        if found.mends:
            why = "; ".join(f"{candidate.where}: {candidate.text}" for candidate in found.mends)
            corrections = [candidate.correction for candidate in found.mends]
            sureness = GUESS if found.misfit else SURE
            self.fields["corrections"] = Proposal(corrections, sureness, why + found.misfit)

    def _body_by_gravity(self) -> None:
        """The body's frame where there is no attitude to check it with."""
        if "f" not in self.streams:
            return
        mean = self.streams["f"].mean(axis=(0, 1))
        if abs(mean[2]) > 3 * np.abs(mean[:2]).max():
            why = f"the accelerometer's mean along z is {mean[2]:+.3g}"
            self.fields["body"] = Proposal("FLU" if mean[2] > 0 else "FRD", LIKELY, why)

    def rotors(self) -> None:
        """The motors' commands or speeds, by their names; which motor is where says the check of the flight."""
        betaflight = any(name.startswith(("axisP[", "loopIteration")) for name in self.names)
        for kind in ("rotor_speed", "motor"):
            for columns in self.table.named.get(kind, []):
                x = self.table.x[:, columns]
                if np.ptp(x, axis=0).min() == 0 or x.min() < -0.2 * x.max():
                    continue
                name = self.names[columns[0]].lower()
                written = self.written(columns, "rotor_speed") or self.written(columns, "force")
                quantity, reading = rotor_range(x, kind == "rotor_speed", name, written, betaflight)
                if quantity not in self.fields:
                    order = "taken in the vehicle's order unless a `layout` is given: `quadexp check` says the order"
                    self.propose(quantity, columns, reading._replace(why=f"{reading.why}; {order}"))

    def others(self) -> None:
        """Battery and wind, by their names."""
        columns = self.first_named("battery_voltage")
        if columns is not None:
            middle = float(np.median(self.table.x[:, columns[0]]))
            likely = next(unit for unit, limit in VOLTS.items() if middle < limit)
            unit = self.written(columns, "voltage") or likely
            if middle > 0:
                value = {"column": self.names[columns[0]], "unit": unit}
                self.fields["battery_voltage"] = Proposal(value, LIKELY, f"median {middle:.4g}")
        columns = self.first_named("wind")
        if columns is not None:
            self.propose("wind", columns, Proposal({"unit": "m/s"}, LIKELY, "by its name alone"))
