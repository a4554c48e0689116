"""Tables of numbers, text or HDF5: by the ready mapping whose columns they have, or under the names of a flight's
columns, as `quadexp export --to csv` writes them. By --mapping: see the importing package itself."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from quadexp.errors import DataError
from quadexp.log.schema import describe
from quadexp.parts.schema import conf_folder
from quadexp.plugins.logs.importers.mapping import Mapping, load_mapping
from quadexp.plugins.logs.importers.quantities import QUANTITIES, ROTORS, columns_of
from quadexp.plugins.logs.importers.raw import RawLog, clean_stream, read_mapped
from quadexp.plugins.logs.importers.table import Table, kind_of, open_table

ABOUT = "delimited text or HDF5, by --mapping or a ready mapping"


def recognises(path: Path, head: bytes | None) -> bool:
    return head is not None and kind_of(path, head) != ""


def read(path: Path, named: str) -> RawLog:
    """A table by its columns' names. Raises DataError where they say nothing."""
    table = open_table(path)
    for mapping in ready_mappings():
        missing = [name for name in mapping.signature if name not in table.columns]
        if named == mapping.name and missing:
            has = ", ".join(table.columns[:8])
            raise DataError(f"{path}: not of {named}: no column {missing[0]!r} (it has {has}, ...)")
        asked = named in ("auto", "csv", mapping.name)
        if asked and not missing and mapping.format == table.format:
            log = read_mapped(table, mapping)
            log.format = mapping.name
            return log
    if {"t", "p_x", "q_w"} <= set(table.columns) and all(describe(name).unit for name in table.columns):
        return _under_own_names(table)
    advice = f"pass --mapping FILE; `quadexp import --describe {path.name}` proposes one"
    raise DataError(f"{path}: a table of unknown origin ({', '.join(table.columns[:6])}, ...): {advice}")


def _under_own_names(table: Table) -> RawLog:
    """A table in the units and frames of a flight's columns, rotors in the vehicle's order."""
    log = RawLog("csv", {}, "quadexp")
    columns = table.read(table.columns, log.notes)
    for quantity, (names, *_) in QUANTITIES.items():
        if quantity in ROTORS:
            prefix = names[0].format("")
            count = sum(name.startswith(prefix) for name in columns)
            names = columns_of(quantity, count)
        if names and set(names) <= columns.keys():
            values = np.column_stack([columns[name] for name in names])
            log.streams[quantity] = clean_stream(table.path, quantity, columns["t"], values, log.notes)
    return log


@cache
def ready_mappings() -> tuple[Mapping, ...]:
    """The mappings of conf/import/, most particular first."""
    mappings = [load_mapping(file) for file in sorted((conf_folder() / "import").glob("*.yaml"))]
    return tuple(sorted((m for m in mappings if m.signature), key=lambda m: -len(m.signature)))
