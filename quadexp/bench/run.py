"""From a request to a leaderboard: models, flights, rows, tables, page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadexp.bench.board import (
    FILE,
    board_table,
    check_alike,
    check_cells,
    families_of,
    joined,
    markdown,
    read_board,
    update_markdown,
    write_board,
    write_page,
)
from quadexp.bench.entries import Entry, configs_of, field, read_entries, why_not
from quadexp.bench.models import make_model, make_network
from quadexp.bench.protocol import LATEST, Protocol, check_lock, check_size, read_protocol, with_fewer_seeds
from quadexp.bench.ranking import Row
from quadexp.errors import UsageError
from quadexp.experiment.evaluate import evaluate_cell
from quadexp.log.cell_store import CellStore
from quadexp.parts.cells import Cell
from quadexp.parts.compose import Composer, session
from quadexp.report.table import Table
from quadexp.sweeps.cluster.engines import opened
from quadexp.sweeps.engine import CellFunction, Engine
from quadexp.sweeps.plan import plan_cells
from quadexp.sweeps.sweep import SweepInterrupted, fly_cells

PAGE, MODELS = "leaderboard.html", "models"
SETTABLE = ("engine", "evaluate")
CALLS = 64  # flights that an entry has at least in the larger sizes


@dataclass(frozen=True)
class Leaderboard:
    """rows: of all entries. tables: of each family. files: name -> path. notes: what a reader should know."""

    protocol: Protocol
    rows: Sequence[Row]
    tables: Mapping[str, Table]
    files: Mapping[str, Path]
    notes: Sequence[str]

    @property
    def failed(self) -> list[Row]:
        return [row for row in self.rows if row["outcome"] == "failed"]


def bench(
    overrides: Sequence[str] = (),
    *,
    size: str = "quick",
    controllers: Sequence[str] = (),
    only: bool = False,
    add: Sequence[Path] = (),
    seeds: int = 0,
    version: int | None = None,
    out: Path | None = None,
    conf: Path | None = None,
    page: Path | None = None,
    target: Path | None = None,
    function: CellFunction = evaluate_cell,
    isolate: bool = True,
    progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> Leaderboard:
    """Fly what is missing of the protocol, write the leaderboard, and return it.

    overrides: of the engine and its limits, such as "evaluate.workers=1". controllers: entries beside the field; only:
    without the field. add: other leaderboards whose rows take part. seeds: only the first ones of the size; 0: all.
    version: of the protocol, None for the latest. out: a folder, results/bench_SIZE by default. conf: a configuration
    folder of your own. page: where to write it. target: a Markdown file to write the tables into. function: flies a
    cell. isolate: False flies in this process. progress: numbers of flights done and of all.
    Raises UsageError before anything is flown; also where results of different protocols meet.
    """
    for text in overrides:
        if text.partition("=")[0].partition(".")[0] not in SETTABLE:
            raise UsageError(f"{text!r}: what is flown is the protocol's; only {' and '.join(SETTABLE)} can be set")
    out = out or Path("results") / f"bench_{size}"
    with session(conf) as composer, opened(composer.compose(overrides), CALLS) as engine:
        protocol = read_protocol(LATEST if version is None else version)
        check_size(protocol, size)
        check_lock(protocol, composer)
        protocol, called = with_fewer_seeds(protocol, size, seeds)
        added = [(path, read_board(path)) for path in add]
        for path, rows in added:
            check_alike(rows, protocol.sha256, called, str(path))
        mine = read_entries(controllers, composer, protocol, conf)
        entries = [*read_entries([] if only else field(), composer, protocol, conf), *mine]
        entries = list({entry.name: entry for entry in entries}.values())
        if not entries and not added:
            raise UsageError("--only: nobody takes part; give --controller NAME, or --add FILE")
        store = CellStore(out)
        store.open()
        with store.emptied(), store.lock():
            store.clean()
            try:
                cells, notes = _cells(entries, protocol, size, composer, out / MODELS, say)
                _check_takes_part(mine, cells, notes)
                rows = _fly(cells, store, engine, function, isolate, progress)
            except KeyboardInterrupt:
                raise SweepInterrupted("what is flown is kept; run the same command to continue") from None
            finally:
                store.clean()
            made_by = {"protocol": protocol.version, "protocol_sha256": protocol.sha256, "size": called}
            rows = [{**row, **made_by} for row in rows]
            for path, more in added:
                rows = joined(rows, more, str(path)) if rows else list(more)
            check_cells(rows, str(out))
            return _write(rows, protocol, out, page, target, notes)


@dataclass(frozen=True)
class _Asked:
    """A flight that is asked for, and what its row says beside what came out."""

    cell: Cell
    key: str
    about: Mapping[str, Any]


def _cells(
    entries: Sequence[Entry],
    protocol: Protocol,
    size: str,
    composer: Composer,
    models: Path,
    say: Callable[[str], None],
) -> tuple[list[_Asked], list[str]]:
    """All flights, and why an entry has no part in a family."""
    found: list[_Asked] = []
    notes: list[str] = []
    for family in protocol.families.values():
        if not family.chosen(size)[0] or not entries:
            continue
        needed = any(entry.models and not entry.network for entry in entries)
        model = make_model(family, composer, models, say) if needed else None
        network = make_network(family, composer, models, say) if any(entry.network for entry in entries) else None
        for entry in entries:
            if entry.network and network is None:
                notes.append(
                    f"{entry.name} has no part in {family.name}: protocol {protocol.name} has no rule for networks"
                )
                continue
            flights = configs_of(entry, family, protocol, size, composer, network if entry.network else model)
            if why := why_not(flights[0][3]):
                notes.append(f"{entry.name} has no part in {family.name}: {why}")
                continue
            for task, world, texts, config in flights:
                cell = Cell(config, texts)
                about: dict[str, Any] = {"family": family.name, "task": task, "world": world, "entry": entry.name}
                about |= {"settings": entry.settings, "bound": int(entry.bound)}
                found.append(_Asked(cell, next(iter(plan_cells([cell]))), about))
    return found, notes


def _check_takes_part(entries: Sequence[Entry], asked: Sequence[_Asked], notes: Sequence[str]) -> None:
    """Raise UsageError where an entry that was asked for by name flies nowhere."""
    flying = {one.about["entry"] for one in asked}
    for entry in entries:
        if entry.name not in flying:
            raise UsageError(next(note for note in notes if note.startswith(f"{entry.name} has no part")))


def _fly(
    asked: Sequence[_Asked],
    store: CellStore,
    engine: Engine | None,
    function: CellFunction,
    isolate: bool,
    progress: Callable[[int, int], None],
) -> list[Row]:
    if not asked:
        return []
    cells = {one.key: one.cell for one in asked}  # two entries may be the same flight
    flown = fly_cells(list(cells.values()), store, engine, function=function, isolate=isolate, progress=progress)
    rows = {row["key"]: row for row in flown}
    return [{**rows[one.key], **one.about} for one in asked]


def _write(
    rows: Sequence[Row], protocol: Protocol, out: Path, page: Path | None, target: Path | None, notes: Sequence[str]
) -> Leaderboard:
    options: dict[str, Any] = {"metric": protocol.metric, "baseline": protocol.baseline}
    what = {family.name: family.what for family in protocol.families.values()}
    tables = {name: board_table(own, title=name, **options) for name, own in families_of(rows).items()}
    record = {"protocol": protocol.version, "protocol_sha256": protocol.sha256, "notes": list(notes)}
    files = {
        "leaderboard": write_board(out / FILE, rows, record),
        "page": write_page(page or out / PAGE, rows, protocol, notes),
    }
    if target is not None:
        files["markdown"] = update_markdown(target, markdown(rows, what=what, **options))
    return Leaderboard(protocol, rows, tables, files, notes)
