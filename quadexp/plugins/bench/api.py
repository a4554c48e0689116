"""The leaderboard in the Python API: qx.bench."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from quadexp.api import OverrideLike, Scratch, overrides, progress_of, request_of
from quadexp.frames import Frame
from quadexp.log.store import read_table
from quadexp.parts.options import Folders, Place
from quadexp.plugins.bench.settings import Bench
from quadexp.report.table import Table


class Leaderboard(Frame):
    """Flights of a protocol, a row each. In a notebook it shows the ranks."""

    kind = "leaderboard"

    @property
    def notes(self) -> list[str]:
        """Who has no part, and why."""
        return list(self.attrs.get("notes", self.record.get("notes", ())))

    @property
    def boards(self) -> dict[str, Table]:
        """Name of a family of tasks -> the table of its ranks, best first."""
        from quadexp.plugins.bench.board import board_table, families_of
        from quadexp.plugins.bench.protocol import read_protocol
        from quadexp.report.metrics import from_columns

        rows = from_columns(self.columns_as_arrays())
        protocol = read_protocol()
        tables = {}
        for name, flights in families_of(rows).items():
            tables[name] = board_table(flights, title=name, metric=protocol.metric, baseline=protocol.baseline)
        return tables

    def summary(self) -> list[str]:
        return [f"leaderboard: {len(self)} flights of {self['entry'].nunique()} entries"]


def bench(
    *settings: OverrideLike, out: Place | None = None, conf: Folders = None, progress: bool = False, **keywords: Any
) -> Leaderboard:
    """Rank controllers by a protocol that does not change, as `quadexp bench`.

    settings: of engine and evaluate only. keywords: keys of `quadexp.plugins.bench.settings.Bench`, such as
    size="standard" or controllers=["NAME KEY=VALUE"], and of evaluate. out: a folder, where a run goes on that was
    interrupted; else the flights are kept as long as the table.
    Returns a row a flight; `boards` has the tables of ranks by family.
    Raises UsageError before anything is flown, also for results of another protocol. A flight that failed is a row with
    its cause, and counts as lost.
    """
    from quadexp.plugins.bench.board import FILE
    from quadexp.plugins.bench.run import bench as ranked_by

    folder = Scratch() if out is None else Path(out)
    asked = request_of(Bench, keywords)
    with progress_of("flights", progress) as shown:
        texts = overrides(settings, keywords, "evaluate")
        board = ranked_by(texts, asked, out=Path(folder), conf=conf, progress=shown)
    table = Leaderboard.of(*read_table(Path(folder) / FILE, "leaderboard"), folder)
    table.attrs["notes"] = [*board.notes, *board.failed]
    return table
