"""A mapping proposed for a table of unknown origin: from the names of its columns, and from what the data obeys.

Names only propose (names.py), the data decide which columns are what (columns.py). Then every order and direction of
the quaternion with every world and body frame is a candidate of the search that `quadexp check` has too, by the same
evidence; what that search finds besides stands under `corrections`. Where the next best candidate is less than
search.MARGIN log units behind, the line is a guess that asks which of both it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.log.check.rotors import Fit, stretch
from quadexp.log.hypotheses.candidates import READINGS, Candidate, flow
from quadexp.log.hypotheses.search import MARGIN, PER_COST, agreement, explain
from quadexp.log.hypotheses.windows import FLOOR, Windows, changes, pairs
from quadexp.log.importers.columns import Match, Table
from quadexp.log.importers.mapping_reader import PLACES
from quadexp.log.importers.names import groups, numbered_quaternion, unit_of
from quadexp.log.importers.readers import reader_of
from quadexp.log.importers.table import numbers, open_table
from quadexp.log.signal import continuous
from quadexp.log.signal.crop import runs
from quadexp.log.units import UNITS
from quadexp.messages import printable

SECONDS = {unit: UNITS["time"][unit] for unit in ("s", "ms", "us", "ns")}
RATES = (4.0, 8200.0)  # Hz, of loggers
EPOCHS = {"ns": 1e18, "us": 1e15, "ms": 1e12}  # about now, since 1970
LEAST_SAMPLES = 50
FEW = 60  # windows that every frame is tried on
SURE, LIKELY, GUESS = 0.95, 0.7, 0.4
LEAST_EXPLAINED = 0.08  # of the angular acceleration, for the places of motors to be stated
WORLDS = {  # frame of the log's world: what it is, cost
    "ENU": ("z up; which way x points from north cannot be known from the data", 0.0), "NED": ("z down", 0.1),
    "z x y": ("y up", 2.5), "x -z y": ("y down", 2.5), "y z x": ("x up", 2.5), "z -y x": ("x down", 2.5),
}  # fmt: skip
PLAIN = {"order": "wxyz", "direction": "body_to_world"}
BODIES = ("FLU", "FRD", "z x y", "x z -y", "y z x", "z -y x")
COUNTS_PER_G = (2048.0, 4096.0, 512.0, 8192.0)
# Largest value of a motor's command, values of command 0 and 1, what they are.
RANGES = ((1.5, 0, 1, ""), (110, 0, 100, ""), (260, 0, 255, ""), (2200, 0, 2000, ": DShot or Betaflight counts"))
BY_SIGNS = {signs: place for place, signs in PLACES.items()}  # of x and y, FLU


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
    format: str
    fields: dict[str, Proposal] = field(default_factory=dict)

    @property
    def warnings(self) -> list[str]:
        missing = [name for name in ("position", "attitude", "acceleration") if name not in self.fields]
        made = [f"no {name} was recognised: what needs it is not possible with this log" for name in missing]
        if not set(self.fields) - {"time", "world", "body", "crop"}:
            made.append("no column was recognised: add the quantities by hand, an import needs one at least")
        if "attitude" not in self.fields:
            made.append("without an attitude neither frames nor directions can be checked")
        return made

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
        if (reader := reader_of(path)) not in ("csv", "quadexp"):
            raise DataError(
                f"{path}: {reader} says itself what its fields are and needs no mapping: import it as it is"
            )
        names, data = numbers(opened := open_table(path))
        clock, time = _clock(path, names, data)
        t = data[:, clock] * SECONDS[time.value["unit"]]
        good = np.isfinite(t)
        if good.sum() < LEAST_SAMPLES:
            raise DataError(f"{path}: {int(good.sum())} rows with a time: too few to propose a mapping from")
        table = Table(names, t[good] - t[good][0], data[good], clock)
        made = _Proposals(names, table)
        made.motion()
        made.sensors()
        made.frames()
        made.rotors()
        made.others()
    frames = [key for key in ("world", "body") if key in made.fields]
    fields = {"time": time} | {key: made.fields[key] for key in frames} | made.fields
    fields["crop"] = Proposal("auto", 0.9, "ground phases at the ends are cut off where there are any")
    return Description(path, opened.format, fields)


def _clock(path: Path, names: list[str], data: np.ndarray) -> tuple[int, Proposal]:
    """The column that increases most steadily, one that is named `time` before others and a mere counter last; its
    unit makes the rate one that loggers have. Raises DataError where no column increases from row to row."""
    named = {columns[0] for columns in groups(names).get("time", [])}
    scores = []
    for i, values in enumerate(data.T):
        values = values[np.isfinite(values)]
        steps = np.diff(values)
        if len(values) < max(20, 0.5 * len(data)) or (steps < 0).mean() > 0.01 or (steps > 0).mean() < 0.3:
            continue
        counter = bool((steps == steps[0]).all() and steps[0] == 1.0 and values[0] in (0.0, 1.0))
        even = float(np.median(np.abs(steps - np.median(steps))) / max(np.median(steps), 1e-300))
        score = 2 * (i in named) + (steps > 0).mean() - min(even, 1.0) - 1.5 * counter
        scores.append((score, -i, float(np.median(steps[steps > 0])), abs(float(values[0]))))
    if not scores:
        raise DataError(f"{path}: no column increases from row to row: there is no clock")
    _, place, step, first = max(scores)
    column = names[-place]
    unit, why, sure = unit_of(column)[1], "the name says the unit", 0.98
    if unit not in SECONDS:
        rates = {unit: 1 / (step * seconds) for unit, seconds in SECONDS.items()}
        fitting = [unit for unit, rate in rates.items() if RATES[0] <= rate <= RATES[1]]
        since_1970 = [unit for unit in fitting if first > 0.9 * EPOCHS.get(unit, np.inf)]
        unit = (since_1970 or fitting or ["s"])[0]
        why, sure = f"increases by {step:.6g} a row: {rates[unit]:.4g} Hz", 0.9 if fitting else GUESS
    return -place, Proposal({"column": column, "unit": unit}, sure, why)


class _Proposals:
    """The lines of the mapping of one table, by quantity, and the streams that they give. streams: letter -> (n, l, m)
    in SI, in the log's own frames."""

    def __init__(self, names: Sequence[str], table: Table) -> None:
        self.names, self.table = names, table
        self.fields: dict[str, Proposal] = {}
        self.streams: dict[str, np.ndarray] = {}
        self.lines: list[Candidate] = []  # what is made of the streams: frames first, then corrections
        self.places: dict[str, list[int]] = {}

    @property
    def taken(self) -> list[int]:
        return [i for columns in self.places.values() for i in columns]

    def written(self, columns: list[int]) -> str | None:
        """The unit that the first column's name says."""
        return unit_of(self.names[columns[0]])[1]

    def propose(self, quantity: str, columns: list[int], sure: float, why: str, **more: Any) -> None:
        self.fields[quantity] = Proposal({"columns": [self.names[i] for i in columns], **more}, sure, why)
        self.places[quantity] = columns

    def read(self, letter: str, columns: list[int], factor: float) -> None:
        self.streams[letter] = self.table.windows[..., columns] * factor

    # ---------------------------------------------------------------------------------------------------- columns
    def motion(self) -> None:
        """Position and velocity: as each other's derivative, or by their names."""
        pair = self.table.derivative()
        if pair is not None:
            p, v = pair[0], pair[1]
            length, speed = self._lengths(p, v)
            factors = UNITS["length"][length], UNITS["velocity"][speed]
            clear = abs(v.gain * factors[1] / factors[0] - 1) < 0.1
            sure = (SURE if v.correlation > 0.95 else 0.75) if clear else GUESS
            why = f"the velocity is {v.gain:.3g} times its derivative, correlation {v.correlation:.3f}"
            why += "" if clear else "; that factor fits no unit: look at the time's unit too"
            self.propose("position", p, sure, why, unit=length)
            self.propose("velocity", v.columns, sure, why, unit=speed)
        for letter, name, dimension in (("p", "position", "length"), ("v", "velocity", "velocity")):
            for columns in self.table.named.get(name, [])[:1] if pair is None else ():
                written = self.written(columns)
                unit = written if written in UNITS[dimension] else next(iter(UNITS[dimension]))
                self.propose(name, columns, LIKELY, "by its name alone", unit=unit)
            if name in self.fields:
                self.read(letter, self.places[name], UNITS[dimension][self.fields[name].value["unit"]])

    def _lengths(self, p: list[int], v: Match) -> tuple[str, str]:
        """The units that the gain of velocity over derivative, names and sizes say."""
        units = {1.0: ("m", "m/s"), 1e3: ("m", "mm/s"), 1e-3: ("mm", "m/s"), 100.0: ("m", "cm/s"), 0.01: ("cm", "m/s")}
        near = min(units, key=lambda gain: abs(np.log(max(v.gain, 1e-12) / gain)))
        written, x = self.written(p), self.table.x
        if near == 1.0 and written in ("mm", "cm"):
            return str(written), f"{written}/s"
        if near == 1.0 and np.ptp(x[:, p], axis=0).max() > 500 and np.abs(x[:, v.columns]).max() > 80:
            return "mm", "mm/s"
        return units[near]

    def sensors(self) -> None:
        """Attitude, gyro and accelerometer, in the log's own frames."""
        table = self.table
        attitude = next(iter(table.attitudes(self.taken)), None)
        if attitude is not None:
            x = table.windows[..., attitude]
            self.streams["q"] = continuous(x.reshape(-1, 4)).reshape(x.shape)
            self.propose("attitude", attitude, GUESS, "norm 1", **PLAIN)
        for columns in table.named.get("euler", [])[:1] if attitude is None else ():
            largest = float(np.abs(table.x[:, columns]).max())
            written = self.written(columns)
            unit = str(written) if written in ("rad", "deg") else "deg" if largest > 6.4 else "rad"
            angles = table.windows[..., columns[::-1]] * UNITS["angle"][unit]
            self.propose("attitude", columns, 0.5, f"named so; largest {largest:.3g}", order="rpy", unit=unit)
            if (
                np.abs(np.diff(table.x[:, columns[2]])).max() * UNITS["angle"][unit] <= 1.0 and largest > 0
            ):  # else it wraps
                q = Rotation.from_euler("ZYX", angles.reshape(-1, 3)).as_quat(scalar_first=True)
                self.streams["q"] = continuous(q).reshape(*angles.shape[:2], 4)
        motion = changes(table.times, self.streams["v"]) if "v" in self.streams else None
        if motion is None and "p" in self.streams:
            p = table.x[:, self.places["position"]] * UNITS["length"][self.fields["position"].value["unit"]]
            v = np.gradient(p, table.t, axis=0)
            motion = changes(table.times, v[np.searchsorted(table.t, table.times)])
        force = table.acceleration(motion, self.taken)
        if force is not None:
            self._force(force)
        named = [g for g in table.named.get("rate", []) if not set(g) & set(self.taken)]
        rate = table.rate(self.streams["q"], self.taken) if "q" in self.streams else None
        if rate is not None:
            self._rate(rate.columns, 1 / rate.gain, f"correlation {rate.correlation:.3f} with the attitude's rate")
        elif named:
            self._rate(named[0], None, "by its name")

    def _rate(self, columns: list[int], gain: float | None, why: str) -> None:
        """Unit of a gyro: by its gain (rad/s a unit), or where nothing can be compared by its name or size."""
        x, written = self.table.x[:, columns], self.written(columns)
        if gain is None:
            spread = float(np.percentile(np.abs(x - np.median(x, axis=0)), 99))
            unit = str(written) if written in UNITS["rate"] else "deg/s" if spread > 15 else "rad/s"
            sure = 0.85 if unit == written else 0.6 if spread > 60 or spread < 8 else GUESS
            why += f"; 99 % of its values within {spread:.3g}"
        else:
            apart = {unit: abs(np.log(gain / factor)) for unit, factor in UNITS["rate"].items()}
            unit = min(apart, key=lambda name: apart[name])
            sure, why = SURE if apart[unit] < 0.7 else GUESS, f"{why}, {gain:.3g} rad/s a unit"
            if written in UNITS["rate"] and written != unit:
                sure, why = GUESS, f"{why}; but the name says {written}"
        self.propose("rate", columns, sure, why, unit=unit)
        self.read("w", columns, UNITS["rate"][unit])

    def _force(self, force: Match) -> None:
        """Unit of an accelerometer from its mean size, which in flight is about that of gravity."""
        size = float(np.linalg.norm(self.table.means[:, force.columns], axis=1).mean())
        written, factors = self.written(force.columns), UNITS["acceleration"]
        near: dict[str | float, float] = {unit: 9.81 / factor for unit, factor in factors.items()}
        near |= {count: count for count in COUNTS_PER_G}
        unit = min(near, key=lambda name: abs(np.log(max(size, 1e-9) / near[name])))
        sure = SURE if abs(np.log(max(size, 1e-9) / near[unit])) < 0.4 else GUESS
        why, factor = f"its mean size is {size:.4g}", factors.get(str(unit), 0.0)
        lines: dict[str, Any] = {"unit": unit}
        if unit in COUNTS_PER_G and written not in factors:
            lines, factor, why = {"unit": "g", "scale": 1 / near[unit]}, factors["g"] / near[unit], f"{why}: counts a g"
            sure = min(sure, 0.75)
        elif size < 0.5 and written != "g":
            lines, factor, sure = {"unit": "m/s^2", "kind": "coordinate"}, 1.0, GUESS
            why += ": gravity is not in it"
        elif written in factors and written != unit:
            lines, factor, sure = {"unit": written}, factors[written], GUESS
            why += f", which would be {unit}; but the name says {written}"
        self.propose("acceleration", force.columns, sure, f"{why}; correlation {force.correlation:.3f}", **lines)
        if "kind" not in lines:
            self.read("f", force.columns, factor)

    # ----------------------------------------------------------------------------------------------------- frames
    def frames(self) -> None:
        """Order and direction of the quaternion, world and body, and whether the velocity is in the body."""
        if "q" not in self.streams or not {"p", "v", "f"} & self.streams.keys():
            self._unproved()
            return
        log = Windows(self.table.times, self.streams)
        if not {"p", "v"} & self.streams.keys():  # gravity alone has to explain the accelerometer
            log = Windows(log.t, {**self.streams, "v": np.zeros((*log.t.shape, 3))})
        few = log.every(max(1, len(log.t) // FEW))
        scored = [(value, one) for one in self._conventions() if (value := _explained(one, few)) is not None]
        scored.sort(key=lambda pair: -pair[0])
        value, best = scored[0]
        after, self.lines = best.apply(log), [best]
        taken, after, _ = explain(after)
        taken = [one for one in taken if one.blocks]
        self.lines += taken
        self.streams = {name: after.streams[name] for name in self.streams}
        for key in ("world", "body", "attitude"):
            others = [(v, one) for v, one in scored if one.correction.get(key) != best.correction.get(key)]
            behind, rival = max(others, key=lambda pair: pair[0], default=(value - 2 * MARGIN, best))
            said = best.correction.get(key)
            text = f"log likelihood {value - behind:.1f} above that of {flow(rival.correction.get(key, PLAIN))}"
            sure = SURE if value - behind >= MARGIN else GUESS
            text += "" if sure == SURE else ": decide between both"
            if key == "attitude":
                old = self.fields[key]
                lines = {**old.value, **(said or {})}
                self.fields[key] = Proposal(lines, max(sure, old.confidence), f"{old.why}; {text}")
            else:
                about = WORLDS[str(said)][0] if key == "world" else "where the thrust points along z"
                self.fields[key] = Proposal(said, sure, f"{about}; {text}")
        if "velocity" in best.correction:
            self.fields["velocity"].value["frame"] = "body"
        if taken:
            why = "; ".join(f"{one.where}: {one.text}" for one in taken)
            self.fields["corrections"] = Proposal([one.correction for one in taken], SURE, why)

    def _conventions(self) -> list[Candidate]:
        """Every order and direction of the quaternion in every frame."""
        columns = self.places["attitude"]
        fixed = columns in self.table.named.get("attitude", []) and not numbered_quaternion(self.names, columns)
        readings = (
            [({}, 0.0)] if len(columns) == 3 else [({}, 0.0), *((lines, cost) for *_, lines, cost in READINGS[:3])]
        )
        readings = [(lines, cost) for lines, cost in readings if not (fixed and "order" in lines)]
        turned = [{}, {"velocity": {"frame": "body"}}] if "v" in self.streams else [{}]
        made = []
        for (lines, cost), (world, (_, more)), body, frame in product(readings, WORLDS.items(), BODIES, turned):
            correction = {"world": world, "body": body, **({"attitude": lines} if lines else {}), **frame}
            made.append(Candidate("", "pqvwf", "", correction, cost + more + bool(frame)))
        return made

    def _unproved(self) -> None:
        """The body's frame where there is no attitude to check it with: by the size of gravity."""
        if "f" in self.streams:
            mean = self.streams["f"].reshape(-1, 3).mean(axis=0)
            if abs(mean[2]) > 3 * np.abs(mean[:2]).max():
                body, why = "FLU" if mean[2] > 0 else "FRD", f"the accelerometer's mean along z is {mean[2]:+.3g}"
                self.fields["body"] = Proposal(body, LIKELY, why)
                self.lines = [Candidate("", "wf", "", {"body": body})]

    # ----------------------------------------------------------------------------------------------------- rotors
    def rotors(self) -> None:
        """The motors' commands or speeds, and which motor is where."""
        table, named = self.table, self.table.named
        known = [(kind, g) for kind in ("rotor_speed", "motor") for g in named.get(kind, [])]
        known = [(k, g) for k, g in known if not set(g) & set(self.taken) and np.ptp(table.x[:, g], axis=0).min() > 0]
        known = [(kind, g) for kind, g in known if table.x[:, g].min() >= -0.2 * table.x[:, g].max()]
        found = []
        for kind, columns in known or [("motor", g) for g in table.alike(4, self.taken)]:
            layout, rank = self._layout(columns), 0.0
            if "f" in self.streams:
                squares = (table.windows[..., columns] ** 2).sum(axis=2).mean(axis=1)
                rank = abs(float(np.corrcoef(squares, self.streams["f"][..., 2].mean(axis=1))[0, 1]))
            if known or layout or rank > 0.5:
                found.append((0.0 if known else rank + bool(layout), kind, columns, layout))
        for _, kind, columns, layout in sorted(found, key=lambda one: -one[0])[: None if known else 1]:
            quantity, lines, sure, why = self._range(columns, kind)
            if quantity in self.fields:
                continue
            if layout:
                lines["layout"] = layout
                why += "; places from the angular acceleration"
            elif len(columns) == 4:
                why += "; which is where is not clear: taken in the vehicle's order unless a `layout` is given"
            self.propose(quantity, columns, sure if known else min(sure, 0.55), why, **lines)

    def _range(self, columns: list[int], kind: str) -> tuple[str, dict[str, Any], float, str]:
        """Quantity and range or unit, by the size of the values."""
        x, name, written = self.table.x[:, columns], self.names[columns[0]].lower(), self.written(columns)
        largest, middle = float(x.max()), float(np.median(x))
        why = f"median {middle:.4g}, largest {largest:.5g}"
        if written == "erpm" or (kind == "rotor_speed" and "erpm" in name):
            why += "; electrical turns: pole_pairs is a guess, magnets of the motor over two"
            return "rotor_speed", {"unit": "erpm", "pole_pairs": 7}, GUESS, why
        if written in ("rpm", "rad/s", "Hz"):
            return "rotor_speed", {"unit": written}, 0.9, f"the name says the unit; {why}"
        if kind == "rotor_speed" and largest > 1.5:
            unit = "rpm" if middle > 3500 or "rpm" in name else "rad/s"
            return "rotor_speed", {"unit": unit}, LIKELY, f"named as speeds, {why}"
        if largest > 260 and any(other.startswith(("axisP[", "loopIteration")) for other in self.names):
            return "motor_command", {"range": [48, 2047]}, LIKELY, f"{why}: Betaflight counts"
        if 260 < largest <= 2200 and np.percentile(x, 1) > 850:
            return "motor_command", {"range": [1000, 2000]}, 0.8, f"{why}: pulse widths in us"
        for limit, low, high, text in RANGES:
            if largest <= limit:
                return "motor_command", {"range": [low, high]}, LIKELY, why + text
        if largest > 30_000:
            return "motor_command", {"range": [0, 65535]}, 0.8, f"{why}: 16 bits"
        return "rotor_speed", {"unit": "rpm"}, 0.5, why

    def _layout(self, columns: list[int]) -> list[str] | None:
        """Places of four motors, None where not clear: wx' ~ sum y_i T_i, wy' ~ -sum x_i T_i, so that the signs of a
        regression are those of the arms."""
        if len(columns) != 4 or "w" not in self.streams:
            return None
        table = self.table
        squares = (table.x[:, columns] / table.x[:, columns].mean()) ** 2
        mean = squares.mean(axis=1)
        first, last = max(runs(mean > 0.1 * np.percentile(mean, 95)), key=lambda run: run[1] - run[0])
        apart = squares - mean[:, None]  # what all motors do together turns nothing
        made = stretch(table.t[first:last], self._rates()[first:last], apart[first:last], np.eye(3))
        if made is None:
            return None
        found, shares = Fit(*made).columns()
        signs = zip(-found[1], found[0], strict=True)
        places = [BY_SIGNS[int(np.sign(x)) or 1, int(np.sign(y)) or 1] for x, y in signs]
        return places if len(set(places)) == 4 and shares[:2].min() > LEAST_EXPLAINED else None

    def _rates(self) -> np.ndarray:
        """Body rates of the whole table, (k, 3) (rad/s, FLU)."""
        value, columns = self.fields["rate"].value, self.places["rate"]
        w = self.table.x[:, columns] * UNITS["rate"][value["unit"]]
        for one in self.lines:
            lines = {key: value for key, value in one.correction.items() if key in ("body", "rate")}
            alone = Candidate("", "w", "", lines)
            w = alone.apply(Windows(self.table.t[None], {"w": w[None]})).streams["w"][0] if lines else w
        return w

    def others(self) -> None:
        """Battery and wind, by their names."""
        for columns in self.table.named.get("battery_voltage", [])[:1]:
            middle, unit = float(np.median(self.table.x[:, columns[0]])), self.written(columns)
            if unit not in ("V", "mV", "cV", "dV"):
                unit = "V" if middle < 60 else "dV" if middle < 280 else "cV" if middle < 6000 else "mV"
            value = {"column": self.names[columns[0]], "unit": unit}
            if middle > 0:
                self.fields["battery_voltage"] = Proposal(value, 0.8, f"median {middle:.4g}")
        for columns in self.table.named.get("wind", [])[:1]:
            self.propose("wind", columns, 0.6, "by its name alone", unit="m/s")


def _explained(one: Candidate, windows: Windows) -> float | None:
    """Evidence of a convention (log units), its cost taken off; None where the thrust is not along z in it.

    The drag of a log without accelerometer is the same in every convention: it is no reason to doubt one.
    """
    found = pairs(one.apply(windows))
    pull = next(pair.expected for pair in found if pair.relation.startswith(("force", "thrust"))).mean(axis=0)
    if np.argmax(np.abs(pull)) != 2 or pull[2] < 0:
        return None
    return sum(agreement(pair, min(pair.floor, FLOOR["force"])).evidence for pair in found) - PER_COST * one.cost
