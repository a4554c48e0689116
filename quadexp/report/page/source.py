"""What a report is made from: the rows of a comparison, their statistics, and who takes which part in it."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.config.cells import Combinations, Grid
from quadexp.errors import DataError, UsageError
from quadexp.log.cell_store import CellStore
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, read_metadata, read_table
from quadexp.report.common import Flights
from quadexp.report.inference import Ratio
from quadexp.report.overall import Overall, overall
from quadexp.report.page.names import BASELINES
from quadexp.report.pairing import (
    Common,
    Condition,
    Contestant,
    Groups,
    World,
    condition_of,
    contestant_labels,
    contestant_of,
    is_bound,
)
from quadexp.report.statistics import CONFIDENCE, Statistic
from quadexp.report.statistics_file import results_statistics
from quadexp.report.style import Look, looks
from quadexp.report.tables import course_labels, from_columns
from quadexp.report.winner import Ranking, rank, ratio_of

RESULTS = "results.parquet"
TABLED = ("mean_error", "rmse", "max_error")


@dataclass(frozen=True)
class Comparison:
    """Results with their statistics. metric: the one that decides. baseline: a controller's name. notes: on rows."""

    root: Path
    rows: list[dict[str, Any]]
    record: Mapping[str, Any]
    statistics: list[Statistic]
    metric: str
    baseline: str
    confidence: float
    digest: str
    notes: list[str]

    @cached_property
    def labels(self) -> dict[Contestant, str]:
        return contestant_labels(list(dict.fromkeys(map(contestant_of, self.rows))))

    @cached_property
    def conditions(self) -> list[Condition]:
        return list(dict.fromkeys(map(condition_of, self.rows)))

    @cached_property
    def courses(self) -> dict[tuple[str, str], str]:
        """(trajectory, other settings) -> what it is called."""
        return course_labels((c[2], c[4]) for c in self.conditions)

    @cached_property
    def world(self) -> World:
        """The plant and vehicle that the answer speaks of: those that most controllers flew, then most flights."""
        who: dict[World, set[str]] = {}
        flights: dict[World, int] = {}
        for row in self.rows:
            world = row["plant"], row["vehicle"]
            if row["outcome"] not in ("failed", "infeasible"):
                who.setdefault(world, set()).add(self.label(row))
                flights[world] = flights.get(world, 0) + 1
        return max(flights, key=lambda w: (len(who[w]), flights[w])) if flights else self._first_world

    @property
    def _first_world(self) -> World:
        return self.rows[0]["plant"], self.rows[0]["vehicle"]

    @cached_property
    def worlds(self) -> list[World]:
        return list(dict.fromkeys((row["plant"], row["vehicle"]) for row in self.rows))

    @cached_property
    def main_rows(self) -> list[dict[str, Any]]:
        """The rows of the world that the answer speaks of."""
        return [row for row in self.rows if (row["plant"], row["vehicle"]) == self.world]

    @cached_property
    def overall(self) -> dict[str, Overall]:
        """Label -> comparison with the baseline over all conditions of that world."""
        made = overall(self.main_rows, metric=self.metric, baseline=self.baseline, confidence=self.confidence)
        return {self.labels[one.controller, one.model, one.variant]: one for one in made}

    @cached_property
    def groups(self) -> Groups:
        """The flights of the world of the answer, with the deciding metric."""
        return Groups(self.main_rows, self.baseline, (self.metric,))

    @cached_property
    def common(self) -> Common:
        """Who is compared in that world, and over which flights; see report/common.py."""
        return self.groups.common(self.groups.worlds.get(self.world, []))

    @cached_property
    def errors(self) -> dict[str, dict[Condition, float]]:
        """Label -> condition -> mean of the metric over the common flights (SI), in the world of the answer."""
        return self._means(common=True)

    @cached_property
    def own_errors(self) -> dict[str, dict[Condition, float]]:
        """As `errors`, over all flights that each ended well itself."""
        return self._means(common=False)

    def _means(self, *, common: bool) -> dict[str, dict[Condition, float]]:
        found: dict[str, dict[Condition, float]] = {}
        for condition, contestant in self.groups.cells:
            ended = {f.seed for f in self.groups.cells[condition, contestant] if f.outcome == "ok"}
            if common:
                ended &= self.common.seeds.get(condition, frozenset()) if contestant in self.common.compared else set()
            values = self.groups.values(condition, contestant, 0, ended)
            values = values[np.isfinite(values)]
            by_condition = found.setdefault(self.labels[contestant], {})
            if len(values):
                by_condition[condition] = float(np.mean(values))
        return found

    def geometric_mean(self, label: str, *, own: bool = False) -> float:
        """Of the errors over the conditions of the common flights, SI; NaN for who is not compared.

        own: over the conditions that it ended well in itself.
        """
        values = [v for v in (self.own_errors if own else self.errors).get(label, {}).values() if v > 0]
        return float(np.exp(np.mean(np.log(values)))) if values else math.nan

    def own_flights(self, label: str) -> int:
        """How many flights its own mean is over."""
        return self.success(label)[1]

    @cached_property
    def flyers(self) -> list[str]:
        """Labels of that world, in order of appearance."""
        return list(dict.fromkeys(map(self.label, self.main_rows)))

    @cached_property
    def order(self) -> list[str]:
        """Labels of that world: who ended the largest share of its flights well first, then the least error."""

        def place(label: str) -> tuple[float, bool, float]:
            share, error = self.success(label)[0], self.geometric_mean(label)
            return -share if share == share else 1.0, math.isnan(error), error

        return sorted(self.flyers, key=place)

    @cached_property
    def controllers(self) -> dict[str, str]:
        """Label -> controller."""
        return {label: contestant[0] for contestant, label in self.labels.items()}

    @property
    def bounds(self) -> list[str]:
        return [label for label in self.order if is_bound(self.controllers[label])]

    @cached_property
    def reference(self) -> str | None:
        """Label of the baseline in that world, where it flew and is one."""
        found = [label for label in self.flyers if self.controllers[label] == self.baseline]
        return found[0] if len(found) == 1 else None

    @property
    def rivals(self) -> list[str]:
        """Those that are neither bound nor baseline."""
        return [label for label in self.order if label not in self.bounds and label != self.reference]

    @cached_property
    def ranking(self) -> Ranking:
        """Of the rivals."""
        contestants = {label: contestant for contestant, label in self.labels.items()}
        return rank(self.groups, self.common, [contestants[x] for x in self.rivals], 0, self.confidence)

    @property
    def lead(self) -> str | None:
        """The rival with the least error over the common flights, whether by chance or not."""
        return None if self.ranking.least is None else self.labels[self.ranking.least]

    @property
    def alike(self) -> list[str]:
        """Rivals that are not distinguishable from the lead."""
        return [self.labels[one] for one in self.ranking.alike(self.confidence)]

    @property
    def flew_more(self) -> list[str]:
        """Who ended a larger share of its flights well than the lead."""
        return [x for x in self.order if self.lead and self.success(x)[0] > self.success(self.lead)[0]]

    @property
    def best(self) -> str | None:
        """The lead, where it is the only rival, or is told apart from the others and nobody flew more; else None."""
        return self.lead if not self.alike and not self.flew_more else None

    def to_bound(self, bound: str) -> Ratio:
        """Error of the lead over that of a bound: their ratio over the common flights, with its interval."""
        assert self.ranking.least is not None
        contestants = {label: contestant for contestant, label in self.labels.items()}
        return ratio_of(self.groups, self.common, self.ranking.least, contestants[bound], self.confidence)

    @cached_property
    def to_base(self) -> tuple[Ratio, float]:
        """Error of the lead over the baseline's, and the p of no difference for a lead chosen among the rivals."""
        assert self.reference is not None
        ratio = self.to_bound(self.reference)
        p = (len(self.ranking.ratios) + 1) * ratio.p
        return ratio, 1.0 if p > 1 else p

    @cached_property
    def _flown(self) -> dict[Contestant, Flights]:
        return self.groups.flights(self.groups.worlds.get(self.world, []))

    def success(self, label: str) -> tuple[float, int, int]:
        """Share, number and count of all its flights in that world that ended well; see report/common.py."""
        contestant = next(one for one, name in self.labels.items() if name == label)
        flown = self._flown.get(contestant, Flights(0, 0))
        return flown.share, flown.ended, flown.trials

    @cached_property
    def look(self) -> dict[str, Look]:
        """Label -> look, in the order of the page; who looks how does not depend on that order."""
        worn = looks(list(self.labels.values()))
        others = [label for label in self.labels.values() if label not in self.order]
        return {label: worn[label] for label in (*self.order, *others)}

    @cached_property
    def grids(self) -> list[Grid]:
        """What the sweep was asked for; empty where the record does not say."""
        return [tuple(map(tuple, grid)) for grid in self.record.get("grids", [])]

    @cached_property
    def _places(self) -> dict[str, int]:
        return {row["key"]: i for i, row in enumerate(self.rows)}

    def asked(self, row: Mapping[str, Any]) -> tuple[str, ...]:
        """The overrides of a row's cell, where the record says; else empty."""
        cells = Combinations(self.grids)
        return cells.overrides(self._places[row["key"]]) if len(cells) == len(self.rows) else ()

    def sample(self, count: int) -> list[dict[str, Any]]:
        """Metadata of at most `count` flights, spread over all of them."""
        chosen = self.rows[:: max(1, -(-len(self.rows) // count))]
        return [record for row in chosen if (record := self.flight_record(row)) is not None]

    def label(self, row: Mapping[str, Any]) -> str:
        return self.labels[contestant_of(row)]

    def select(self, metric: str) -> list[Statistic]:
        return [s for s in self.statistics if s.metric == metric]

    def time(self, label: str, which: str = "median") -> float:
        """Time of the control step, s: median over its flights of their median or p99."""
        mine = [r[f"solve_time_{which}"] for r in self.main_rows if self.label(r) == label and r["outcome"] == "ok"]
        return float(np.median(mine)) if mine else math.nan

    def period(self, label: str) -> float:
        """Time between two commands, s; NaN where no flight says."""
        row = next((r for r in self.main_rows if self.label(r) == label and r["outcome"] != "failed"), None)
        record = self.flight_record(row) if row else None
        rate = ((record or {}).get("config", {}).get("controller") or {}).get("rate")
        return 1 / rate if rate else math.nan

    def flight_record(self, row: Mapping[str, Any]) -> dict[str, Any] | None:
        """Metadata of a row's flight; None where its file is gone."""
        try:
            return read_metadata(CellStore(self.root).path(row["key"]), "flight")
        except (UsageError, DataError):
            return None

    def flight(self, row: Mapping[str, Any]) -> Flight | None:
        """The flight of a row; None where its file is gone or holds no samples."""
        try:
            flight = read_flight(CellStore(self.root).path(row["key"]), check=False)
        except (UsageError, DataError):
            return None
        return flight if len(flight) > 1 else None


def read_comparison(path: str | Path, *, baseline: str | None = None) -> Comparison:
    """Results folder (or its results.parquet) with statistics; UsageError or DataError where there is none."""
    path = Path(path)
    file = path / RESULTS if path.is_dir() else path
    columns, record = read_table(file, "results")
    rows = from_columns(columns)
    if not rows:
        raise DataError(f"{file}: holds no flights; run the sweep again")
    flown = {row["controller"] for row in rows}
    if baseline is not None and baseline not in flown:
        raise UsageError(f"--baseline {baseline}: did not fly here; there are {', '.join(sorted(flown))}")
    chosen = baseline or _baseline(record, flown)
    confidence = float(record.get("confidence", CONFIDENCE))
    statistics = results_statistics(file.parent, rows, baseline=chosen, confidence=confidence)
    return Comparison(
        root=file.parent,
        rows=rows,
        record=record,
        statistics=statistics.rows,
        metric=record.get("metric", "mean_error"),
        baseline=chosen,
        confidence=confidence,
        digest=hashlib.sha256(file.read_bytes()).hexdigest(),
        notes=statistics.notes,
    )


def _baseline(record: Mapping[str, Any], flown: set[str]) -> str:
    asked = record.get("baseline")
    return next((name for name in (asked, *BASELINES) if name in flown), asked or BASELINES[0])
