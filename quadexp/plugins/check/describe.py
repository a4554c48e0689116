"""A mapping proposed for a table of unknown origin: from the names of its columns, and from what the data obeys.

The names say which columns are what (columns.py): a table whose names say nothing needs a mapping by hand. Then every
order and direction of the quaternion with every world and body frame is a candidate of the search that `quadexp check`
has too, by the same evidence; what that search finds besides stands under `corrections`. Where the next best candidate
is less than search.MARGIN log units behind, the line is a guess that asks which of both it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.log.runs import period_of
from quadexp.messages import printable
from quadexp.physics.rotation import continuous
from quadexp.physics.state import norms
from quadexp.plugins.check.candidates import KEYS, READINGS, Candidate, flow
from quadexp.plugins.check.columns import Match, Table
from quadexp.plugins.check.search import MARGIN, PER_COST, agreement, explain
from quadexp.plugins.logs.column_names import groups, numbered_quaternion, unit_of
from quadexp.plugins.logs.importers.quantities import QUANTITIES
from quadexp.plugins.logs.importers.readers import reader_of
from quadexp.plugins.logs.importers.table import numbers, open_table
from quadexp.plugins.logs.signal.windows import RELATIONS, Windows, changes, pairs
from quadexp.plugins.logs.units import UNITS

SECONDS = {unit: UNITS["time"][unit] for unit in ("s", "ms", "us", "ns")}
RATES = (4.0, 8200.0)  # Hz, of loggers
EPOCHS = {"ns": 1e18, "us": 1e15, "ms": 1e12, "s": 1e9}  # since 1970: from 2001 on
SLOW = 0.1  # s: rows further apart do not show the motion
SLOWEST = 10.0  # s, between rows of a log whose times are since 1970
TUM = ["t", "x", "y", "z", "qx", "qy", "qz", "qw"]  # of a trajectory without a header
# Counts of a gyro for one deg/s, of 2000, 1000, 500 and 250 deg/s in 16 bits.
COUNTS_PER_DEGREE = (16.4, 32.8, 65.5, 131.0)
APART = 0.03  # of the logarithm: how near a gain is to a unit that is sure
LEAST_SAMPLES = 50  # of a column; of fewer a correlation of 0.3 may be chance
FULL_TURN, UPSIDE = 6.4, 1.6  # rad: larger angles are degrees; roll and pitch that stay below it are not
FEW = 60  # windows that every frame is tried on
SURE, LIKELY, GUESS = 0.95, 0.7, 0.4  # shares shown to a user; nothing is decided by them
WORLDS = {  # frame of the log's world: what it is, cost
    "ENU": ("z up; which way x points from north cannot be known from the data", 0.0), "NED": ("z down", 0.1),
    "z x y": ("y up", 2.5), "x -z y": ("y down", 2.5), "y z x": ("x up", 2.5), "z -y x": ("x down", 2.5),
}  # fmt: skip
MISFITS = ("misfit", "inconsistent")  # findings that nothing proposed explains: then no frame is sure
KEY_LETTERS = {key: letter for letter, key in KEYS.items()}
SENSORS_APART: tuple[tuple[str, dict[str, Any]], ...] = (
    *((key, {"frame": frame}) for key in ("acceleration", "rate") for frame in ("FLU", "FRD")),
    ("acceleration", {"frame": "world"}), ("acceleration", {"kind": "coordinate"}),
    ("acceleration", {"frame": "world", "kind": "coordinate"}),
)  # fmt: skip
OF_ALL = 40  # conventions of all streams, the likeliest, with which those of single sensors are tried
AGAINST_NAMES = 2.0  # cost of a quaternion whose columns are not what they are called
PLAIN = {"order": "wxyz", "direction": "body_to_world"}
BODIES = ("FLU", "FRD", "z x y", "x z -y", "y z x", "z -y x")
# Units of position and velocity: gain of the velocity over the derivative.
GAINS = {("m", "m/s"): 1.0, ("m", "mm/s"): 1e3, ("mm", "m/s"): 1e-3, ("m", "cm/s"): 100.0, ("cm", "m/s"): 0.01}
COUNTS_PER_G = (2048.0, 4096.0, 512.0, 8192.0)  # of MPU and ICM accelerometers, of 16, 8, 4 and 64 g in 16 bits
# Largest value of a motor's command, what else must hold, how sure, values of command 0 and 1, what they are.
RANGES = (
    (1.5, "", LIKELY, 0, 1, ""), (110, "", LIKELY, 0, 100, ""), (260, "", LIKELY, 0, 255, ""),
    (np.inf, "betaflight", LIKELY, 48, 2047, ": Betaflight counts"),
    (2200, "pulses", 0.8, 1000, 2000, ": pulse widths in us"),
    (2200, "", LIKELY, 0, 2000, ": DShot or Betaflight counts"), (np.inf, "bits", 0.8, 0, 65535, ": 16 bits"),
)  # fmt: skip


class Proposal(NamedTuple):
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
        lines = [f"no {name} was recognised: what needs it is not possible with this log" for name in missing]
        if not set(self.fields) - {"time", "world", "body", "crop"}:
            lines.append("no column was recognised: add the quantities by hand, an import needs one at least")
        if "attitude" not in self.fields:
            lines.append("without an attitude neither frames nor directions can be checked")
        return lines

    def yaml(self) -> str:
        """The mapping, as `--mapping` takes it, with the confidence behind every line."""
        title = f"# {printable(self.path.name)}: proposed by `quadexp import --describe`; check what is not sure."
        lines = [title, f"format: {self.format}"]
        for key, (value, confidence, why) in self.fields.items():
            sureness = f"{self.fields[key].sureness} ({confidence:.0%})"
            lines += [f"# {key}: {sureness}: {printable(why)}", f"{key}: {flow(value)}"]
        return "\n".join([*lines, *(f"# note: {printable(text)}" for text in self.warnings), ""])

    def record(self) -> dict[str, Any]:
        fields = {key: {"confidence": proposal.confidence, "sureness": proposal.sureness, "why": proposal.why}
                  for key, proposal in self.fields.items()}  # fmt: skip
        mapping = {"format": self.format, **{key: proposal.value for key, proposal in self.fields.items()}}
        return {"path": self.path, "mapping": mapping, "fields": fields, "warnings": self.warnings}


def describe_log(path: Path) -> Description:
    """Propose a mapping for a table. Raises DataError for what is none, or has no clock."""
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        if (reader := reader_of(path)) != "csv":
            raise DataError(
                f"{path}: {reader} says itself what its fields are: it needs no mapping, import it as it is"
            )
        names, data = numbers(opened := open_table(path))
        clock, time = _clock(path, names, data)
        t = data[:, clock] * SECONDS[time.value["unit"]]
        good = np.isfinite(t)
        if good.sum() < LEAST_SAMPLES:
            raise DataError(f"{path}: {int(good.sum())} rows with a time: too few to propose a mapping from")
        known = TUM if names == [str(i) for i in range(8)] and _unit_norm(data[:, 4:]) else names
        table = Table(known, t[good] - t[good][0], data[good], clock)
        proposals = _Proposals(names, table)
        for look in (proposals.motion, proposals.sensors, proposals.frames, proposals.rotors, proposals.others):
            look()
    fields = proposals.fields
    fields = {"time": time} | {key: fields[key] for key in ("world", "body") if key in fields} | fields
    fields["crop"] = Proposal("auto", 0.9, "ground phases at the ends are cut off if there are any")
    return Description(path, opened.format, fields)


def _clock(path: Path, names: list[str], data: np.ndarray) -> tuple[int, Proposal]:
    """The column that increases most steadily, one that is named `time` before others and a mere counter last; its
    unit makes the rate one that loggers have. Raises DataError where no column increases from row to row."""
    named = {columns[0] for columns in groups(names).get("time", [])}
    scores = []
    for i, values in enumerate(data.T):
        values = values[np.isfinite(values)]
        steps = np.diff(values)
        if len(values) < max(20, 0.5 * len(data)) or (steps < 0).mean() > 0.05 or (steps > 0).mean() < 0.3:
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
        of_today = (unit for unit, size in EPOCHS.items() if 0.9 * size < first < 9 * size)
        since_1970 = [unit for unit in of_today if rates[unit] > 1 / SLOWEST]
        fitting = since_1970 or fitting
        unit = (fitting or ["s"])[0]
        why, sure = f"increases by {step:.6g} a row: {rates[unit]:.4g} Hz", 0.9 if fitting else GUESS
    return -place, Proposal({"column": column, "unit": unit}, sure, why)


def _unit_norm(values: np.ndarray) -> bool:
    return bool(np.nanquantile(np.abs(norms(values) - 1), 0.9) < 0.02)


def _nearest(value: float, sizes: Mapping[Any, float]) -> Any:
    """Whose size is nearest by ratio."""
    return min(sizes, key=lambda name: abs(np.log(max(value, 1e-12) / sizes[name])))


class _Proposals:
    """The lines of the mapping of one table, by quantity, and the streams that they give. streams: letter -> (n, l, m)
    in SI, in the log's own frames."""

    def __init__(self, names: Sequence[str], table: Table) -> None:
        self.names, self.table = names, table
        self.fields: dict[str, Proposal] = {}
        self.streams: dict[str, np.ndarray] = {}
        self.places: dict[str, list[int]] = {}

    def written(self, columns: list[int], dimension: str) -> str | None:
        """The unit that the first column's name says, if it is one of the dimension."""
        unit = unit_of(self.names[columns[0]])[1]
        return unit if unit in UNITS[dimension] else None

    def propose(self, quantity: str, columns: list[int], sure: float, why: str, letter: str = "", **more: Any) -> None:
        """letter: of the stream that is read with the unit and the scale proposed."""
        self.fields[quantity] = Proposal({"columns": [self.names[i] for i in columns], **more}, sure, why)
        self.places[quantity] = columns
        if letter:
            factor = UNITS[QUANTITIES[quantity].dimension][more["unit"]] * more.get("scale", 1.0)
            self.streams[letter] = self.table.windows[..., columns] * factor

    @property
    def betaflight(self) -> bool:
        """Whether its blackbox_decode wrote the table."""
        return any(name.startswith(("axisP[", "loopIteration")) for name in self.names)

    # ---------------------------------------------------------------------------------------------------- columns
    def motion(self) -> None:
        """Position and velocity: as each other's derivative, or by their names."""
        pair = self.table.derivative()
        if pair is None:
            for letter, name, dimension in (("p", "position", "length"), ("v", "velocity", "velocity")):
                for columns in self.table.named.get(name, [])[:1]:
                    unit = self.written(columns, dimension) or next(iter(UNITS[dimension]))
                    self.propose(name, columns, LIKELY, "by its name alone", letter, unit=unit)
            return
        p, v = pair
        units, length, x = _nearest(v.gain, GAINS), self.written(p, "length"), self.table.x
        if GAINS[units] == 1.0 and length in ("mm", "cm"):
            units = (length, f"{length}/s")
        elif GAINS[units] == 1.0:  # two axes at least: a single one in mm is named by the search
            far, fast = np.ptp(x[:, p], axis=0), np.abs(x[:, v.columns]).max(axis=0)
            units = ("mm", "mm/s") if np.median(far) > 500 and np.median(fast) > 80 else units
        clear = abs(v.gain * UNITS["velocity"][units[1]] / UNITS["length"][units[0]] - 1) < 0.1
        sure = (SURE if v.correlation > 0.95 else 0.75) if clear else GUESS
        why = f"the velocity is {v.gain:.3g} times its derivative, correlation {v.correlation:.3f}"
        why += "" if clear else "; that factor fits no unit: look at the time's unit too"
        self.propose("position", p, sure, why, "p", unit=units[0])
        self.propose("velocity", v.columns, sure, why, "v", unit=units[1])

    def sensors(self) -> None:
        """Attitude, gyro and accelerometer, in the log's own frames."""
        table = self.table
        attitude = table.attitude()
        if attitude is not None:
            x = table.windows[..., attitude]
            self.streams["q"] = continuous(x.reshape(-1, 4)).reshape(x.shape)
            self.propose("attitude", attitude, GUESS, "norm 1", **PLAIN)
        if attitude is None and table.named.get("euler"):
            self._angles(table.named["euler"][0])
        v = self.streams.get("v")
        if v is None and "p" in self.streams:
            p = table.x[:, self.places["position"]] * UNITS["length"][self.fields["position"].value["unit"]]
            v = np.gradient(p, table.t, axis=0)[np.searchsorted(table.t, table.times)]
        force = table.acceleration(None if v is None else changes(table.times, v))
        if force is not None:
            self._force(force)
        named = table.named.get("rate", [])
        rate = table.rate(self.streams["q"]) if "q" in self.streams else None
        if rate is not None:
            self._rate(rate.columns, 1 / rate.gain, f"correlation {rate.correlation:.3f} with the attitude's rate")
        elif named:
            self._rate(named[0], None, "by its name")

    def _angles(self, columns: list[int]) -> None:
        """Roll, pitch and yaw, their unit by their size; a yaw in degrees may stand beside roll and pitch in rad."""
        angles, largest = self.table.windows[..., columns], np.abs(self.table.x[:, columns]).max(axis=0)
        written, lines = self.written(columns, "angle"), dict[str, Any]()
        unit = written or ("deg" if largest.max() > FULL_TURN else "rad")
        factor = np.full(3, UNITS["angle"][unit])
        if written is None and largest[:2].max() < UPSIDE and largest[2] > FULL_TURN:
            unit, factor = "rad", np.array([1.0, 1.0, UNITS["angle"]["deg"]])
            lines = {"scale": [1.0, 1.0, float(f"{factor[2]:.7g}")]}
        why = f"named so; largest {', '.join(f'{x:.3g}' for x in largest)}"
        self.propose("attitude", columns, 0.5, why, order="rpy", unit=unit, **lines)
        if largest.max() > 0:
            turns = Rotation.from_euler("ZYX", (angles * factor)[..., ::-1].reshape(-1, 3))
            self.streams["q"] = continuous(turns.as_quat(scalar_first=True)).reshape(*angles.shape[:2], 4)

    def _rate(self, columns: list[int], gain: float | None, why: str) -> None:
        """Unit of a gyro: by its gain (rad/s a unit), or where nothing can be compared by its name or size."""
        x, written, scale = self.table.x[:, columns], self.written(columns, "rate"), 1.0
        if gain is None:
            spread = float(np.percentile(np.abs(x - np.median(x, axis=0)), 99))
            unit = written or ("deg/s" if spread > 15 else "rad/s")
            sure = 0.85 if written else 0.6 if spread > 60 or spread < 8 else GUESS
            why += f"; 99 % of its values within {spread:.3g}"
        else:
            sizes: dict[Any, float] = {**UNITS["rate"], **{n: UNITS["rate"]["deg/s"] / n for n in COUNTS_PER_DEGREE}}
            unit = _nearest(gain, sizes)
            apart = abs(np.log(gain / sizes[unit]))
            rival = _nearest(gain, {name: size for name, size in sizes.items() if name != unit})
            close = abs(np.log(gain / sizes[rival])) < max(2 * apart, APART)
            sure = SURE if apart < 5 * APART and not close else GUESS
            why += f", {gain:.4g} rad/s a unit"
            why += f"; or {rival} {'counts a deg/s' if rival in COUNTS_PER_DEGREE else ''}: decide" if close else ""
            if unit in COUNTS_PER_DEGREE:
                why += f": {unit} counts a deg/s"
                scale = 1 / unit
                unit = "deg/s"
            if written not in (None, unit):
                sure, why = GUESS, f"{why}; but the name says {written}"
        self.propose("rate", columns, sure, why, "w", unit=unit, **({"scale": scale} if scale != 1.0 else {}))

    def _force(self, force: Match) -> None:
        """Unit of an accelerometer from its mean size, which in flight is about that of gravity."""
        size = float(norms(self.table.means[:, force.columns]).mean())
        written = self.written(force.columns, "acceleration")
        sizes: dict[Any, float] = {unit: 9.81 / factor for unit, factor in UNITS["acceleration"].items()}
        sizes |= {count: count for count in COUNTS_PER_G}
        unit, letter = _nearest(size, sizes), "f"
        sure = SURE if abs(np.log(max(size, 1e-9) / sizes[unit])) < 0.4 else GUESS
        why, lines = f"its mean size is {size:.4g}", {"unit": unit}
        if unit in COUNTS_PER_G and written is None:
            lines, sure, why = {"unit": "g", "scale": 1 / unit}, min(sure, 0.75), f"{why}: counts a g"
        elif size < 0.5 and written != "g":
            lines, sure, letter = {"unit": "m/s^2", "kind": "coordinate"}, GUESS, ""
            why += ": gravity is not in it"
        elif written not in (None, unit):
            lines, sure, why = {"unit": written}, GUESS, f"{why}, which would be {unit}; but the name says {written}"
        why += f"; correlation {force.correlation:.3f}"
        self.propose("acceleration", force.columns, sure, why, letter, **lines)

    # ----------------------------------------------------------------------------------------------------- frames
    def frames(self) -> None:
        """Order and direction of the quaternion, world and body, and whether the velocity is in the body."""
        if "q" not in self.streams or not {"p", "v", "f"} & self.streams.keys() or period_of(self.table.t) > SLOW:
            self._body_by_gravity()
            return
        log = Windows(self.table.times, self.streams)
        still = not {"p", "v"} & self.streams.keys()  # gravity alone has to explain the accelerometer
        if still:
            log = Windows(log.t, {**self.streams, "v": np.zeros((*log.t.shape, 3))})
        few = log.every(max(1, len(log.t) // FEW))
        scored = _ranked(self._conventions(), few)
        likely = [candidate for _, candidate in scored[:OF_ALL]]
        scored += _ranked([other for candidate in likely for other in self._with_a_sensor_apart(candidate)], few)
        scored.sort(key=lambda pair: -pair[0])
        value, best = scored[0]
        taken, findings = explain(best.apply(log))
        mends = [candidate for candidate in taken if candidate.blocks]
        if still:  # nor what is left of it
            mends = [candidate for candidate in mends if "acceleration" not in candidate.correction]
        misfit = next((f"; but {each.where}: {each.measured}" for each in findings if each.name in MISFITS), "")
        for key in ("world", "body", "attitude"):
            chosen = best.correction.get(key)
            others = [(v, candidate) for v, candidate in scored if candidate.correction.get(key) != chosen]
            behind, rival = max(others, key=lambda pair: pair[0], default=(value - 2 * MARGIN, best))
            text = f"log likelihood {value - behind:.1f} above that of {flow(rival.correction.get(key, PLAIN))}"
            near = value - behind < MARGIN
            text += (": decide between both" if near else "") + misfit
            sure = GUESS if near or misfit else SURE
            if key == "attitude":
                lines, confidence, why = self.fields[key]
                chosen = _of_columns(chosen or {}, best.correction)
                if "scale" in chosen and "scale" in lines:
                    chosen = {"scale": [a * b for a, b in zip(chosen["scale"], lines["scale"], strict=True)]}
                self.fields[key] = Proposal({**lines, **chosen}, max(sure, confidence), f"{why}; {text}")
            else:
                about = WORLDS[str(chosen)][0] if key == "world" else "where the thrust points along z"
                self.fields[key] = Proposal(chosen, sure, f"{about}; {text}")
        for key in {"velocity", "acceleration", "rate"} & best.correction.keys():
            self.fields[key].value.update(best.correction[key])
        if mends:
            why = "; ".join(f"{candidate.where}: {candidate.text}" for candidate in mends)
            corrections = [candidate.correction for candidate in mends]
            self.fields["corrections"] = Proposal(corrections, GUESS if misfit else SURE, why + misfit)

    def _conventions(self) -> list[Candidate]:
        """Every order and direction of the quaternion in every frame."""
        columns = self.places["attitude"]
        fixed = columns in self.table.named.get("attitude", []) and not numbered_quaternion(self.names, columns)
        readings: list[tuple[dict[str, Any], float]] = [({}, 0.0)]
        if len(columns) == 3:
            signs = ([1, -1, 1], [-1, 1, 1], [1, 1, -1], [-1, -1, 1], [1, -1, -1], [-1, 1, -1])
            readings += [({"angles": each}, 0.6 + 0.2 * each.count(-1)) for each in signs]
        if len(columns) == 4:
            for *_, lines, cost in READINGS[:3]:
                against_names = AGAINST_NAMES if fixed and "order" in lines else 0.0
                readings.append((lines, cost + against_names))
        turned = [{}, {"velocity": {"frame": "body"}}] if "v" in self.streams else [{}]
        conventions = []
        for (lines, cost), (world, (_, more)), body, frame in product(readings, WORLDS.items(), BODIES, turned):
            correction = {"world": world, "body": body, **({"attitude": lines} if lines else {}), **frame}
            conventions.append(Candidate("", "pqvwf", "", correction, cost + more + bool(frame)))
        return conventions

    def _with_a_sensor_apart(self, candidate: Candidate) -> list[Candidate]:
        """The same, with one sensor in a frame of its own, or an accelerometer without gravity."""
        others = []
        for key, lines in SENSORS_APART:
            letter = KEY_LETTERS[key]
            if letter in self.streams and lines.get("frame") != candidate.correction["body"]:
                correction = candidate.correction | {key: lines}
                others.append(replace(candidate, correction=correction, cost=candidate.cost + len(lines)))
        return others

    def _body_by_gravity(self) -> None:
        """The body's frame where there is no attitude to check it with."""
        if "f" in self.streams:
            mean = self.streams["f"].reshape(-1, 3).mean(axis=0)
            if abs(mean[2]) > 3 * np.abs(mean[:2]).max():
                body, why = "FLU" if mean[2] > 0 else "FRD", f"the accelerometer's mean along z is {mean[2]:+.3g}"
                self.fields["body"] = Proposal(body, LIKELY, why)

    # ----------------------------------------------------------------------------------------------------- rotors
    def rotors(self) -> None:
        """The motors' commands or speeds, by their names; which motor is where says the check of the flight."""
        x = self.table.x
        for kind in ("rotor_speed", "motor"):
            for columns in self.table.named.get(kind, []):
                still = np.ptp(x[:, columns], axis=0).min() == 0
                if still or x[:, columns].min() < -0.2 * x[:, columns].max():
                    continue
                quantity, lines, sure, why = self._range(columns, kind)
                if quantity not in self.fields:
                    why += "; taken in the vehicle's order unless a `layout` is given: `quadexp check` says the order"
                    self.propose(quantity, columns, sure, why, **lines)

    def _range(self, columns: list[int], kind: str) -> tuple[str, dict[str, Any], float, str]:
        """Quantity and range or unit, by the size of the values."""
        x, name = self.table.x[:, columns], self.names[columns[0]].lower()
        written = self.written(columns, "rotor_speed")
        largest, middle = float(x.max()), float(np.median(x))
        why = f"median {middle:.4g}, largest {largest:.5g}"
        if written == "erpm" or (kind == "rotor_speed" and "erpm" in name):
            why += "; electrical turns: pole_pairs is a guess, magnets of the motor over two"
            hundreds = {"scale": 100} if self.betaflight else {}
            why += "; Betaflight logs hundreds of them" if hundreds else ""
            return "rotor_speed", {"unit": "erpm", "pole_pairs": 7, **hundreds}, GUESS, why
        if written in ("rpm", "rad/s", "Hz"):
            return "rotor_speed", {"unit": written}, 0.9, f"the name says the unit; {why}"
        if kind == "rotor_speed" and largest > 1.5:
            unit = "rpm" if middle > 3500 or "rpm" in name else "rad/s"
            return "rotor_speed", {"unit": unit}, LIKELY, f"named as speeds, {why}"
        said = {"": True, "betaflight": self.betaflight, "pulses": np.percentile(x, 1) > 850, "bits": largest > 30_000}
        for limit, holds, sure, low, high, what in RANGES:
            if largest <= limit and said[holds]:
                return "motor_command", {"range": [low, high]}, sure, f"{why}{what}"
        return "rotor_speed", {"unit": "rpm"}, 0.5, why

    def others(self) -> None:
        """Battery and wind, by their names."""
        for columns in self.table.named.get("battery_voltage", [])[:1]:
            middle = float(np.median(self.table.x[:, columns[0]]))
            by_size = "V" if middle < 60 else "dV" if middle < 280 else "cV" if middle < 6000 else "mV"
            if middle > 0:
                value = {"column": self.names[columns[0]], "unit": self.written(columns, "voltage") or by_size}
                self.fields["battery_voltage"] = Proposal(value, 0.8, f"median {middle:.4g}")
        for columns in self.table.named.get("wind", [])[:1]:
            self.propose("wind", columns, 0.6, "by its name alone", unit="m/s")


def _of_columns(reading: dict[str, Any], frames: Mapping[str, Any]) -> dict[str, Any]:
    """Signs of angles as a scale of their columns, where the frames leave roll, pitch and yaw what they are."""
    signs = reading.get("angles")
    plain = (frames["world"], frames["body"]) in (("ENU", "FLU"), ("NED", "FRD"))
    return {"scale": signs} if signs and plain and signs[2] == 1 else reading


def _ranked(conventions: Sequence[Candidate], windows: Windows) -> list[tuple[float, Candidate]]:
    """Those in which the thrust is along z, each with its evidence, the likeliest first."""
    scored = [(_explained(candidate, windows), candidate) for candidate in conventions]
    known = [(value, candidate) for value, candidate in scored if value is not None]
    return sorted(known, key=lambda pair: -pair[0])


def _explained(candidate: Candidate, windows: Windows) -> float | None:
    """Evidence of a convention (log units), its cost taken off; None where the thrust is not along z in it.

    The drag of a log without accelerometer is the same in every convention: it is no reason to doubt one.
    """
    relations = pairs(candidate.apply(windows))
    pull = next(pair.expected for pair in relations if pair.name.startswith(("force", "thrust"))).mean(axis=0)
    if np.argmax(np.abs(pull)) != 2 or pull[2] < 0:
        return None
    return (
        sum(agreement(pair, min(pair.relation.floor, RELATIONS["force"].floor)).evidence for pair in relations)
        - PER_COST * candidate.cost
    )
