"""From log files to flight files: import, quality check across the logs, write."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import QuadexpError, UsageError
from quadexp.experiment.vehicle_of import refuse_repeated, vehicle_named
from quadexp.log.schema import Flight
from quadexp.log.store import write_flight
from quadexp.parts.options import Folders
from quadexp.plugin import brought
from quadexp.plugins.logs.finding import Finding
from quadexp.plugins.logs.importers import Options, checked, import_log
from quadexp.progress import set_status
from quadexp.writer import check_output


@dataclass
class Outcome:
    """One log: what it became. path: of the flight, None where none was written, with the cause."""

    log: Path
    path: Path | None = None
    cause: str = ""
    summary: str = ""
    notes: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def lines(self) -> list[str]:
        """For people: one line on what it became, then what there is to say of it."""
        head = f"{self.summary} -> {self.path}" if self.path else f"NOT IMPORTED: {self.cause}"
        notes = [*self.notes, *(finding.message for finding in self.findings)]
        return [f"{self.log.name}: {head}", *(f"  {note}" for note in notes)]

    def record(self) -> dict[str, Any]:
        return {
            "log": self.log, "path": self.path, "cause": self.cause, "notes": self.notes,
            "findings": [finding.record() for finding in self.findings],
        }  # fmt: skip


def import_files(
    logs: Sequence[Path], out: Path, options: Options, *, vehicle: str | None = None, conf: Folders = None,
    force: bool = False, keep: bool = False,
) -> Iterator[Outcome]:  # fmt: skip
    """Write <out>/<name of the log>.parquet for every log that can be imported, one after the other.

    A log with a blocking finding, and a second log with the content of another, are not written unless `keep`.
    Raises UsageError where the request is wrong; what is wrong with one log is its outcome.
    """
    if not logs:
        raise UsageError("import: no log given")
    for log in logs:
        if not log.exists():
            raise UsageError(f"import: {log}: no such file or folder")
    paths = [out / f"{log.stem}.parquet" for log in logs]
    said = "several logs would be written to {path}: give them one by one, with other --out"
    refuse_repeated("import", paths, said)
    for path in paths:
        check_output(path, force=force)
    named = None if vehicle is None else vehicle_named(vehicle, conf)
    mapping = checked(options)
    seen: dict[str, str] = {}
    for place, (log, path) in enumerate(zip(logs, paths, strict=True), 1):
        set_status(f"{log}, {place} of {len(paths)}")
        try:
            flight, notes = import_log(log, named, options, mapping)
        except QuadexpError as error:
            yield Outcome(log, cause=str(error).removeprefix(f"{log}: "))
        except (MemoryError, RecursionError) as error:
            yield Outcome(log, cause=f"too large or too deeply nested to read ({type(error).__name__})")
        else:
            outcome = Outcome(log, notes=notes)
            check_flight = brought("services", "check_flight")
            if check_flight is None:
                outcome.notes.append("not checked: no installed plug-in has 'check_flight' (quadexp/plugins)")
            else:
                outcome.findings = check_flight(flight, named)
            yield _finish(outcome, flight, path, seen, keep, force)


def _finish(outcome: Outcome, flight: Flight, path: Path, seen: dict[str, str], keep: bool, force: bool) -> Outcome:
    """Write the flight, unless something blocks."""
    source = flight.metadata.get("source", {})
    content = source.get("sha256", str(outcome.log))
    if content in seen:
        twin = f"the same bytes as {seen[content]}"
        outcome.findings.insert(0, Finding("duplicate", "blocking", "the whole file", twin, "every flight once"))
    blocking = [finding for finding in outcome.findings if finding.blocks]
    if blocking and not keep:
        names = ", ".join(dict.fromkeys(finding.name for finding in blocking))
        outcome.cause = f"{names} (below); --keep writes it all the same"
        if path.exists():  # --force was given: what an earlier import made must not pass for this one
            path.unlink()
            outcome.cause += f"; the earlier {path} was removed"
        return outcome
    record: dict[str, Any] = {"findings": [finding.record() for finding in outcome.findings]} if source else {}
    write_flight(path, flight, force=force, **record)
    seen.setdefault(content, outcome.log.name)
    seconds = float(np.ptp(flight.t)) if len(flight) else 0.0
    summary = f"{source.get('format') or 'quadexp'}, {seconds:.1f} s"
    if "rate" in source:
        summary += f" at {source['rate']:.4g} Hz"
    if "cropped" in source:
        summary += " (log {:.1f} to {:.1f} s)".format(*source["cropped"])
    outcome.path = path
    outcome.summary = f"{summary}, {len(flight.columns)} columns"
    return outcome
