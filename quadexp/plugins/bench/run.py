"""From a request to a leaderboard: models, flights, rows, tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.experiment.evaluate import evaluate_cell
from quadexp.log.cell_store import CellStore
from quadexp.names import named
from quadexp.parts.cells import Cell
from quadexp.parts.compose import Composer, session
from quadexp.parts.options import Folders
from quadexp.plugins.bench.board import (
    FILE,
    board_table,
    check_alike,
    check_cells,
    check_markdown,
    families_of,
    joined,
    markdown,
    read_board,
    update_markdown,
    write_board,
)
from quadexp.plugins.bench.entries import Entry, configs_of, field, make_model, read_entries, why_not
from quadexp.plugins.bench.protocol import Protocol, read_protocol, with_fewer_seeds
from quadexp.plugins.bench.settings import Bench
from quadexp.plugins.tune.flights import fly_cells, opened
from quadexp.report.pairing import Rows
from quadexp.report.table import Table
from quadexp.sweeps.engine import CellFunction, Progress
from quadexp.sweeps.plan import plan_cells
from quadexp.sweeps.sweep import flying

MODELS = "models"
CALLS = 64  # flights that an entry has at least in the larger sizes


@dataclass(frozen=True)
class Leaderboard:
    """rows: of all entries. tables: of each family. files: name -> path. notes: what a reader should know."""

    protocol: Protocol
    rows: Rows
    tables: Mapping[str, Table]
    files: Mapping[str, Path]
    notes: Sequence[str]

    @property
    def failed(self) -> list[str]:
        """A line that says which flights failed, where some did."""
        failed = [row for row in self.rows if row["outcome"] == "failed"]
        return [f"{len(failed)} flights failed; the first: {failed[0]['cause']}"] if failed else []


def bench(
    overrides: Sequence[str] = (),
    asked: Bench = Bench(),  # noqa: B008 - frozen
    *,
    out: Path | None = None,
    conf: Folders = None,
    function: CellFunction = evaluate_cell,
    isolate: bool = True,
    progress: Progress = lambda done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> Leaderboard:
    """Fly what is missing of the protocol, write the leaderboard, and return it.

    overrides: of the engine and its limits, such as "evaluate.workers=1". out: a folder, results/bench_SIZE by default.
    conf: a configuration folder of your own. function: flies a cell. isolate: False flies in this process.
    Raises UsageError before anything is flown; also where results of different protocols meet.
    """
    out = out or Path("results") / f"bench_{asked.size}"
    if asked.markdown is not None:
        check_markdown(asked.markdown)
    with session(conf) as composer, opened(composer.compose(overrides, "bench"), CALLS) as engine:
        protocol = read_protocol()
        protocol.check(asked.size, composer)
        protocol, called = with_fewer_seeds(protocol, asked.size, asked.seeds)
        added = [(path, read_board(path)) for path in asked.add]
        for path, rows in added:
            check_alike(rows, protocol.sha256, called, str(path))
        invited = read_entries(asked.controllers, composer, protocol, conf)
        entries = [*read_entries([] if asked.only else field(), composer, protocol, conf), *invited]
        entries = list({entry.name: entry for entry in entries}.values())
        if not entries and not added:
            raise UsageError("--only: nobody takes part; give --controller NAME, or --add FILE")
        store = CellStore(out)
        with flying(store, lambda: "interrupted"):
            flights, notes = _flights(entries, protocol, asked.size, composer, out / MODELS, say)
            flying_entries = {about["entry"] for _, about in flights}
            for entry in invited:
                if entry.name not in flying_entries:
                    raise UsageError(next(note for note in notes if note.startswith(f"{entry.name} has no part")))
            keys = [next(iter(plan_cells([cell]))) for cell, _ in flights]
            cells = named(keys, (cell for cell, _ in flights))  # two entries may fly the same
            done = fly_cells([*cells.values()], store, engine, function=function, isolate=isolate, progress=progress)
            flown = {row["key"]: row for row in done}
            made_by = {"protocol": protocol.version, "protocol_sha256": protocol.sha256, "size": called}
            rows = []
            for key, (_, about) in zip(keys, flights, strict=True):
                rows.append({**flown[key], **about, **made_by})
            for path, more in added:
                remaining = {r["entry"] for r in more} & {r["entry"] for r in rows} - {
                    r["entry"] for r in more if r["key"] in keys
                }
                notes += [
                    f"{name}: flown otherwise in {path}, whose rows of it are left out" for name in sorted(remaining)
                ]
                rows = joined(rows, more, str(path)) if rows else list(more)
            check_cells(rows, str(out))
            return _write(rows, protocol, out, asked, notes)


def _flights(
    entries: Sequence[Entry],
    protocol: Protocol,
    size: str,
    composer: Composer,
    models: Path,
    say: Callable[[str], None],
) -> tuple[list[tuple[Cell, dict[str, Any]]], list[str]]:
    """All flights, each with what its row says beside what comes out, and why an entry has no part in a family."""
    flights: list[tuple[Cell, dict[str, Any]]] = []
    notes: list[str] = []
    for family in protocol.families.values():
        if not family.chosen(size)[0]:
            continue
        rules = {entry.model: None for entry in entries if entry.model in family.models}
        checkpoints = {rule: make_model(family, rule, composer, models, say) for rule in rules}
        for entry in entries:
            if entry.model and entry.model not in checkpoints:
                notes.append(f"{entry.name} has no part in {family.name}: {protocol.name} has no rule for its model")
                continue
            configs = configs_of(
                entry, family, protocol, size, composer, checkpoints.get(entry.model, checkpoints.get("fit"))
            )
            why = why_not(configs[0][3])
            if why:
                notes.append(f"{entry.name} has no part in {family.name}: {why}")
                continue
            for task, world, texts, config in configs:
                about = {"family": family.name, "task": task, "world": world, "entry": entry.name}
                flights.append((Cell(config, texts), {**about, "settings": entry.settings, "bound": int(entry.bound)}))
    return flights, notes


def _write(rows: Rows, protocol: Protocol, out: Path, asked: Bench, notes: Sequence[str]) -> Leaderboard:
    options = {"metric": protocol.metric, "baseline": protocol.baseline}
    tables = {name: board_table(of_family, title=name, **options) for name, of_family in families_of(rows).items()}
    record = {"protocol": protocol.version, "protocol_sha256": protocol.sha256, "notes": list(notes)}
    files = {"leaderboard": write_board(out / FILE, rows, record)}
    if asked.markdown is not None:
        what = {family.name: family.what for family in protocol.families.values()}
        files["markdown"] = update_markdown(asked.markdown, markdown(rows, what=what, **options))
    return Leaderboard(protocol, rows, tables, files, notes)
