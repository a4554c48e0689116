"""A mapping proposed for a table of unknown origin: from the names of its columns, and from what the data obeys.

Names only propose. What can be checked by physics is, by the same hypotheses as `quadexp check` has: which order and
direction of a quaternion agrees with the gyro and with the specific force, which velocity is the derivative of which
position, what the accelerometer reads at rest. Every field says how sure it is: sure (data and name agree, or data
alone is clear), likely, guess.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.log.hypotheses.conventions import (
    BODIES,
    MOTION,
    UPS,
    Convention,
    Motion,
    Reading,
    Table,
    angle_reading,
    conventions,
    fitted,
    quaternion_readings,
)
from quadexp.log.hypotheses.hypothesis import flow
from quadexp.log.hypotheses.search import LEAST_GAIN
from quadexp.log.hypotheses.windows import halves, rotation_matrices
from quadexp.log.importers.clock_search import SECONDS, find_clock
from quadexp.log.importers.detect import detect
from quadexp.log.importers.names import NOT_MEASURED, groups, hint, numbered_quaternion, unit_of
from quadexp.log.importers.rotor_columns import find_battery, find_motors
from quadexp.log.importers.table import numbers, open_table
from quadexp.log.units import UNITS
from quadexp.messages import printable

Groups = dict[str, list[list[int]]]  # quantity -> groups of columns, the likeliest first
ORDER = ("time", "world", "body", "position", "attitude", "velocity", "rate", "acceleration")
LEAST_SAMPLES = 50


@dataclass
class Proposal:
    """One line of a mapping. value: as it stands there. confidence: 0 to 1. why: the evidence."""

    value: Any
    confidence: float
    why: str

    @property
    def sureness(self) -> str:
        return "sure" if self.confidence >= 0.85 else "likely" if self.confidence >= 0.6 else "guess"


@dataclass
class Description:
    """A proposed mapping. fields: by key. warnings: what a user has to know."""

    path: Path
    fields: dict[str, Proposal]
    warnings: list[str] = field(default_factory=list)
    format: str = "text"

    def yaml(self) -> str:
        """The mapping, as `--mapping` takes it, with the confidence behind every line."""
        lines = [
            f"# {printable(self.path.name)}: proposed by `quadexp import --describe`; check what is not sure.",
            f"format: {self.format}",
        ]
        for key, made in self.fields.items():
            why = f"{made.sureness} ({made.confidence:.0%}): {made.why}"
            lines += [f"# {key}: {printable(why)}", f"{key}: {flow(made.value)}"]
        return "\n".join([*lines, *(f"# note: {printable(text)}" for text in self.warnings), ""])

    def record(self) -> dict[str, Any]:
        fields = {
            key: {"confidence": made.confidence, "sureness": made.sureness, "why": made.why}
            for key, made in self.fields.items()
        }
        mapping = {"format": self.format, **{key: made.value for key, made in self.fields.items()}}
        return {"path": self.path, "mapping": mapping, "fields": fields, "warnings": self.warnings}


def describe_log(path: Path) -> Description:
    """Propose a mapping for a table. Raises DataError for what is none, or has no clock."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        kind = detect(path)
        if kind not in ("text", "hdf5"):
            raise DataError(f"{path}: {kind} says itself what its fields are and needs no mapping: import it as it is")
        names, data = numbers(open_table(path, kind))
        clock, unit, why, confidence = find_clock(path, names, data)
        t = data[:, clock] * SECONDS[unit]
        good = np.isfinite(t)
        if good.sum() < LEAST_SAMPLES:
            raise DataError(f"{path}: {int(good.sum())} rows with a time: too few to propose a mapping from")
        table = Table(t[good] - t[good][0], data[good])
        columns = _Columns(names, table, [i for i in range(len(names)) if i != clock])
        fields = {"time": Proposal({"column": names[clock], "unit": unit}, confidence, why), **columns.fields()}
        fields["crop"] = Proposal("auto", 0.9, "ground phases at the ends are cut off where there are any")
    fields = {k: fields[k] for k in ORDER if k in fields} | {k: v for k, v in fields.items() if k not in ORDER}
    return Description(path, fields, _warnings(fields), kind)


def _warnings(fields: dict[str, Proposal]) -> list[str]:
    missing = [name for name in ("position", "attitude", "acceleration") if name not in fields]
    made = [f"no {name} was recognised: what needs it is not possible with this log" for name in missing]
    if not set(fields) - {"time", "world", "body", "crop"}:
        made.append("no column was recognised: add the quantities by hand, an import needs one at least")
    if "attitude" not in fields:
        made.append("without an attitude neither frames nor directions can be checked")
    return made


class _Columns:
    """The columns of one table. named: those whose names say what they are. free: those whose names say nothing."""

    def __init__(self, names: Sequence[str], table: Table, usable: list[int]) -> None:
        finite = {i for i in usable if np.isfinite(table.x[:, i]).all()}
        self.names, self.table = names, table
        self.named: Groups = {q: [g for g in found if set(g) <= finite] for q, found in groups(names).items()}
        # Columns whose names say nothing may be anything; one that is named is taken by its name or not at all.
        self.free = {i for i in finite if hint(names[i]) is None and not NOT_MEASURED.search(names[i].lower())}

    def adjacent(self, width: int, taken: Sequence[int] = ()) -> list[list[int]]:
        """Free columns side by side."""
        left = self.free - set(taken)
        return [g for i in range(len(self.names) - width + 1) if set(g := list(range(i, i + width))) <= left]

    def entry(self, columns: list[int], **more: Any) -> dict[str, Any]:
        return {"columns": [self.names[i] for i in columns], **more}

    def written(self, columns: list[int]) -> str | None:
        """The unit that the first column's name says."""
        return unit_of(self.names[columns[0]])[1]

    # ------------------------------------------------------------------------------------------- what the data decide
    def fields(self) -> dict[str, Proposal]:
        """All lines but the clock's."""
        pair = self.derivative([*self.named.get("position", []), *self.adjacent(3)],
                               [*self.named.get("velocity", []), *self.adjacent(3)])  # fmt: skip
        taken = [] if pair is None else [*(pair.position or ()), *(pair.velocity or ())]
        readings = self.readings(taken)
        triples = self.adjacent(3, taken)
        ranked = conventions(
            self.table, readings, [pair] if pair is not None else self.motions(readings),
            self.named.get("acceleration") or triples, self.named.get("rate") or triples,
        )  # fmt: skip
        best = ranked[0] if ranked else None
        fields = self.unproved() if best is None else self.proved(best, ranked)
        fields |= self.motion(pair if best is None else best.motion)
        values = {key: made.value for key, made in fields.items()}
        lines = find_motors(self.names, self.table, self.named, self.adjacent(4), values)
        lines |= find_battery(self.names, self.table, self.named)
        fields |= {key: Proposal(*line) for key, line in lines.items()}
        for columns in self.named.get("wind", [])[:1]:
            fields["wind"] = Proposal(self.entry(columns, unit="m/s"), 0.6, "by its name alone")
        return fields

    def derivative(self, positions: list[list[int]], velocities: list[list[int]]) -> Motion | None:
        """Three columns that are the derivative of three others; None where there are none."""
        table, best, found = self.table, -np.inf, None
        for p in positions:
            for v in velocities:
                score = min(table.correlations[i, k] for i, k in zip(p, v, strict=True))
                if set(p) & set(v) or score < MOTION:
                    continue
                value = score + 0.05 * self.is_named("position", p) + 0.05 * self.is_named("velocity", v)
                value -= 0.01 * (self.rank("position", p) + self.rank("velocity", v))
                if value > best + 1e-3:
                    slopes = table.slopes[:, p]
                    gain = float(np.sum(table.means[:, v] * slopes) / np.sum(slopes**2))
                    best, found = value, self.in_units(Motion(p, v, gain=gain, correlation=float(score)))
        return found

    def is_named(self, quantity: str, columns: list[int] | None) -> bool:
        return columns in self.named.get(quantity, [])

    def rank(self, quantity: str, columns: list[int]) -> int:
        return self.named[quantity].index(columns) if self.is_named(quantity, columns) else 3

    def in_units(self, one: Motion) -> Motion:
        """The pair with the units that its gain, names and sizes say."""
        assert one.position is not None and one.velocity is not None
        units = {1.0: ("m", "m/s"), 1e3: ("m", "mm/s"), 1e-3: ("mm", "m/s"), 100.0: ("m", "cm/s"), 0.01: ("cm", "m/s")}
        near = min(units, key=lambda gain: abs(np.log(max(one.gain, 1e-12) / gain)))
        length, speed = units[near]
        written = self.written(one.position)
        large = np.ptp(self.table.x[:, one.position], axis=0).max() > 500
        if near == 1.0 and written in ("mm", "cm"):
            length, speed = str(written), f"{written}/s"
        elif near == 1.0 and large and np.abs(self.table.x[:, one.velocity]).max() > 80:
            length, speed = "mm", "mm/s"
        return replace(one, length=length, speed=speed)

    def readings(self, taken: list[int]) -> list[Reading]:
        """Every reading of four columns of norm one, those named so if there are any; else of roll, pitch and yaw."""
        table = self.table
        known = [g for g in self.named.get("attitude", []) if table.is_unit(g)]
        made = []
        for columns in known or [g for g in self.adjacent(4, taken) if table.is_unit(g)]:
            first = columns in known and not numbered_quaternion(self.names, columns)
            made += quaternion_readings(table, columns, scalar_first=first)
        for columns in [] if made else self.named.get("euler", []):
            unit = self.angle_unit(columns)
            yaw = table.x[:, columns[2]] * UNITS["angle"][unit]
            if np.abs(np.diff(yaw)).max() <= 1.0 and np.abs(table.x[:, columns]).max() > 0:  # else it wraps
                made.append(angle_reading(table, columns, unit))
        return made

    def angle_unit(self, columns: list[int]) -> str:
        written = self.written(columns)
        largest = float(np.abs(self.table.x[:, columns]).max())
        return str(written) if written in ("rad", "deg") else "deg" if largest > 6.4 else "rad"

    def motions(self, readings: list[Reading]) -> list[Motion]:
        """What position and velocity may be where no columns are each other's derivative."""
        p = next(iter(self.named.get("position", [])), None)
        velocities = self.named.get("velocity", [])[:1]
        made = [] if velocities and p is None else [Motion(p)]
        for v in velocities:
            made += [Motion(p, v), Motion(p, v, in_body=True)]
        if p is not None:
            made += [found for reading in readings for v in [*velocities, *self.adjacent(3, p)]
                     if (found := self.turned_derivative(reading, p, v)) is not None]  # fmt: skip
        return made

    def turned_derivative(self, reading: Reading, p: list[int], v: list[int]) -> Motion | None:
        """Three columns as the derivative of a position in the body; None where they are not."""
        if set(v) & {*p, *reading.columns}:
            return None
        R = np.concatenate([rotation_matrices(reading.q[:, (a + b) // 2]) for a, b in halves(self.table.times)])
        fit = fitted(self.table, v, np.einsum("nji,nj->ni", R, self.table.slopes[:, p]), centred=True)
        if fit.correlation < MOTION or not fit.plain:
            return None
        return self.in_units(Motion(p, v, in_body=True, gain=1 / fit.gain, correlation=fit.correlation))

    # ---------------------------------------------------------------------------------------------- what is proposed
    def proved(self, best: Convention, ranked: list[Convention]) -> dict[str, Proposal]:
        """Frames, attitude, gyro and accelerometer of the best convention."""

        def margin(alike: list[Convention]) -> float:
            return best.value - max((one.value for one in alike), default=best.value - 10.0)

        same = [one for one in ranked if one.reading.columns == best.reading.columns]
        of_reading = margin([one for one in same if one.reading.hypothesis != best.reading.hypothesis])
        of_frame = margin([one for one in same if one.reading.hypothesis == best.reading.hypothesis
                           and one.up != best.up])  # fmt: skip
        checked = len({one.up for one in same}) > 1
        alone = best.force is None and best.motion.velocity is not None and best.motion.position is None
        sure = 0.4 if not checked or of_frame < 0.1 else 0.7 if alone or of_frame < LEAST_GAIN else 0.95
        why = f"log likelihood {of_frame:.1f} above that of any other direction" if checked else "not checked"
        frame, word, _ = UPS[best.up]
        fields = {
            "world": Proposal(frame, sure, f"{word}; {why}"),
            "body": Proposal(BODIES[best.thrust], sure,
                             f"the thrust points along {best.thrust} of the attitude's body frame"),
            "attitude": self.attitude(best, of_reading),
        }  # fmt: skip
        if best.rate is not None:
            unit, clear = best.rate.rate_unit
            confidence = (0.95 if best.rate.correlation > 0.8 else 0.75) if clear else 0.4
            why = f"correlation {best.rate.correlation:.3f} with the attitude's rate, slope {best.rate.gain:.3g} rad/s"
            why += " per unit"
            written = self.written(best.rate.columns)
            if written in UNITS["rate"] and written != unit:
                confidence, why = 0.4, f"{why}; but the name says {written}"
            lines = best.correction.get("rate", {})
            fields["rate"] = Proposal(self.entry(best.rate.columns, unit=unit, **lines), confidence, why)
        if best.force is not None:
            entry, confidence, why = self.force_unit(best.force.columns)
            confidence = min(confidence, 0.95 if best.force.correlation > 0.97 else 0.7)
            lines = best.correction.get("acceleration", {})
            fields["acceleration"] = Proposal(
                self.entry(best.force.columns, **entry, **lines), confidence,
                f"{why}; correlation {best.force.correlation:.3f} with gravity and motion",
            )  # fmt: skip
        return fields

    def attitude(self, best: Convention, margin: float) -> Proposal:
        columns, x = best.reading.columns, self.table.x[:, best.reading.columns]
        if best.reading.unit:
            entry, why = self.entry(columns, order="rpy", unit=best.reading.unit), ["named so"]
        else:
            lines = {"order": "wxyz", "direction": "body_to_world", **best.correction.get("attitude", {})}
            off = np.abs(np.linalg.norm(x, axis=1) - 1).max()
            entry, why = self.entry(columns, **lines), [f"norm 1 within {off:.2g}"]
        proved = False
        for sensor, least, what in ((best.rate, 0.8, "its rate with the gyro"),
                                    (best.force, 0.97, "gravity and motion with the accelerometer")):  # fmt: skip
            if sensor is not None:
                proved |= sensor.correlation > least
                why.append(f"{what}: correlation {sensor.correlation:.3f}")
        named = self.is_named("attitude", columns) and not best.reading.unit
        confidence = (0.95 if margin > LEAST_GAIN else 0.9 if named and margin > 0.1 else 0.8) if proved else 0.5
        why.append(f"log likelihood {margin:.1f} above that of the next order or direction")
        return Proposal(entry, confidence, "; ".join(why))

    def motion(self, one: Motion | None) -> dict[str, Proposal]:
        """Position and velocity: as each other's derivative, or by their names."""
        if one is not None and one.position is not None and one.velocity is not None and one.correlation > 0:
            clear = abs(one.gain * UNITS["velocity"][one.speed] / UNITS["length"][one.length] - 1) < 0.1
            named = self.is_named("position", one.position) or self.is_named("velocity", one.velocity)
            sure = ((0.97 if named else 0.9) if one.correlation > 0.95 else 0.75) if clear else 0.5
            why = f"the velocity is {one.gain:.3g} times its derivative, correlation {one.correlation:.3f}"
            why += "" if clear else "; that factor fits no unit: look at the time's unit too"
            frame, turned = ("body", " turned into the body") if one.in_body else ("world", "")
            velocity = self.entry(one.velocity, unit=one.speed, frame=frame)
            return {
                "position": Proposal(self.entry(one.position, unit=one.length), sure, why),
                "velocity": Proposal(velocity, sure, f"{one.gain:.3g} times the derivative of the position{turned}"),
            }
        fields = {}
        for quantity, units in (("position", ("m", "mm", "cm")), ("velocity", ("m/s", "cm/s", "mm/s"))):
            for columns in self.named.get(quantity, [])[:1]:
                written = self.written(columns)
                value = self.entry(columns, unit=written if written in units else units[0])
                fields[quantity] = Proposal(value, 0.6, "by its name alone")
        if "velocity" in fields and one is not None and one.in_body:
            why = "in the body frame the thrust points along one axis"
            fields["velocity"] = Proposal(fields["velocity"].value | {"frame": "body"}, 0.7, why)
        return fields

    def unproved(self) -> dict[str, Proposal]:
        """Rate and acceleration where there is no attitude to check them with: names, and the size of gravity."""
        fields = {}
        for columns in self.named.get("rate", [])[:1]:
            unit, sure, why = self.rate_unit(columns)
            fields["rate"] = Proposal(self.entry(columns, unit=unit), sure, why)
        for columns in self.named.get("acceleration", [])[:1]:
            entry, sure, why = self.force_unit(columns)
            fields["acceleration"] = Proposal(self.entry(columns, **entry), sure, why)
            mean = self.table.x[:, columns].mean(axis=0)
            if abs(mean[2]) > 3 * np.abs(mean[:2]).max():
                why = f"the accelerometer's mean along z is {mean[2]:+.3g}"
                fields["body"] = Proposal("FLU" if mean[2] > 0 else "FRD", 0.7, why)
        for columns in self.named.get("euler", [])[:1]:
            largest = float(np.abs(self.table.x[:, columns]).max())
            value = self.entry(columns, order="rpy", unit=self.angle_unit(columns))
            fields["attitude"] = Proposal(value, 0.5, f"named roll, pitch, yaw; largest {largest:.3g}")
        return fields

    def rate_unit(self, columns: list[int]) -> tuple[str, float, str]:
        """Unit of a gyro that nothing can be compared with: the name's, or by its size."""
        x, written = self.table.x[:, columns], self.written(columns)
        if written in UNITS["rate"]:
            return str(written), 0.85, "the name says the unit"
        spread = float(np.percentile(np.abs(x - np.median(x, axis=0)), 99))
        unit = "deg/s" if spread > 15 else "rad/s"
        return unit, 0.6 if spread > 60 or spread < 8 else 0.4, f"99 % of its values within {spread:.3g}"

    def force_unit(self, columns: list[int]) -> tuple[dict[str, Any], float, str]:
        """Unit of an accelerometer from the size of its mean, which in flight is about that of gravity."""
        mean = float(np.linalg.norm(self.table.means[:, columns], axis=1).mean())
        written, why = self.written(columns), f"its mean length is {mean:.4g}"
        units = {"g": 1.0, "m/s^2": 9.81, "cm/s^2": 981.0, "mg": 1000.0}
        counts = (2048.0, 4096.0, 512.0, 8192.0)  # a g
        near = min([*units.values(), *counts], key=lambda size: abs(np.log(max(mean, 1e-9) / size)))
        clear = abs(np.log(max(mean, 1e-9) / near)) < 0.4
        if near in counts and written not in units:
            return {"unit": "g", "scale": 1 / near}, 0.75 if clear else 0.4, f"{why}: {near:g} counts a g"
        if mean < 0.5 and written != "g":
            return {"unit": "m/s^2", "kind": "coordinate"}, 0.4, f"{why}: gravity is not in it"
        unit = next((name for name, size in units.items() if size == near), "m/s^2")
        if written in units and written != unit:
            return {"unit": written}, 0.4, f"{why}, which would be {unit}; but the name says {written}"
        return {"unit": unit}, 0.95 if clear else 0.4, why
