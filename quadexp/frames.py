"""Flights, data sets and results as pandas tables: units in `attrs`, figures by `plot()`, HTML in notebooks.

attrs["units"] and attrs["frames"] name the unit and the frame of every column that has one (world ENU, body FLU);
attrs["record"] is what the file carries beside its columns: configuration, seed, outcome, versions, provenance.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np
import pandas as pd

from quadexp.errors import UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.outcome import UNFLOWN
from quadexp.log.schema import Flight as Log
from quadexp.log.schema import describe
from quadexp.log.store import read_flight, write_table
from quadexp.messages import html
from quadexp.models.checkpoint import load_model, load_report
from quadexp.names import sha256_of
from quadexp.plugin import service
from quadexp.writer import check_output

if TYPE_CHECKING:
    from quadexp.report.table import Table

SHOWN_ROWS = 6  # of a table in a notebook
SHOWN_COLUMNS = 12  # of it: as wide as a page


class Frame(pd.DataFrame):
    """A table with units; slices of it are of the same kind. kind: of file, see quadexp/log/store.py."""

    _metadata = ["_folder"]  # what pandas hands on beside attrs
    _folder: os.PathLike[str] | None = None
    kind = ""

    @property
    def _constructor(self) -> Any:
        return type(self)

    @classmethod
    def of(cls, columns: Mapping[str, np.ndarray], record: Mapping[str, Any], folder: Any = None) -> Self:
        """columns: name -> (k,). folder: where the files lie that it names, if any."""
        frame = cls(dict(columns))
        described = {name: describe(name, record.get("kind") or cls.kind) for name in columns}
        frame.attrs["units"] = {name: column.unit for name, column in described.items() if column.unit}
        frame.attrs["frames"] = {name: column.frame for name, column in described.items() if column.frame}
        frame.attrs["record"] = dict(record)
        frame._folder = folder
        return frame

    @property
    def record(self) -> dict[str, Any]:
        return dict(self.attrs.get("record", {}))

    def columns_as_arrays(self) -> dict[str, np.ndarray]:
        """Name -> (k,) of every column; truth values as 0 and 1."""
        kinds = {"b": np.int8, "i": None, "u": None, "f": None}
        return {str(name): self[name].to_numpy(kinds.get(self[name].dtype.kind, object)) for name in self}

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> Path:
        """Write it as a file that the commands read, and return its path. force: replace an existing file."""
        kind = self.record.get("kind") or self.kind
        path = check_output(Path(path), force=force)
        return write_table(path, self.columns_as_arrays(), self.record, kind, force=force)

    def summary(self) -> list[str]:
        """What it is, in a few lines."""
        return [f"{self.record.get('kind') or self.kind}: {len(self)} rows"]

    def _repr_html_(self) -> str:
        units = {name: unit for name, unit in self.attrs.get("units", {}).items() if unit != "1"}
        shown = pd.DataFrame(self).rename(columns=lambda name: f"{name} ({units[name]})" if name in units else name)
        table = shown.to_html(max_rows=SHOWN_ROWS, max_cols=SHOWN_COLUMNS, show_dimensions=True)
        return f"<pre>{html(chr(10).join(self.summary()))}</pre>" + table


class Flight(Frame):
    """One flight, a row a control instant: `flight["p_x"]`, `flight.outcome`, `flight.metrics["mean_error"]` (m).

    Columns: t (s), state p v (world; m, m/s) q (body to world, w first) w (body, rad/s), commanded thrusts u_i (N),
    the reference as ref_*, accelerometer acc_* (body, m/s^2), how the control step went; docs/guide.md has all.
    """

    kind = "flight"

    @classmethod
    def of(cls, columns: Mapping[str, np.ndarray], record: Mapping[str, Any], folder: Any = None) -> Self:
        frame = super().of(columns, record, folder)
        frame.attrs["samples"] = frame._digest()
        return frame

    def _digest(self) -> str:
        rows = pd.util.hash_pandas_object(self, index=False)
        return sha256_of(str([*self]).encode() + rows.to_numpy().tobytes())

    @property
    def record(self) -> dict[str, Any]:
        """What the file carries beside its columns; the numbers of a part of a flight are those of this part."""
        from quadexp.report.metrics import renewed

        record = super().record
        if "row" not in record or self._digest() == self.attrs.get("samples"):
            return record
        return renewed(Log(self.columns_as_arrays(), record))

    def columns_as_arrays(self) -> dict[str, np.ndarray]:
        """Name -> (k,) of every column, in the order of time; truth values as 0 and 1."""
        ordered = "t" not in self or self["t"].is_monotonic_increasing
        return super().columns_as_arrays() if ordered else self.sort_values("t", kind="stable").columns_as_arrays()

    @property
    def outcome(self) -> str:
        """ "ok", or what went wrong; see quadexp/log/outcome.py."""
        return str(self.record.get("outcome", "ok"))

    @property
    def metrics(self) -> dict[str, Any]:
        """The row of results: errors (m, rad), times (s), shares; {} for a recorded flight."""
        return dict(self.record.get("row", {}))

    def arrays(self) -> Log:
        """The flight as the library's own functions take it."""
        return Log(self.columns_as_arrays(), self.record)

    def summary(self) -> list[str]:
        from quadexp.report.summary import flight_lines

        return flight_lines(self.record) if self.metrics and len(self) else super().summary()

    def plot(self, *columns: str) -> Any:
        """A matplotlib figure: the named columns over time, or path, position error and thrusts."""
        return service("plot_flight", "plot")(self, columns)


class Dataset(Frame):
    """Residuals for learning, a row a transition: body velocity, rates, thrusts, and what the rigid body leaves.

    Columns: v_* (body, m/s), w_* (body, rad/s), u_i and thrust (N), a_* (body, m/s^2), tau_* (body, N m), dt (s).
    """

    kind = "residuals"

    def summary(self) -> list[str]:
        flights = self["flight"].nunique() if "flight" in self else 0
        return [f"residual data: {len(self)} transitions of {flights} flights"]


class Results(Frame):
    """A sweep, a row a flight: settings, outcome, errors (m), times (s). In a notebook it shows its error table."""

    kind = "results"

    @property
    def notes(self) -> list[str]:
        """What to know of the sweep, a line each."""
        return list(self.attrs.get("notes", ()))

    def rows(self) -> list[dict[str, Any]]:
        """The rows as the library's own functions take them."""
        from quadexp.report.metrics import SETTING_COLUMNS, from_columns

        if not self._is_whole():
            raise UsageError("tables and figures need all columns of results, and a row at least")
        rows = from_columns(self.columns_as_arrays())
        keys: dict[str, list[str]] = {}
        for row in rows:  # of joined tables: flights of one seed that differ in what no column names
            known = keys.setdefault(str([row[name] for name in SETTING_COLUMNS]), [])
            if row["key"] not in known:
                known.append(row["key"])
            if place := known.index(row["key"]):
                row["variant"] = f"{row['variant']} results={place + 1}".strip()
        return rows

    def _is_whole(self) -> bool:
        from quadexp.report.metrics import ROW_COLUMNS

        return len(self) > 0 and set(ROW_COLUMNS) <= set(self)

    def table(self, metric: str | None = None) -> Table:
        """The error table of a metric, "mean_error", "rmse" or "max_error": the command's own unless given."""
        from quadexp.report.tables import error_table

        return error_table(self.rows(), self._metric(metric), **self._options())

    def statistics(self, metric: str | None = None) -> pd.DataFrame:
        """Means, intervals and paired comparisons of a metric, a row a condition and controller; in its SI unit."""
        from quadexp.report.statistics import compute_statistics

        chosen = (self._metric(metric),)
        return pd.DataFrame([asdict(row) for row in compute_statistics(self.rows(), metrics=chosen, **self._options())])

    def plot(
        self,
        metric: str | None = None,
        *,
        x: str | None = None,
        by: str | Sequence[str] | None = None,
        facet: str | Sequence[str] | None = None,
        kind: Literal["lines", "heat"] | None = None,
    ) -> Any:
        """A matplotlib figure with any keys as axes: results.plot(x="controller.nodes").

        Without keys, what was swept chooses: error against speed, a panel a trajectory, a line a controller. by: a key
        for the lines. facet: for the panels. metric: a number of the flights.
        """
        from quadexp.report.frame import SweepFrame

        frame = SweepFrame(self.rows(), os.fspath(self._folder or "."), self.record)
        return service("plot_results", "plot")(
            frame, y=metric or self._metric(None), x=x, by=by, facet=facet, kind=kind
        )

    def flight(self, row: int = 0) -> Flight:
        """The flight of a row, counted from 0 in this table: results[results["outcome"] == "ok"].flight(0)."""
        if not -len(self) <= row < len(self):
            raise UsageError(f"row {row}: the table has {len(self)} rows")
        if self._folder is None:
            raise UsageError("these results do not say where their flights lie; load them by qx.load(FOLDER)")
        if self["outcome"].iloc[row] in (*UNFLOWN, "invalid"):
            raise UsageError(f"row {row} was not flown: {self['cause'].iloc[row]}")
        flown = read_flight(CellStore(os.fspath(self._folder)).path(self["key"].iloc[row]))
        return Flight.of(flown.columns, flown.metadata)

    def _options(self) -> dict[str, Any]:
        """Of the statistics, as far as the command settled them."""
        return {name: self.record[name] for name in ("baseline", "confidence") if name in self.record}

    def _metric(self, name: str | None) -> str:
        from quadexp.report.metrics import declare_record, tabled

        name = name or str(self.record.get("metric", "mean_error"))
        declare_record(self.record)
        if name not in tabled():
            raise UsageError(f"metric {name!r}: there are {', '.join(tabled())}")
        return name

    def _repr_html_(self) -> str:
        return self.table()._repr_html_() if self._is_whole() else super()._repr_html_()


class Checkpoint:
    """A checkpoint folder; goes wherever a path does: qx.simulate("controller=linear_drag_mpc", model=checkpoint).

    path: the folder. model: what was fitted (quadexp/models/base.py). report: what the fit says of flights that it has
    not seen.
    """

    def __init__(self, path: str | os.PathLike[str], folder: Any = None) -> None:
        self.path = Path(path)
        self.model = load_model(self.path)
        self.report = load_report(self.path)
        self._folder = folder  # a temporary one lives as long as this object

    def __fspath__(self) -> str:
        return str(self.path)

    def predict(self, data: pd.DataFrame) -> pd.DataFrame:
        """Mean and standard deviation of the residual at every row of `data`, which has the features as columns.

        Columns a_x .. (body, m/s^2), tau_x .. (body, N m), as far as the model has them, and a_x_std ..; of linear
        drag and networks the means alone. Raises DataError where a feature is missing, UsageError for an identified
        vehicle.
        """
        columns: dict[str, np.ndarray] = {}
        try:
            predictions = self.model.predict(_rows(data))
        except UsageError as error:
            raise UsageError(f"{self.path}: {error}") from None
        for output, residual in predictions.items():
            columns |= {output: residual.mean} | ({} if residual.variance is None else {f"{output}_std": residual.std})
        return pd.DataFrame(columns, index=data.index)

    def plot(self, data: pd.DataFrame) -> Any:
        """A matplotlib figure of the model with the rows of `data`: Gaussian processes over their features."""
        from quadexp.models.base import figure_of

        return figure_of(self.model, _rows(data), str(self.path))

    def summary(self) -> list[str]:
        """Kind, vehicle, data, outputs and range of validity, in a few lines."""
        from quadexp.report.summary import summarise

        lines = list(summarise(self.path)["lines"])
        return lines if self._folder is None else [lines[0].replace(str(self.path), "not saved"), *lines[1:]]

    def __repr__(self) -> str:
        return "\n".join(self.summary())

    def _repr_html_(self) -> str:
        return f"<pre>{html(chr(10).join(self.summary()))}</pre>"


def _rows(data: pd.DataFrame) -> Any:
    """A table as the models take it."""
    from quadexp.models.dataset import ResidualDataset

    return ResidualDataset({str(name): data[name].to_numpy() for name in data}, {})
