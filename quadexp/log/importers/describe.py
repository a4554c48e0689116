"""A mapping proposed for a table of unknown origin: from the names of its columns, and from what the data obeys.

Names only propose. What can be checked by physics is: which order and direction of a quaternion agrees with the gyro
and with the specific force, which velocity is the derivative of which position, what the accelerometer reads at rest.
Every field says how sure it is: sure (data and name agree, or data alone is clear), likely, guess.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from quadexp.errors import DataError
from quadexp.log.importers.attitude_search import find_attitude
from quadexp.log.importers.clock_search import SECONDS, find_clock
from quadexp.log.importers.description import Description
from quadexp.log.importers.detect import detect
from quadexp.log.importers.evidence import Samples, sample
from quadexp.log.importers.motion_search import Motion
from quadexp.log.importers.motor_search import find_battery, find_motors
from quadexp.log.importers.names import NOT_MEASURED, groups, hint
from quadexp.log.importers.number_columns import numbers
from quadexp.log.importers.proposal import Proposal
from quadexp.log.importers.table import open_table


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
    clock, unit, why, confidence = find_clock(path, names, data)
    t = data[:, clock] * SECONDS[unit]
    good = np.isfinite(t)
    if good.sum() < 50:
        raise DataError(f"{path}: {int(good.sum())} rows with a time: too few to propose a mapping from")
    samples = sample(t[good] - t[good][0], data[good])
    found = Description(path, {"time": Proposal({"column": names[clock], "unit": unit}, confidence, why)}, format=kind)
    usable = [i for i in range(len(names)) if i != clock and np.isfinite(samples.x[:, i]).all()]
    _fill(found, names, samples, usable)
    found.fields["crop"] = Proposal("auto", 0.9, "ground phases at the ends are cut off where there are any")
    return found


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
    if said.get("wind"):
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
