"""The flights of a sweep with the value of any key of the configuration beside each, whether it was swept or not.

The value is that of the configuration stored with the flight; `model.inducing` and the like are settings of the fit of
its checkpoint, as long as that is where the flight found it. A cell without a flight (invalid, failed) has no file:
the overrides that asked for it are in the record of the results.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from quadexp.errors import DataError, QuadexpError, UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.schema import describe
from quadexp.log.store import read_metadata, read_table
from quadexp.messages import suggestion
from quadexp.names import SPELLINGS, distinct
from quadexp.parts.cells import OPTION
from quadexp.parts.options import units
from quadexp.parts.schema import PARTS, REMEDIES, WORLD
from quadexp.parts.settings import canonical_text, flat, read_value
from quadexp.report.metrics import ROW_COLUMNS, TEXT_COLUMNS, declare_record, from_columns, is_own
from quadexp.report.pairing import setting_pairs

RESULTS = "results.parquet"
ALIASES = {"speed": "trajectory.speed"}
GROUPS = ("vehicle", "plant", "world", "trajectory", "controller", "model", "seed", *WORLD, "remedies", *REMEDIES)
# Columns of the rows that tell what was flown, in the order in which a figure considers them.
ASKED = ("vehicle", "plant", "trajectory", "trajectory.speed", "controller", "model", "seed")
SAME = ("vehicle", "plant", "trajectory", "controller", "model", "variant", "sources")  # of flights that share settings
MOST_GONE = 3  # of them that are tried where files are missing
MILLISECONDS = 0.1  # s, below which times are printed in milliseconds
SETTINGS_ASIDE = ("evaluate", "engine", "experiment", "collect", *SPELLINGS)  # nodes that decide no flight
Row = Mapping[str, Any]


class SweepFrame:
    """Rows of results, one a flight, with a column for every key. record: of the table; {} where there is none.
    configs: key of a row -> settings, of flights whose own file was read."""

    def __init__(
        self,
        rows: Sequence[Row],
        root: str | Path,
        record: Mapping[str, Any] | None = None,
        configs: Mapping[str, Mapping[str, Any]] | None = None,
    ) -> None:
        self.rows = list(rows)
        self.root = Path(root)
        self.record = record or {}
        declare_record(self.record)
        self._read = configs or {}
        self._configs: dict[tuple[Any, ...], dict[str, Any]] = {}
        self._gone: Counter[tuple[Any, ...]] = Counter()  # files of a group that could not be read
        self._columns: dict[str, list[Any]] = {}
        self._checkpoints: dict[str, dict[str, Any]] = {}

    @classmethod
    def read(cls, folder: str | Path) -> SweepFrame:
        """The last sweep of a folder; UsageError where it holds no results."""
        root, rows, record = read_results(folder)
        if not rows:
            raise DataError(f"{folder}: holds no flights; run the sweep again")
        return cls(rows, root, record)

    def where(self, kept: Sequence[bool]) -> SweepFrame:
        """The frame of some of its rows."""
        return self.taken([i for i, keep in enumerate(kept) if keep])

    def taken(self, order: Sequence[int]) -> SweepFrame:
        """The frame of the rows at these places, in this order."""
        frame = SweepFrame([self.rows[i] for i in order], self.root, self.record, self._read)
        frame._configs = self._configs
        frame._gone = self._gone
        return frame

    def column(self, name: str) -> list[Any]:
        """The value of a key or of a column of the results in every row; None where a flight does not have it.

        Raises UsageError for a name that no flight has.
        """
        name = ALIASES.get(name, name)
        if name not in self._columns:
            values = [self._value(row, name) for row in self.rows]
            if all(value is None for value in values) and name not in (*ROW_COLUMNS, *GROUPS, *ASKED, "wanted"):
                raise UsageError(f"{name}: no such column{suggestion(name, self.names)}")
            self._columns[name] = values
        return self._columns[name]

    def has(self, name: str) -> bool:
        """Whether there is such a key or column."""
        try:
            self.column(name)
        except UsageError:
            return False
        return True

    @cached_property
    def names(self) -> list[str]:
        """The columns of the results, and every key of a flight."""
        names = list(ROW_COLUMNS)
        for row in self.rows[:1]:
            names += filter(is_own, row)
        names += GROUPS
        for row in self.rows[:: max(1, len(self.rows) // 20)]:
            names += self._config(row)
            names += [f"model.{key}" for key in self._of_checkpoint(row["model"])]
        return distinct(names)

    @cached_property
    def swept(self) -> list[str]:
        """The keys that take several values, the one that varies slowest first; the seed among them."""
        texts = distinct(text for grid in self.record.get("grids") or () for axis in grid for text in axis)
        values_of = Counter(text.partition("=")[0] for text in texts)
        asked = [key for key, count in values_of.items() if count > 1]
        for row in self.rows:
            asked += [key for key, _ in setting_pairs(row["variant"])]
        parts = {"plant": ("world", *WORLD), "controller": ("remedies", *REMEDIES), "trajectory.speed": ("speed",)}
        named = {key.partition(".")[0] for key in asked}
        asked += [key for key in ASKED if not named.intersection(parts.get(key, ()))]
        swept = []
        for key in distinct(asked):
            if key.partition(".")[0] not in SETTINGS_ASIDE and len(self.values(key)) > 1:
                swept.append(key)
        return swept

    def values(self, name: str) -> list[Any]:
        """The different values of a column, without None; numbers sorted, texts in the order of the rows."""
        values = distinct(value for value in self.column(name) if value is not None)
        return sorted(values) if all(map(is_number, values)) else values

    def controllers(self, axes: Iterable[str]) -> list[str]:
        """The controller of every row with those remedies in its name that are not axes by themselves."""
        kept = [group for group in REMEDIES if group not in axes and "remedies" not in axes]
        controllers = []
        for row in self.rows:
            name, plus, _ = row["controller"].partition("+")
            controllers.append("+".join([name, *self._remedies(row, kept)]) if plus else name)
        return controllers

    # ---------------------------------------------------------------------------------------------------------- values
    def _value(self, row: Row, name: str) -> Any:
        if name == "trajectory.speed":
            return _plain(row["speed"])
        if name == "world":
            return str(row["plant"]).partition("/")[2] or "clean"
        if (name in (*ROW_COLUMNS, "wanted") and name not in PARTS) or is_own(name):
            return _plain(row.get(name))
        if name in ("vehicle", "plant", "trajectory", "controller"):
            return row[name]
        if name == "remedies":
            return "+".join(self._remedies(row, REMEDIES)) or "none"
        if name.startswith("model."):
            return self._of_checkpoint(row["model"]).get(name.removeprefix("model."))
        varied = dict(setting_pairs(row["variant"])) if row["key"] not in self._read else {}
        if name in varied:
            return read_value(varied[name])
        if name.endswith(f".{OPTION}"):  # its own name says it
            return self._value(row, name.partition(".")[0])
        config = self._config(row)
        value = _named(config.get(name, config.get(f"{name}.name")))
        if value is None and name in (*WORLD, *REMEDIES):  # what does nothing is left out of the record of a flight
            return "none"
        return value

    def _of_checkpoint(self, path: str | None) -> dict[str, Any]:
        """Settings of the fit, and the data, of a checkpoint that is still where the flight found it."""
        if path and path not in self._checkpoints:
            self._checkpoints[path] = {}
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
                payload = json.loads((Path(path) / "model.json").read_text(encoding="utf-8"))["payload"]
                about = dict(payload.get("settings") or {}) | dict(payload.get("dataset") or {})
                self._checkpoints[path] = {key: _named(value) for key, value in about.items()}
        return self._checkpoints.get(path or "", {})

    def _remedies(self, row: Row, groups: Iterable[str]) -> list[str]:
        chosen = [self._value(row, group) for group in groups]
        return [str(name) for name in chosen if name not in (None, "none")]

    def _config(self, row: Row) -> Mapping[str, Any]:
        """The settings of a flight by dotted key: its own, where its file was read; else as far as they do not depend
        on speed and seed, which are in its row: one file is read for all flights of a sweep that differ in these only.
        """
        key = row["key"]
        overrides = self.record.get("without_flight", {}).get(key)
        group: tuple[Any, ...] = (key,)
        if key not in self._read and overrides is None:
            group = tuple(row.get(name) for name in SAME)
        if group not in self._configs and self._gone[group] < MOST_GONE:
            try:
                if key in self._read:
                    config = self._read[key]
                elif overrides is not None:
                    parts = (override.partition("=") for override in overrides)
                    config = {name: read_value(value) for name, _, value in parts}
                else:
                    config = read_metadata(CellStore(self.root).path(key), "flight").get("config") or {}
                self._configs[group] = flat(config)
            except QuadexpError:  # a cell that has gone: what its row says has to do
                self._gone[group] += 1
        return self._configs.get(group, {})


def read_results(path: str | Path) -> tuple[Path, list[dict[str, Any]], dict[str, Any]]:
    """Folder, rows and record of the last sweep of a folder, or of its table; None for a column that it does not have.

    Raises UsageError where it holds no results.
    """
    file = Path(path)
    if file.is_dir():
        file = file / RESULTS
    if file.name == RESULTS and not file.is_file():
        raise UsageError(f"{path}: holds no results (made by `quadexp evaluate`)")
    columns, record = read_table(file, "results", required=("key", "outcome"))
    declare_record(record)
    return file.parent, [dict.fromkeys(ROW_COLUMNS) | row for row in from_columns(columns)], record


def _plain(value: Any) -> Any:
    """None for a missing number or text."""
    if value is None or value == "" or (isinstance(value, float) and math.isnan(value)):
        return None
    return value


def _named(value: Any) -> Any:
    """A value that can be compared and printed: the name of a part, a list as its text."""
    if isinstance(value, Mapping):  # of a checkpoint
        return value.get("name")
    if isinstance(value, (list, tuple)):
        return canonical_text(value)
    return _plain(value)


def is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def is_metric(name: str) -> bool:
    """Whether a column is a number of the flight itself, not a setting."""
    return is_own(name) or (name in ROW_COLUMNS and name not in (*TEXT_COLUMNS, "speed", "seed"))


def unit_of(key: str) -> str:
    """The unit of a key of the configuration; "" for an unknown one, and where there is none or its name (nodes)."""
    column = next((short for short, full in ALIASES.items() if key in (short, full)), "")
    if column:  # which the rows have too: no module of a part is imported for it
        return describe(column, "results").unit
    group, _, name = key.partition(".")
    unit = units(group).get(name, "") if name and group in PARTS else ""
    return "" if unit == name else unit


def with_unit(name: str, key: str) -> str:
    """The name of a key, such as "payload (kg)"."""
    unit = unit_of(key)
    return f"{name} ({unit})" if unit else name


def setting_text(key: str, value: Any) -> str:
    """A setting in words with its unit: "wind [4,0,0] m/s" of wind.velocity, "latency 30 ms", "nodes 20".

    Times below a tenth of a second are in milliseconds."""
    if isinstance(value, str):
        value = read_value(value)
    unit = unit_of(key)
    text = canonical_text(value)
    if is_number(value):
        factor, unit = _in_milliseconds(value, unit)
        text = f"{factor * value:.6g}"
    elif not text.startswith("["):
        unit = ""
    return f"{setting_name(key)} {text} {unit}".strip()


def _in_milliseconds(largest: float, unit: str) -> tuple[float, str]:
    """Factor and unit of numbers up to the largest one."""
    if unit == "s" and 0 < largest < MILLISECONDS:
        return 1e3, "ms"
    return 1, unit


def setting_column(key: str, texts: Sequence[str], beside: Sequence[str]) -> tuple[str, dict[str, str]]:
    """A swept setting as a column: its heading with the unit, and text of an override -> text in the column.

    Numbers are as in `setting_text` as long as no two values look the same. beside: all keys that have a column; the
    heading is the whole key where two names are the same."""
    numbers = {text: read_value(text) for text in texts}
    unit = unit_of(key)
    name = setting_name(key)
    if list(map(setting_name, beside)).count(name) != 1:
        name = key
    if all(map(is_number, numbers.values())):
        factor, unit = _in_milliseconds(max(numbers.values()), unit)
        columns = {text: f"{factor * value:.6g}" for text, value in numbers.items()}
        if len(set(columns.values())) == len(columns):
            return f"{name} ({unit})" if unit else name, columns
    return with_unit(name, key), {text: text for text in texts}


def setting_name(key: str) -> str:
    """The last part of a key in words; of a velocity what has it: "wind" of wind.velocity."""
    group, _, last = key.rpartition(".")
    if last == "velocity" and group:
        return group.rpartition(".")[2]
    return last.replace("_", " ")
