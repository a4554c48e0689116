"""The data of a report: the rows of a comparison, their statistics, and the role of each contestant."""

from __future__ import annotations

import contextlib
import math
import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.outcome import UNFLOWN
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, read_record
from quadexp.names import distinct, sha256_of
from quadexp.parts.cells import Combinations, Grid
from quadexp.parts.override import in_grammar
from quadexp.parts.reads import is_read
from quadexp.parts.settings import flat, read_value
from quadexp.plugins.drawing.style import Look, looks
from quadexp.report.checked import Checked, check_flights
from quadexp.report.frame import RESULTS, read_results
from quadexp.report.notes import notes
from quadexp.report.pairing import (
    Condition,
    Contestant,
    Flights,
    Groups,
    Row,
    World,
    condition_of,
    contestant_labels,
    contestant_of,
    is_bound,
    is_invalid,
)
from quadexp.report.significance import Tests
from quadexp.report.statistics import CONFIDENCE, Statistic, Statistics, pooled, results_statistics
from quadexp.report.tables import course_labels
from quadexp.report.winner import Verdict, verdict

Record = Mapping[str, Any]  # metadata of a flight

AIR = {  # baseline -> controllers that are the same but for what they know of the air
    "nominal_mpc": {"linear_drag_mpc", "gp_mpc", "rls_mpc", "neural_mpc", "sum_mpc", "online_mpc", "streaming_gp_mpc"},
    "static_feedback": {"rls_feedback", "oracle_feedback"},
}
PATHS = ("model", "plant.model", "trajectory.path", "wind.path")  # keys of a flight that name a file or folder
BASELINES = ("nominal_mpc", "static_feedback")  # in this order, unless given
LOOKED_AT = 500  # flights whose settings are compared


@dataclass(frozen=True)
class Comparison:
    """Results with their statistics. metric: the main one. baseline: a controller's name. notes: on the rows.

    Scoreboard and ranking are of one plant and vehicle, the main `world`; the answer is of each. A label is a
    contestant's name.
    """

    root: Path
    rows: list[dict[str, Any]]
    record: Record
    statistics: Statistics
    metric: str
    baseline: str
    confidence: float
    digest: str
    notes: list[str]

    @cached_property
    def labels(self) -> dict[Contestant, str]:
        return contestant_labels(distinct(map(contestant_of, self.rows)))

    @cached_property
    def contestants(self) -> dict[str, Contestant]:
        return {label: contestant for contestant, label in self.labels.items()}

    def label(self, row: Row) -> str:
        return self.labels[contestant_of(row)]

    @cached_property
    def conditions(self) -> list[Condition]:
        return distinct(map(condition_of, self.rows))

    @cached_property
    def courses(self) -> dict[tuple[str, str], str]:
        """(trajectory, other settings) -> its name."""
        return course_labels((c.trajectory, c.setting) for c in self.conditions)

    def course_title(self, at: Condition) -> str:
        """The trajectory, with settings, plant and vehicle as far as they distinguish it from the others."""
        several = []
        for name, *names in zip(at.world, *self.worlds, strict=True):
            if len({*names}) > 1:
                several.append(name)
        return ", ".join([self.courses[at.trajectory, at.setting], *several])

    @cached_property
    def worlds(self) -> list[World]:
        return distinct((row["plant"], row["vehicle"]) for row in self.rows)

    @cached_property
    def world(self) -> World:
        """The plant and vehicle with most controllers, then with most flights."""
        flown = [row for row in self.rows if row["outcome"] not in UNFLOWN]

        def size(world: World) -> tuple[int, int]:
            mine = []
            for row in flown:
                if (row["plant"], row["vehicle"]) == world:
                    mine.append(self.label(row))
            return len(set(mine)), len(mine)

        return max(self.worlds, key=size)

    @cached_property
    def main_rows(self) -> list[dict[str, Any]]:
        """The rows of the main world."""
        return [row for row in self.rows if (row["plant"], row["vehicle"]) == self.world]

    @property
    def overall(self) -> dict[str, Statistic]:
        """Label -> comparison with the baseline over all conditions of the main world."""
        return self.by_world[self.world]

    @cached_property
    def by_world(self) -> dict[World, dict[str, Statistic]]:
        """Plant and vehicle -> label -> comparison with the baseline over all conditions there; the main one first."""
        worlds = dict.fromkeys((self.world, *self.worlds))
        by_world = {}
        for world in worlds:
            statistics = pooled(self.tests, self.groups.worlds[world], self.metric)
            by_world[world] = {s.label: s for s in statistics}
        return by_world

    @cached_property
    def groups(self) -> Groups:
        """All flights, with the main metric."""
        return Groups(self.rows, self.baseline, (self.metric,), self.labels)

    @cached_property
    def tests(self) -> Tests:
        """Of the main metric, as below the tables."""
        return Tests(self.groups, 0, self.confidence)

    @cached_property
    def verdicts(self) -> dict[World, Verdict]:
        """Plant and vehicle -> who has the least error there."""
        return {world: verdict(self.tests, self.groups.worlds[world]) for world in self.by_world}

    @property
    def verdict(self) -> Verdict:
        """Who has the least error in the main world."""
        return self.verdicts[self.world]

    def geometric_mean(self, label: str, *, over_own: bool = False) -> float:
        """Over the conditions, of the mean errors over the common flights, SI; NaN for a label that is not compared.

        over_own: over all its own completed flights.
        """
        errors = []
        contestant = self.contestants[label]
        for condition in self.groups.worlds[self.world]:
            flights = self.groups.cells.get((condition, contestant), ())
            seeds = {flight.seed for flight in flights if flight.complete}
            if not over_own:
                compared = contestant in self._common.compared
                seeds &= self._common.seeds.get(condition, frozenset()) if compared else frozenset()
            values = self.groups.values(condition, contestant, 0, seeds)
            values = values[np.isfinite(values)]
            if len(values) and np.mean(values) > 0:
                errors.append(np.mean(values))
        return float(np.exp(np.mean(np.log(errors)))) if errors else math.nan

    @cached_property
    def _common(self) -> Any:
        return self.groups.common(self.groups.worlds[self.world])

    @cached_property
    def order(self) -> list[str]:
        """Labels of the main world, by the share of completed flights, then by the error."""

        def place(label: str) -> tuple[float, bool, float]:
            share = self.success(label).share
            error = self.geometric_mean(label)
            return -share if share == share else 1.0, math.isnan(error), error

        return sorted(dict.fromkeys(map(self.label, self.main_rows)), key=place)

    @property
    def bounds(self) -> list[str]:
        return [label for label in self.order if is_bound(self.contestants[label].controller)]

    @cached_property
    def reference(self) -> str | None:
        """Label of the baseline in the main world; None if it is not there once."""
        there = [label for label in self.order if self.contestants[label].controller == self.baseline]
        if len(there) == 1:
            return there[0]
        return None

    @property
    def rival(self) -> str:
        """Whom the answer compares with the baseline: the least error, or where that is its own, the nearest one."""
        if self.verdict.least == self.reference:
            return self.verdict.next
        return self.verdict.least

    @property
    def of_the_air(self) -> bool:
        """Whether the rival differs from the baseline by what it knows of the air, and by nothing else."""
        if not (self.reference and self.rival):
            return False
        alike = AIR.get(self.contestants[self.reference].controller, ())
        return self.contestants[self.rival].controller in alike

    @cached_property
    def _flown(self) -> dict[Contestant, Flights]:
        return self.groups.flights(self.groups.worlds[self.world])

    def success(self, label: str) -> Flights:
        """How many of its trials in the main world it completed; see report/pairing.py."""
        return self._flown.get(self.contestants[label], Flights(0, 0))

    @cached_property
    def look(self) -> dict[str, Look]:
        """Label -> look, in the order of the page; the look does not depend on that order."""
        of_label = looks(list(self.labels.values()))
        return {label: of_label[label] for label in dict.fromkeys((*self.order, *of_label))}

    @cached_property
    def checked(self) -> Checked:
        """Whether the files of the flights hold what the rows say."""
        return check_flights(self.root, self.rows)

    @cached_property
    def grids(self) -> list[Grid]:
        """The grids of the sweep; empty if the record does not have them."""
        return [tuple(map(tuple, grid)) for grid in self.record.get("grids", [])]

    def asked(self, row: Row) -> tuple[str, ...]:
        """The overrides of a row's cell; empty if the record does not have them."""
        cells = Combinations(self.grids)
        places = (i for i, other in enumerate(self.rows) if other["key"] == row["key"])
        if len(cells) == len(self.rows):
            return cells.overrides(next(places))
        return ()

    def command(self, row: Row) -> str:
        """What flies a row again in any folder; "" where the record of the results does not say."""
        asked = {text.partition("=")[0]: self.anywhere(text) for text in self.asked(row)}
        words = {key: text for key, text in asked.items() if is_read(key, "simulate")}
        config = flat((self.flight_record(row) or {}).get("config", {}))
        for key in (*PATHS, "controller.models"):
            if words and config.get(key):
                words[key] = self._file(key, config[key])
        out = ["--out", f"runs/{row['key']}.parquet"]  # several may have the same default
        if words:
            return shlex.join(["quadexp", "simulate", *self.conf, *words.values(), *out])
        return ""

    @property
    def conf(self) -> list[str]:
        """The user's configuration folders as words of a command."""
        words = []
        for folder in self.record.get("conf", ()):
            words += ["--conf", folder]
        return words

    def anywhere(self, text: str) -> str:
        """An override that means the same in any folder: with an absolute path where it names a file."""
        key, _, value = text.partition("=")
        path = read_value(value) if key in PATHS else None
        if path:
            return self._file(key, path)
        return text

    def _file(self, key: str, path: str | list[str]) -> str:
        """An override with a path, or a list of them, from the folder in which the sweep was flown."""
        folder = self.record.get("folder", "")
        whole = os.path.join(folder, path) if isinstance(path, str) else [os.path.join(folder, each) for each in path]
        return f"{key}={in_grammar(key, whole)}"

    def place(self, path: Path) -> str:
        """A path as commands name it; by its name alone where the record of the results says no folder either."""
        if "folder" in self.record:
            return str(path.absolute())
        return path.name

    def sampled(self) -> list[dict[str, Any]]:
        """At most LOOKED_AT rows, evenly chosen."""
        return self.rows[:: max(1, -(-len(self.rows) // LOOKED_AT))]

    def time(self, label: str, which: str = "median") -> float:
        """Time of the control step, s: median over its flights of their median or p99."""
        mine = []
        for r in self.main_rows:
            if self.label(r) == label and r["outcome"] == "ok":
                mine.append(r[f"solve_time_{which}"])
        if mine:
            return float(np.median(mine))
        return math.nan

    def period(self, label: str) -> float:
        """Time between two commands, s; NaN if no flight tells."""
        row = next((r for r in self.main_rows if self.label(r) == label and r["outcome"] != "failed"), None)
        if row is None:
            return math.nan
        config = (self.flight_record(row) or {}).get("config", {})
        rate = (config.get("controller") or {}).get("rate")
        return 1 / rate if rate else math.nan

    def flight_record(self, row: Row) -> dict[str, Any] | None:
        """Metadata of a row's flight; None if its file is missing, or was changed since it was written."""
        try:
            return read_record(CellStore(self.root).path(row["key"]), "flight")
        except (UsageError, DataError):
            return None

    def flight(self, row: Row) -> Flight | None:
        """The flight of a row; None if its file is missing, was changed, or holds no samples."""
        if self.flight_record(row) is None:  # Arrow can end the process over bytes that were changed
            return None
        with contextlib.suppress(UsageError, DataError):
            flight = read_flight(CellStore(self.root).path(row["key"]), check=False)
            if len(flight) > 1:
                return flight
        return None


def read_comparison(path: str | Path, *, baseline: str | None = None) -> Comparison:
    """Results folder (or its results.parquet) with statistics; UsageError or DataError if there is none."""
    root, every, record = read_results(path)
    rows = [row for row in every if not is_invalid(row)]  # the notes say how many there are
    if not rows:
        raise DataError(f"{path}: holds no flights; run the sweep again")
    flown = {row["controller"] for row in rows}
    if baseline is not None and baseline not in flown:
        raise UsageError(f"--baseline {baseline}: did not fly here; there are {', '.join(sorted(flown))}")
    asked = record.get("baseline")
    usual = next((str(name) for name in (asked, *BASELINES) if name in flown), asked or BASELINES[0])
    chosen = baseline or usual
    confidence = float(record.get("confidence", CONFIDENCE))
    digest = sha256_of((root / RESULTS if Path(path).is_dir() else Path(path)).read_bytes())
    return Comparison(
        root=root,
        rows=rows,
        record=record,
        statistics=results_statistics(every, baseline=chosen, confidence=confidence),
        metric=record.get("metric", "mean_error"),
        baseline=chosen,
        confidence=confidence,
        digest=digest,
        notes=notes(every),
    )
