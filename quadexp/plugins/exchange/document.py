"""A file for another program: the numbers, and above them, as a comment, where they are from and what is lost."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp import __version__
from quadexp.errors import DataError, UsageError
from quadexp.experiment.vehicle_of import vehicle_named
from quadexp.models.checkpoint import load_model
from quadexp.names import sha256_of
from quadexp.parts.options import Folders
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.exchange.known import Known, Quantity, known_of
from quadexp.writer import check_output, write_text

OPTIONS = ("voltage", "motor_lag", "firmware")  # that only some targets use
MOST_LAG = 10.0  # s
OFFSETS = "constant accelerations of the fit (bias of the accelerometer, centre of mass beside the middle)"
UNKNOWN_EVERYWHERE = "inertia of the propellers, flapping, gains of the rate loop: not known here"


class Written(NamedTuple):
    """What a target makes of what is known. text: the file without its head. numbers: by name. lost: a line each.
    binary: in place of text, for a file that takes no comment: its head lies beside it. whole: whether the offsets of
    the fit are in it."""

    text: str
    numbers: Mapping[str, Quantity]
    lost: Sequence[str]
    binary: bytes | None = None
    whole: bool = False


@dataclass(frozen=True)
class Target:
    """A format. write: makes it, of what is known. suffix: of the file. title: what it is for. uses: those of OPTIONS
    that change it. comment: before and after every line of its head, or of the whole. asks: what `write` is given
    beside what is known, of firmware and path."""

    name: str
    write: Callable[..., Written]
    suffix: str
    title: str
    uses: frozenset[str] = frozenset()
    comment: tuple[str, str, str] = ("", "# ", "")
    asks: tuple[str, ...] = ()

    def __call__(
        self,
        source: str,
        *,
        out: Path | None = None,
        conf: Folders = None,
        vehicle: str | None = None,
        force: bool = False,
        **options: Any,
    ) -> tuple[dict[str, Path], dict[str, Any], list[str]]:
        """Write the file of a checkpoint folder, or of `vehicle=NAME` alone.

        vehicle: name; None: that of the checkpoint. options: see OPTIONS; None where not given.
        Returns name -> file, a record for json, and lines. Raises UsageError for what the target does not use, or needs
        and is not known.
        """
        for name in OPTIONS:
            if options.get(name) is not None and name not in self.uses:
                used = ", ".join(f"--{word.replace('_', '-')}" for word in sorted(self.uses)) or "none of them"
                raise UsageError(f"--{name.replace('_', '-')}: --to {self.name} does not use it; it uses {used}")
        known, origin = _known(source, vehicle, conf, options)
        path = out if out is not None else Path(f"{_stem(source)}_{self.name}{self.suffix}")
        check_output(path, force=force)
        more = {"path": path, "firmware": options.get("firmware")}
        written = self.write(known, *(more[name] for name in self.asks))
        lost = [*written.lost, *_lost(known, written.whole)]
        head = [f"{self.title}, written by quadexp {__version__}", *origin, self._voltage(known), ""]
        head += [*_table(written.numbers), "", "What is not in this file:", *(f"- {line}" for line in lost)]
        files = _write(path, written, self._comment(head), force)
        record = {"format": self.name, "files": files, "numbers": _records(written.numbers), "lost": lost}
        lines = [*_table(written.numbers), "not in the file:", *(f"  {line}" for line in lost)]
        return files, record, lines

    def _voltage(self, known: Known) -> str:
        if known.voltage is None or "voltage" not in self.uses:
            return "battery voltage: no number here depends on it"
        return f"battery voltage: {known.voltage:g} V"

    def _comment(self, head: Sequence[str]) -> str:
        """The head in the format's comments, which may not hold "--" in XML."""
        begin, before, end = self.comment
        lines = [f"{before}{line}".rstrip() for line in head]
        text = "\n".join(lines)
        if begin == "<!--":
            text = text.replace("--", "- -")
        return "\n".join(part for part in (begin, text, end) if part) + "\n"


XML = ("<!--", "", "-->")


def _write(path: Path, written: Written, head: str, force: bool) -> dict[str, Path]:
    if written.binary is not None:
        from quadexp.writer import written as writing

        beside = check_output(path.with_name(f"{path.name}.txt"), force=force)
        with writing(path, force=force) as file:
            file.write(written.binary)
        return {"model": path, "about": write_text(beside, head, force=force)}
    text = written.text
    if text.startswith("<?xml"):  # which has to come first
        first, _, text = text.partition("\n")
        head = f"{first}\n{head}"
    return {"file": write_text(path, head + text, force=force)}


def _known(source: str, named: str | None, conf: Folders, options: Mapping[str, Any]) -> tuple[Known, list[str]]:
    """What is known of a source, and lines on its origin."""
    voltage = options.get("voltage")
    lag = options.get("motor_lag")
    if voltage is not None and not 0 < voltage <= 1000:
        raise UsageError(f"--voltage {voltage:g}: must be above 0 and at most 1000 V")
    if lag is not None and not 0 < lag <= MOST_LAG:
        raise UsageError(f"--motor-lag {lag:g}: must be above 0 and at most {MOST_LAG:g} s")
    if source.startswith("vehicle="):
        name = source.partition("=")[2]
        if named not in (None, name):
            raise UsageError(f"export {source} --vehicle {named}: two vehicles; give one")
        vehicle = vehicle_named(name, conf)
        return known_of(vehicle, voltage=voltage, motor_lag=lag), [*_vehicle_line(vehicle), "model: none"]
    model = load_model(source)
    name = named or model.vehicle.get("name")
    if not name:
        raise UsageError(f"{source}: does not say its vehicle; add --vehicle NAME")
    vehicle = vehicle_named(name, conf)
    if model.vehicle.get("fingerprint") not in (None, vehicle.fingerprint):
        load_model(source, vehicle=vehicle)  # which says what differs
    rotors = getattr(getattr(model, "thrust", None), "rotors", vehicle.n_rotors)
    if rotors != vehicle.n_rotors:
        raise DataError(f"{source}: a thrust curve of {rotors} rotors, vehicle={name} has {vehicle.n_rotors}")
    file = Path(source) / "model.json" if Path(source).is_dir() else Path(source)
    lines = [
        f"model: {source} ({model.kind}), model.json sha256 {sha256_of(file.read_text(encoding='utf-8'))}",
        f"fitted to {model.dataset.get('flights', '?')} flights, data sha256 {model.dataset.get('sha256', 'not kept')}",
    ]
    return known_of(vehicle, model, voltage=voltage, motor_lag=lag), [*_vehicle_line(vehicle), *lines]


def _stem(source: str) -> str:
    """Of the file's name: the vehicle's, or that of the checkpoint folder."""
    if source.startswith("vehicle="):
        return source.partition("=")[2]
    path = Path(source).resolve()
    if path.is_file():
        return path.parent.name
    return path.name


def _vehicle_line(vehicle: Vehicle) -> list[str]:
    return [f"vehicle: {vehicle.name}, fingerprint {vehicle.fingerprint}"]


def _lost(known: Known, whole: bool) -> list[str]:
    """What is in no file, or only in one that has the whole model."""
    lines = []
    delay = getattr(getattr(known.model, "thrust", None), "delay", 0.0)
    if delay:
        lines.append(f"commands act {1e3 * delay:.3g} ms late (dead time)")
    if known.model is None:
        lines.append("the air: not known, its numbers are 0")
    offsets = [known.facts[f"offset_{axis}"].value for axis in "xyz"]
    if any(offsets) and not whole:
        lines.append(f"{OFFSETS}: {', '.join(f'{value:.3g}' for value in offsets)} m/s^2")
    return [*lines, UNKNOWN_EVERYWHERE]


def _text(value: Any) -> str:
    return " ".join(f"{number:.9g}" for number in np.ravel(value))


def _table(numbers: Mapping[str, Quantity]) -> list[str]:
    """A line each: name, value, 95 % interval, unit, origin."""
    lines = []
    for name, quantity in numbers.items():
        interval = quantity.interval or "no interval"
        words = [name, _text(quantity.value), interval, quantity.unit, quantity.origin, quantity.note]
        lines.append("  ".join(word for word in words if word))
    return ["name  value  95 % interval  unit  origin", *lines]


def _records(numbers: Mapping[str, Quantity]) -> list[dict[str, Any]]:
    records = []
    for name, quantity in numbers.items():
        half = quantity.half_width
        record = {"name": name, "value": np.asarray(quantity.value).tolist(), "unit": quantity.unit}
        record["half_width"] = None if half is None else np.asarray(half).tolist()
        record["origin"] = quantity.origin
        records.append(record | {"note": quantity.note})
    return records
