"""A mapping proposed for a table of unknown origin: from the names of its columns, and from what the data obeys.

Names only propose. What can be checked by physics is: which order and direction of a quaternion agrees with the gyro
and with the specific force, which velocity is the derivative of which position, what the accelerometer reads at rest.
Every field says how sure it is: sure (data and name agree, or data alone is clear), likely, guess.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.flight.importers.attitude_search import Attitude, Proposal, find_attitude
from quadexp.flight.importers.detect import detect
from quadexp.flight.importers.evidence import Samples, correlations, fit_turn, sample
from quadexp.flight.importers.motor_search import find_battery, find_motors
from quadexp.flight.importers.names import NOT_MEASURED, groups, hint, unit_of
from quadexp.flight.importers.table import Table, open_table, split

MOST_ROWS = 300_000
MOST_COLUMNS = 400
MOTION = 0.85  # correlation of a velocity with the derivative of a position


@dataclass
class Description:
    """fields: top key -> (value as YAML, confidence, why). warnings: what a user has to know."""

    path: Path
    fields: dict[str, Proposal]
    warnings: list[str] = field(default_factory=list)
    format: str = "text"

    def yaml(self) -> str:
        """The mapping, as `--mapping` takes it, with the confidence behind every line."""
        lines = [
            f"# {self.path.name}: proposed by `quadexp import --describe`; check what is not sure.",
            f"format: {self.format}",
        ]
        for key, made in self.fields.items():
            lines += [f"# {key}: {made.sureness} ({made.confidence:.0%}): {made.why}", f"{key}: {flow(made.value)}"]
        return "\n".join([*lines, *(f"# note: {text}" for text in self.warnings), ""])

    def record(self) -> dict[str, Any]:
        return {
            "path": self.path,
            "mapping": {"format": self.format, **{key: made.value for key, made in self.fields.items()}},
            "fields": {
                key: {"confidence": made.confidence, "sureness": made.sureness, "why": made.why}
                for key, made in self.fields.items()
            },
            "warnings": self.warnings,
        }


def flow(value: Any) -> str:
    """A value as YAML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(flow, value)) + "]"
    if isinstance(value, str):
        plain = value and all(c.isalnum() or c in "_./^" for c in value) and not value[0].isdigit()
        words = ("y", "n", "yes", "no", "on", "off", "true", "false", "null")
        return (
            value
            if plain and value.lower() not in words
            else '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
        )
    return f"{value:.10g}" if isinstance(value, float) else str(value)


def describe_log(path: Path) -> Description:
    """Propose a mapping for a table. Raises DataError for what is none, or has no clock."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        return _describe(path)


def _describe(path: Path) -> Description:
    kind = detect(path)
    if kind not in ("text", "hdf5"):
        raise DataError(f"{path}: {kind} says itself what its fields are and needs no mapping: import it as it is")
    table = open_table(path, kind)
    names, data = numbers(table)
    clock, unit, why, confidence = find_time(path, names, data)
    factor = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit]
    t = data[:, clock] * factor
    good = np.isfinite(t)
    if good.sum() < 50:
        raise DataError(f"{path}: {int(good.sum())} rows with a time: too few to propose a mapping from")
    samples = sample(t[good] - t[good][0], data[good])
    found = Description(path, {"time": Proposal({"column": names[clock], "unit": unit}, confidence, why)}, format=kind)
    usable = [i for i in range(len(names)) if i != clock and np.isfinite(samples.x[:, i]).all()]
    _fill(found, names, samples, usable)
    found.fields["crop"] = Proposal("auto", 0.9, "ground phases at the ends are cut off where there are any")
    return found


def numbers(table: Table) -> tuple[list[str], np.ndarray]:
    """The columns that hold numbers, and their values (k, N)."""
    names = list(table.columns[:MOST_COLUMNS])
    if not table.hdf5:
        rows = _head(table)
        names = [n for i, n in enumerate(names) if all(_number(row[i]) for row in rows)]
    while True:
        try:
            columns = table.read(names, [], MOST_ROWS)
            break
        except DataError as error:
            bad = next((name for name in names if f"column {name!r} holds" in str(error)), None)
            if bad is None:
                raise
            names.remove(bad)
    lengths = {len(values) for values in columns.values()}
    if len(lengths) > 1:
        longest = max(lengths, key=lambda n: sum(len(values) == n for values in columns.values()))
        names = [name for name in names if len(columns[name]) == longest]
    if not names:
        raise DataError(f"{table.path}: no column of numbers")
    return names, np.stack([columns[name] for name in names], axis=1)


def _head(table: Table) -> list[list[str]]:
    with open(table.path, encoding=table.encoding, errors="replace") as file:
        lines = [line for _, line in zip(range(table.skip + 200), file, strict=False)][table.skip :]
    rows = [split(line.rstrip("\r\n"), table.delimiter) for line in lines]
    return [row for row in rows if len(row) == len(table.columns)]


def _number(text: str) -> bool:
    try:
        float(text or "nan")
    except ValueError:
        return text.lower() in ("na", "null", "none")
    return True


def find_time(path: Path, names: list[str], data: np.ndarray) -> tuple[int, str, str, float]:
    """Column and unit of the clock: it never goes back, and its unit makes the rate one that loggers have."""
    said = {columns[0] for columns in groups(names).get("time", [])}
    scores = []
    for i, column in enumerate(data.T):
        column = column[np.isfinite(column)]
        if len(column) < 0.5 * len(data) or len(column) < 20:
            continue
        steps = np.diff(column)
        ahead = float((steps > 0).mean())
        if ahead < 0.3 or (steps < 0).mean() > 0.01 or column[-1] <= column[0]:
            continue
        counter = bool((steps == steps[0]).all() and steps[0] == 1.0 and column[0] in (0.0, 1.0))
        even = float(np.median(np.abs(steps - np.median(steps))) / max(np.median(steps), 1e-300))
        scores.append((2 * (i in said) + ahead - min(even, 1.0) - 1.5 * counter - 0.001 * i, i))
    if not scores:
        raise DataError(f"{path}: no column increases from row to row: there is no clock")
    _, best = max(scores)
    column = data[:, best]
    column = column[np.isfinite(column)]
    steps = np.diff(column)
    step = float(np.median(steps[steps > 0]))
    written = unit_of(names[best])[1]
    if written in ("s", "ms", "us", "ns"):
        return best, written, "the name says the unit", 0.98 if best in said else 0.9
    rates = {unit: 1 / (step * factor) for unit, factor in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))}
    fitting = [unit for unit, rate in rates.items() if 4 <= rate <= 8200]
    unit = fitting[0] if fitting else "s"
    first = abs(float(column[0]))
    for scale, name in ((1e18, "ns"), (1e15, "us"), (1e12, "ms")):
        if first > 0.9 * scale and name in fitting:
            unit = name
            break
    why = f"increases by {step:.6g} a row: {rates[unit]:.4g} Hz" + (", and so named" if best in said else "")
    return best, unit, why, (0.97 if best in said else 0.85) if fitting else 0.4


def _fill(found: Description, names: list[str], samples: Samples, usable: list[int]) -> None:
    """All fields but the clock, in the order in which one proves the other."""
    said = {q: [g for g in cols if set(g) <= set(usable)] for q, cols in groups(names).items()}
    # Columns whose names say nothing may be anything; one that is named is taken by its name or not at all.
    usable = [i for i in usable if hint(names[i]) is None and not NOT_MEASURED.search(names[i].lower())]
    pair = Motion(names, samples, usable, said, None).derivative()
    known = {quantity: columns for quantity, columns in said.items() if quantity != "velocity"}
    if pair is not None:  # what the accelerometer is compared with
        known["position"], known["velocity"] = [pair.position], [pair.velocity]
    attitude = find_attitude(names, samples, usable, known, said.get("velocity", []))
    motion = Motion(names, samples, usable, said, attitude)
    fields = found.fields
    if attitude is not None:
        fields["world"], fields["body"] = attitude.world, attitude.body
    elif (still := motion.without_attitude()) is not None:
        fields["body"] = still
    for name, made in motion.fields().items():
        fields[name] = made
    if attitude is not None:
        fields |= attitude.fields
    force, rate = _columns(fields.get("acceleration"), names), _columns(fields.get("rate"), names)
    fields |= find_motors(names, samples, usable, said, force, rate, fields)
    fields |= find_battery(names, samples, usable, said)
    if "wind" in said and said["wind"]:
        columns = [names[i] for i in said["wind"][0]]
        fields["wind"] = Proposal({"columns": columns, "unit": "m/s"}, 0.6, "by its name alone")
    order = ("time", "world", "body", "position", "attitude", "velocity", "rate", "acceleration")
    found.fields = {k: fields[k] for k in order if k in fields} | {k: v for k, v in fields.items() if k not in order}
    for name in ("position", "attitude", "acceleration"):
        if name not in fields:
            found.warnings.append(f"no {name} was recognised: what needs it is not possible with this log")
    if not set(found.fields) - {"time", "world", "body"}:
        found.warnings.append("no column was recognised: add the quantities by hand, an import needs one at least")
    if attitude is None and "attitude" not in fields:
        found.warnings.append("without an attitude neither frames nor directions can be checked")


def _columns(made: Proposal | None, names: list[str]) -> list[int] | None:
    return None if made is None else [names.index(str(name)) for name in made.value["columns"]]


class Pair(NamedTuple):
    """score: correlation. position, velocity: columns. frame: of the velocity. slope: of it over the derivative."""

    score: float
    position: list[int]
    velocity: list[int]
    frame: str
    slope: float


class Motion:
    """Position and velocity: which columns are each other's derivative, in the world or in the body."""

    def __init__(
        self,
        names: list[str],
        samples: Samples,
        usable: list[int],
        said: dict[str, list[list[int]]],
        attitude: Attitude | None,
    ) -> None:
        self.names, self.s, self.usable, self.said, self.attitude = names, samples, usable, said, attitude

    def without_attitude(self) -> Proposal | None:
        """Body frame from gravity in the accelerometer alone."""
        for columns in self.said.get("acceleration", []):
            mean = self.s.x[:, columns].mean(axis=0)
            axis = int(np.argmax(np.abs(mean)))
            if axis == 2 and abs(mean[2]) > 3 * np.abs(mean[:2]).max():
                frame = "FLU" if mean[2] > 0 else "FRD"
                return Proposal(frame, 0.7, f"the accelerometer's mean along z is {mean[2]:+.3g}")
        return None

    def fields(self) -> dict[str, Proposal]:
        made: dict[str, Proposal] = {}
        position, velocity = self._pair()
        if position is not None:
            made["position"] = position
        if velocity is not None:
            made["velocity"] = velocity
        if self.attitude is None:
            made |= self._unproved()
        return made

    def _unproved(self) -> dict[str, Proposal]:
        """Rate and acceleration where there is no attitude to check them with: names, and the size of gravity."""
        from quadexp.flight.importers.attitude_search import force_unit, rate_unit

        made = {}
        for columns in self.said.get("rate", [])[:1]:
            unit, sure, why = rate_unit(self.names, columns, self.s.x[:, columns])
            made["rate"] = Proposal({"columns": [self.names[i] for i in columns], "unit": unit}, sure, why)
        for columns in self.said.get("acceleration", [])[:1]:
            entry, sure, why = force_unit(
                self.names, columns, float(np.linalg.norm(self.s.x[:, columns], axis=1).mean())
            )
            made["acceleration"] = Proposal({"columns": [self.names[i] for i in columns], **entry}, sure, why)
        for columns in self.said.get("euler", [])[:1]:
            largest = float(np.abs(self.s.x[:, columns]).max())
            written = unit_of(self.names[columns[0]])[1]
            unit = written if written in ("rad", "deg") else "deg" if largest > 6.4 else "rad"
            made["attitude"] = Proposal(
                {"columns": [self.names[i] for i in columns], "order": "rpy", "unit": unit}, 0.5,
                f"named roll, pitch, yaw; largest {largest:.3g}",
            )  # fmt: skip
        return made

    def _pair(self) -> tuple[Proposal | None, Proposal | None]:
        best = self.derivative()
        if best is None and self.attitude is not None:
            found = [self._in_body(p) for p in self.said.get("position", [])]
            best = max((b for b in found if b is not None), key=lambda b: b[0], default=None)
        if best is not None:
            return self._proposals(*best)
        return self._alone("position"), self._alone("velocity")

    def _triples(self) -> list[list[int]]:
        free = set(self.usable) - set(self.attitude.taken if self.attitude else ())
        return [g for i in range(len(self.names) - 2) if set(g := list(range(i, i + 3))) <= free]

    def derivative(self) -> Pair | None:
        """Three columns that are the derivative of three others, names and all; None where there are none."""
        s, triples = self.s, self._triples()
        C = correlations(s.dx, s.x)
        best: tuple[float, Pair] | None = None
        positions, velocities = self.said.get("position", []), self.said.get("velocity", [])
        for p in [*positions, *(g for g in triples if g not in positions)]:
            for v in [*velocities, *(g for g in triples if g not in velocities)]:
                if set(p) & set(v):
                    continue
                score = min(C[p[k], v[k]] for k in range(3))
                if score < MOTION:
                    continue
                named = 0.05 * (p in positions) + 0.05 * (v in velocities)
                value = score + named - 0.01 * (self._rank("position", p) + self._rank("velocity", v))
                if best is None or value > best[0] + 1e-3:
                    slope = float(np.sum(s.x[:, v] * s.dx[:, p]) / np.sum(s.dx[:, p] ** 2))
                    best = (value, Pair(score, p, v, "world", slope))
        return None if best is None else best[1]

    def _rank(self, quantity: str, columns: list[int]) -> int:
        known = self.said.get(quantity, [])
        return known.index(columns) if columns in known else 3

    def _in_body(self, p: list[int]) -> Pair | None:
        """The columns that are the derivative of a position, turned into the body."""
        assert self.attitude is not None
        expected = np.einsum("nji,nj->ni", self.attitude.R, self.s.dx[:, p])
        best: tuple[float, Pair] | None = None
        for rank, v in enumerate([*self.said.get("velocity", []), *self._triples()]):
            fit = fit_turn(expected, self.s.x[:, v])
            if set(v) & set(p) or fit.score < MOTION or not (fit.matrix == np.eye(3)).all():
                continue
            value = fit.score - 0.01 * min(rank, 5)
            if best is None or value > best[0]:
                best = (value, Pair(fit.score, p, v, "body", fit.scale))
        return None if best is None else best[1]

    def _proposals(
        self, score: float, p: list[int], v: list[int], frame: str, slope: float
    ) -> tuple[Proposal, Proposal]:
        units = {1.0: ("m", "m/s"), 1e3: ("m", "mm/s"), 1e-3: ("mm", "m/s"), 100.0: ("m", "cm/s"), 0.01: ("cm", "m/s")}
        near = min(units, key=lambda u: abs(np.log(max(slope, 1e-12) / u)))
        length, speed = units[near]
        written = [unit_of(self.names[g[0]])[1] for g in (p, v)]
        if near == 1.0 and written[0] in ("mm", "cm"):
            length, speed = written[0], f"{written[0]}/s"
        elif near == 1.0 and np.ptp(self.s.x[:, p], axis=0).max() > 500 and np.abs(self.s.x[:, v]).max() > 80:
            length, speed = "mm", "mm/s"
        clear = abs(slope / near - 1) < 0.1
        named = p in self.said.get("position", []) or v in self.said.get("velocity", [])
        sure = (0.97 if named else 0.9) if clear and score > 0.95 else 0.75 if clear else 0.5
        why = f"the velocity is {slope:.3g} times its derivative, correlation {score:.3f}"
        if not clear:
            why += "; that factor fits no unit: look at the time's unit too"
        names, turned = self.names, " turned into the body" if frame == "body" else ""
        return (
            Proposal({"columns": [names[i] for i in p], "unit": length}, sure, why),
            Proposal(
                {"columns": [names[i] for i in v], "unit": speed, "frame": frame}, sure,
                f"{slope:.3g} times the derivative of the position{turned}",
            ),
        )  # fmt: skip

    def _alone(self, quantity: str) -> Proposal | None:
        known = self.said.get(quantity, [])
        if quantity == "position" and not known and self.attitude is not None and self.attitude.position is not None:
            known = [self.attitude.position]
        if not known:
            return None
        unit = unit_of(self.names[known[0][0]])[1]
        default = "m" if quantity == "position" else "m/s"
        value = {
            "columns": [self.names[i] for i in known[0]],
            "unit": unit if unit in ("m", "mm", "cm", "m/s", "cm/s") else default,
        }
        if quantity == "velocity" and self.attitude is not None and self.attitude.body_velocity:
            return Proposal(value | {"frame": "body"}, 0.7, "in the body frame the thrust points along one axis")
        return Proposal(value, 0.6, "by its name alone")
