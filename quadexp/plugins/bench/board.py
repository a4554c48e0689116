"""The rows of a leaderboard as a Parquet file, and as tables for the terminal and Markdown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.log.store import read_table, read_text, write_table
from quadexp.names import distinct
from quadexp.plugins.bench.protocol import SHORT
from quadexp.plugins.bench.ranking import Standing, cell_of, standings
from quadexp.plugins.page.typeset import duration
from quadexp.provenance import provenance
from quadexp.report.inference import least_seeds
from quadexp.report.metrics import from_columns, metric_of, to_columns
from quadexp.report.pairing import Row, Rows, grouped
from quadexp.report.table import Table
from quadexp.report.text import count, listed, number, too_few
from quadexp.writer import check_output, write_text

FILE = "leaderboard.parquet"
TEXTS = ("entry", "settings", "family", "task", "world", "size", "protocol_sha256")
NUMBERS = ("protocol", "bound")
BEGIN = "<!-- bench: begin (written by the command; edit nothing up to the end) -->"
END = "<!-- bench: end -->"
RULE = (
    "Place: entries whose number of lost flights is not significantly different from the fewest come first, by mean"
    " rank over all cells (task, world, seed), in which lost flights share the last ranks; the others follow in the"
    " same way. In brackets the 95 % interval over the seeds. =: not significantly different from the entry above"
    " (paired permutation test of the seeds, p < 0.05 each). x least: geometric mean of the error over the least of"
    " each cell. This and the error over the baseline's use completed flights, (n): only n of them; an entry that"
    " loses the hard flights has less. Oracles are given the plant's equations and take no rank. settings: as"
    " shipped are those of a publication or, if there is none, of this program; those set by hand on seeds that are"
    " flown here have an advantage. step: median over the instants of the fastest loop, on the machine that flew; no"
    " part of the rank."
)


def write_board(path: Path, rows: Rows, record: Mapping[str, Any]) -> Path:
    """Write the rows of all entries."""
    columns = to_columns(rows)
    for name in TEXTS:
        columns[name] = np.array([str(row[name]) for row in rows], dtype=object)
    for name in NUMBERS:
        columns[name] = np.array([int(row[name]) for row in rows])
    return write_table(path, columns, {**record, "provenance": provenance()}, "leaderboard")


def read_board(path: Path) -> list[Row]:
    """The rows of a leaderboard; raises UsageError or DataError where it is none."""
    columns, _ = read_table(path, "leaderboard", required=("key", "outcome", *TEXTS, *NUMBERS))
    return [dict(row) for row in from_columns(columns)]


def joined(rows: Rows, more: Rows, where: str) -> list[Row]:
    """Rows of two leaderboards; of an entry that is in both, those of the first.

    Raises UsageError where they are of different protocols or sizes, or not of the same cells.
    """
    if rows:
        check_alike(more, str(rows[0]["protocol_sha256"]), str(rows[0]["size"]), where)
    entries = {row["entry"] for row in rows}
    together = [*rows, *(row for row in more if row["entry"] not in entries)]
    check_cells(together, where)
    return together


def check_alike(rows: Rows, sha256: str, size: str, where: str) -> None:
    """Raise UsageError where some rows are not of this protocol and size."""
    protocols = {str(row["protocol_sha256"])[:SHORT] for row in rows}
    sizes = {str(row["size"]) for row in rows}
    for what, asked, found in (("protocol", sha256[:SHORT], protocols), ("size", size, sizes)):
        others = sorted(found - {asked})
        if others:
            raise UsageError(
                f"{where}: is of {what} {', '.join(others)}, not {asked}: results of different {what}s are not ranked"
                " together"
            )


def check_cells(rows: Rows, where: str) -> None:
    """Raise UsageError where the entries of a family have not flown the same cells."""
    for family, of_family in families_of(rows).items():
        flown = grouped((row["entry"], cell_of(row)) for row in of_family)
        first, *others = flown
        for other in others:
            if {*flown[other]} != {*flown[first]}:
                raise UsageError(f"{where}: {other} and {first} have not flown the same cells of {family}")


def families_of(rows: Rows) -> dict[str, list[Row]]:
    """Rows by family, in their order."""
    return grouped((str(row["family"]), row) for row in rows)


def board_table(rows: Rows, *, metric: str, baseline: str, title: str = "") -> Table:
    """The standings of one family."""
    ranked = standings(rows, metric=metric, baseline=baseline)
    heads = ["place", "entry", "settings", "completed", "mean rank", "x least", f"error / {baseline}", "step"]
    notes = [f"{listed([s.entry for s in ranked if s.bound])}: oracle, not ranked"] if ranked[-1].bound else []
    seeds = len({row["seed"] for row in rows})
    if seeds < least_seeds(1):
        notes.append(f"{too_few(seeds, least_seeds(1), 0.95)}; no two are significantly different")
    return Table(heads, [*map(_line, ranked)], title, left=frozenset({1, 2}), notes=notes)


def _line(s: Standing) -> list[str]:
    def value(text: str, low: float, high: float, form: str = ".2f") -> str:
        return text + ("" if math.isnan(low) else f" [{low:{form}}, {high:{form}}]")

    def of_cells(text: str, cells: int) -> str:
        if cells < s.flights and text != "-":
            return f"{text} ({cells})"
        return text

    place = "oracle" if s.bound else f"{'= ' if s.level else ''}{s.place}"
    rank = "-" if s.bound else value(f"{s.rank:.2f}", s.rank_low, s.rank_high)
    ratio = "-" if math.isnan(s.ratio.value) else value(f"{s.ratio.value:.3g}", s.ratio.low, s.ratio.high, ".3g")
    least = of_cells(number(s.least), s.least_cells)
    ratio = of_cells(ratio, s.ratio_cells)
    ended = f"{s.flights - s.lost} of {s.flights}"
    step = duration(s.step).replace("µ", "u")
    return [place, s.entry, s.settings, ended, rank, least, ratio, step]


def error_table(rows: Rows, *, metric: str, by: Sequence[str] = ("world",), title: str = "") -> Table:
    """Geometric mean error of every entry, a line for each world (or task and world); lost flights beside it."""
    about = metric_of(metric)
    factor = about.factor
    unit = about.unit
    entries = distinct(str(row["entry"]) for row in rows)
    texts = []
    lines = grouped((tuple(str(row[name]) for name in by), row) for row in rows)
    for at, of_line in lines.items():
        flights = grouped((str(row["entry"]), row) for row in of_line)
        cells = []
        for entry in entries:
            error, lost = _mean(flights[entry], metric)
            text = number(factor * error)
            cells.append(f"{text} ({lost} lost)" if lost else text)
        texts.append([*at, *cells])
    return Table([*by, *entries], texts, title or f"geometric mean error ({unit})", left=frozenset(range(len(by))))


def _mean(rows: Rows, metric: str) -> tuple[float, int]:
    """Geometric mean over the completed flights (m), and how many were not."""
    errors = []
    for row in rows:
        if row["outcome"] == "ok" and float(row[metric]) > 0:
            errors.append(float(row[metric]))
    mean = math.exp(float(np.mean(np.log(errors)))) if errors else math.nan
    return mean, sum(row["outcome"] != "ok" for row in rows)


def markdown(rows: Rows, *, metric: str, baseline: str, what: Mapping[str, str]) -> str:
    """The board of every family, and its errors by world, in Markdown. what: a sentence for each family."""
    first = rows[0]
    about = f"Protocol v{first['protocol']} ({str(first['protocol_sha256'])[:SHORT]}), size {first['size']}"
    parts = [f"{about}, {count(len(rows), 'flight')}. {RULE}"]
    for name, of_family in families_of(rows).items():
        parts.append(f"### {name}\n\n{what.get(name, '').strip()}")
        parts.append(board_table(of_family, metric=metric, baseline=baseline).markdown().strip())
        parts.append(error_table(of_family, metric=metric).markdown().strip())
    return "\n\n".join(parts) + "\n"


def check_markdown(path: Path) -> str | None:
    """What the Markdown file of a leaderboard holds; UsageError where it has no marks, or cannot be written."""
    old = read_text(check_output(path, force=True))
    if old is not None and (BEGIN not in old or END not in old):
        raise UsageError(f"{path}: has no marks to write between: {BEGIN} and {END}")
    return old


def update_markdown(path: Path, text: str) -> Path:
    """Put a leaderboard between its marks in a Markdown file; raises as `check_markdown` does."""
    old = check_markdown(path)
    if old is None:
        return write_text(path, f"# Leaderboard\n\n{BEGIN}\n\n{text}\n{END}\n")
    before, rest = old.split(BEGIN, 1)
    return write_text(path, f"{before}{BEGIN}\n\n{text}\n{END}{rest.split(END, 1)[1]}")
