"""BibTeX for the methods that flew: of each part of the flights, the papers that its option states, and this program.

cite: torrente2021                 a key of conf/references.bib, or of references.bib in a --conf folder
cite: [sun2022, "Doe 2026, doi"]   several; other words become an entry of their own
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from quadexp import __version__
from quadexp.errors import QuadexpError, UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_metadata, read_text
from quadexp.names import distinct
from quadexp.parts.options import Folders, OptionFiles
from quadexp.report.frame import read_results
from quadexp.report.summary import kind_of

REFERENCES = "references.bib"
_ENTRY = re.compile(r"^@\w+\{([^,\s]+),.*?^\}", re.MULTILINE | re.DOTALL)
_WHO = ("controller", "model", "vehicle", "plant", "trajectory")


def bibtex(path: str | Path, conf: Folders = None) -> str:
    """The entries for a flight or the results of a sweep; a comment names every part without a paper.

    conf: folders of options, beside those that the results name. Raises UsageError for another kind of file."""
    kind = kind_of(Path(path))
    if kind not in ("flight", "results"):
        raise UsageError(f"{path}: is of kind {kind}; a flight or the results of a sweep can be cited")
    record, flights = read_flights(Path(path), kind)
    folders: Any = conf or ()
    paths = [folders] if isinstance(folders, (str, Path)) else list(folders)
    files = OptionFiles([*paths, *(folder for folder in record.get("conf", ()) if Path(folder).is_dir())])
    known = _references(files)
    entries: dict[str, str] = {}
    without: list[str] = []
    for group, option in distinct(part for flight in flights for part in _parts(flight)):
        papers = files.cited(group, option) if option in files.options(group) else []
        if not papers and group == "controller":
            without.append(f"% {group}={option}: its option states no paper (cite: KEY)")
        for paper in papers:
            entries[paper] = known.get(paper) or _in_words(paper)
    return "\n".join([*without, *entries.values(), _program(record)]) + "\n"


def read_flights(path: Path, kind: str) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The record of a file, and the records of its flights, one for each that differs in who flew what."""
    if kind == "flight":
        record = read_metadata(path, "flight")
        return record, [record]
    root, rows, record = read_results(path)
    differing = {tuple(row[name] for name in _WHO): row for row in rows if row["outcome"] != "invalid"}
    flights = []
    for row in differing.values():
        try:
            flights.append(read_metadata(CellStore(root).path(row["key"]), "flight"))
        except QuadexpError:  # its file has gone: what its row says
            named = {group: {"name": row[group]} for group in ("controller", "vehicle", "trajectory")}
            flights.append({"config": named})
    return record, flights


def _parts(flight: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Group and option of the parts of a flight, who flew first."""
    config = flight.get("config") or {}
    groups = sorted(config, key=lambda group: group != "controller")
    for group in groups:
        part = config[group]
        if isinstance(part, Mapping) and part.get("name"):
            yield group, str(part["name"])
    residual = (config.get("controller") or {}).get("residual", "none")
    for kind in [residual] if isinstance(residual, str) else residual:
        yield "model", str(kind)


def _references(files: OptionFiles) -> dict[str, str]:
    """Key -> entry, of all folders of options; the first counts."""
    known: dict[str, str] = {}
    for folder in files.folders:
        path = folder / REFERENCES
        if path.is_file():
            known = {entry[1]: entry[0] for entry in _ENTRY.finditer(read_text(path) or "")} | known
    return known


def _in_words(paper: str) -> str:
    key = re.sub(r"\W+", "", paper)[:24].lower()
    return f"@misc{{{key},\n  note = {{{paper}}}\n}}"


def _program(record: Mapping[str, Any]) -> str:
    commit = ((record.get("provenance") or {}).get("git") or {}).get("commit", "")
    version = __version__ + (f", commit {commit[:10]}" if commit else "")
    return f"""@software{{quadexp,
  title = {{{{quadexp: an experiment pipeline for aerodynamics-aware quadrotor trajectory tracking}}}},
  author = {{{{The quadexp developers}}}},
  version = {{{version}}}
}}"""
