"""Tables of numbers, text or HDF5, by the ready mapping whose columns they have (by --mapping: importing.py)."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from quadexp.errors import DataError
from quadexp.log.importers.mapping import Mapping, load_mapping
from quadexp.log.importers.raw import RawLog, read_mapped
from quadexp.log.importers.table import kind_of, open_table
from quadexp.parts.schema import conf_folder

ABOUT = "delimited text or HDF5, by --mapping or a ready mapping"


def recognises(path: Path, head: bytes | None) -> int:
    return 0 if head is None or not kind_of(path, head) else 1


def read(path: Path, named: str) -> RawLog:
    """A table by the ready mapping whose columns it has. Raises DataError where there is none."""
    table = open_table(path)
    for mapping in ready_mappings():
        if named in ("auto", "csv", mapping.name) and set(mapping.signature) <= set(table.columns):
            if mapping.format == table.format:
                log = read_mapped(table, mapping)
                log.format = mapping.name
                return log
        elif named == mapping.name:
            missing = [name for name in mapping.signature if name not in table.columns]
            has = ", ".join(table.columns[:8])
            raise DataError(f"{path}: not of {named}: no column {missing[0]!r} (it has {has}, ...)")
    raise DataError(
        f"{path}: a table of unknown origin ({', '.join(table.columns[:6])}, ...): pass --mapping FILE;"
        f" `quadexp import --describe {path.name}` proposes one"
    )


@cache
def ready_mappings() -> tuple[Mapping, ...]:
    """The mappings of conf/import/, most particular first."""
    found = [load_mapping(file) for file in sorted((conf_folder() / "import").glob("*.yaml"))]
    return tuple(sorted((m for m in found if m.signature), key=lambda m: -len(m.signature)))
