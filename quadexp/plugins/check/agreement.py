"""How well the streams of a flight agree with one another: the log likelihood of the relations' residuals, each axis
with a variance of its own, of INDEPENDENT windows (the errors of a sensor last: more windows of one flight do not tell
more),

    E = -INDEPENDENT / 2 sum over relations and axes of log(r^2 + floor^2)         (log units),

r the root mean square residual of the smaller nine tenths (spikes are another check's business).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quadexp.physics.state import norms, root_mean_square
from quadexp.plugins.check.candidates import COLUMNS
from quadexp.plugins.logs.finding import LEAVE_OUT, Finding
from quadexp.plugins.logs.signal.windows import Pair, Relation, Windows, pairs

INDEPENDENT = 60  # that a flight counts for, however long it is: a sensor's errors last
KEPT = 0.9  # share of the windows that a residual is taken over
LEAST_WINDOWS = 10  # fewer say too little
MOVES = ("velocity", "rate", "force", "force (p)")  # relations whose both sides move
DISAGREE = 0.7  # residual over signal above which two streams disagree
UNRELATED = 0.5  # correlation below which they do
MISFIT = 3.0  # floors: what is left of a relation's axis beyond is said, whatever was found
MOST_LEFT = 0.4  # of a misfit, or of a signal
INCONSISTENT = "compare the mapping with what `quadexp import --describe LOG` proposes, or leave the stream out of it"
STRAY = 12.0  # robust standard deviations
# Of a sensor that contradicts the others for a while: relations that tell, least (means over a window), columns.
STRAYING = {
    "acceleration_outlier": (("force", "force (p)"), 8.0, COLUMNS["f"]),  # m/s^2
    "rate_outlier": (("rate",), 4.0, COLUMNS["w"]),  # rad/s
}
FEW_STRAY = 0.005  # share of the windows: up to it, a knock
MANY_STRAY = 0.4  # share of the windows: from it on, something else than a stretch


@dataclass(frozen=True)
class Agreement:
    """Of one relation, without its worst windows: both sides, (n, 3); floor: what clean logs differ by."""

    relation: Relation
    expected: np.ndarray
    measured: np.ndarray
    floor: float

    @cached_property
    def residual(self) -> np.ndarray:
        """Root mean square by axis, (3,)."""
        return np.sqrt(np.mean((self.measured - self.expected) ** 2, axis=0))

    @cached_property
    def signal(self) -> np.ndarray:
        """Standard deviation by axis, (3,)."""
        return self.expected.std(axis=0)

    @cached_property
    def evidence(self) -> float:
        """Log units."""
        variance = self.residual**2 + self.floor**2
        return float(-INDEPENDENT / 2 * self.relation.weight * np.log(variance).sum())

    @cached_property
    def excess(self) -> float:
        """Squared residual beyond the floor, in floors."""
        return self.relation.weight * max(0.0, self.left**2 / self.floor**2 - 3.0)

    @property
    def left(self) -> float:
        return float(np.linalg.norm(self.residual))

    @property
    def size(self) -> float:
        """Root mean square of the expected side, its mean (gravity) included."""
        return root_mean_square(self.expected) * np.sqrt(3)

    @property
    def ratio(self) -> float:
        """Residual over signal, the floor taken off: 0 perfect, 1 unrelated, 2 reversed."""
        beyond = self.floor * np.sqrt(self.excess / self.relation.weight)
        return float(beyond / max(np.linalg.norm(self.signal), self.floor))

    @property
    def columns(self) -> str:
        return ", ".join(COLUMNS[stream] for stream in self.relation.streams)

    @property
    def words(self) -> str:
        size = np.linalg.norm(self.signal)
        unit = self.relation.unit
        return f"{self.relation.words}: the RMS difference is {self.left:.3g} {unit}, the RMS value {size:.3g}"

    def likeness(self, *, with_mean: bool = False) -> tuple[float, float]:
        """Correlation of both sides over all axes, and by what factor the measured one is larger."""
        x = self.expected
        y = self.measured
        if not with_mean:
            x = x - x.mean(axis=0)
            y = y - y.mean(axis=0)
        xx = float(np.vdot(x, x))
        yy = float(np.vdot(y, y))
        xy = float(np.vdot(x, y))
        if not xx * yy > 0:
            return 0.0, 1.0
        return xy / np.sqrt(xx * yy), float(np.sqrt(yy / xx) * np.sign(xy))


Agreements = dict[str, Agreement]  # by relation


def agreement(pair: Pair, floor: float | None = None) -> Agreement:
    """Compare the two sides of a relation over the smaller nine tenths of its windows. floor: other than the usual."""
    gap = pair.measured - pair.expected
    scale = np.maximum(np.median(np.abs(gap), axis=0), 1e-9)
    size = np.sum((gap / scale) ** 2, axis=1)
    kept = size <= np.quantile(size, KEPT)
    return Agreement(pair.relation, pair.expected[kept], pair.measured[kept], floor or pair.relation.floor)


def agreements(windows: Windows, known: Agreements | None = None, changed: str = "tpqvwf") -> Agreements:
    """Of every relation; those that have none of the streams `changed` are taken from `known`."""
    every = dict(known or {})
    for pair in pairs(windows, changed):
        every[pair.name] = agreement(pair)
    return every


def evidence(relations: Agreements) -> float:
    """E (log units)."""
    return sum(relation.evidence for relation in relations.values())


# --------------------------------------------------------------------------------------------- what nothing explains
def inconsistencies(relations: Agreements) -> list[Finding]:
    """Streams that are unrelated."""
    findings = []
    for relation in relations.values():
        correlation, _ = relation.likeness()
        moving = np.linalg.norm(relation.signal) > 2 * relation.floor
        if moving and relation.ratio > DISAGREE and correlation < UNRELATED:
            text = f"{relation.words}, correlation {correlation:.2f}; no change of unit, frame or sign mends it"
            allowed = f"{DISAGREE:.0%} of the signal"
            findings.append(Finding("inconsistent", "blocking", relation.columns, text, allowed, INCONSISTENT))
    return findings


def misfits(relations: Agreements, said: Collection[str], *, corrected: bool) -> list[Finding]:
    """What is left between two streams once all that was found is corrected, where it is beyond what sensors differ
    by. said: columns of which something is said already."""
    findings: list[Finding] = []
    for name in MOVES:
        relation = relations.get(name)
        if relation is None or relation.columns in said or relation.columns in [finding.where for finding in findings]:
            continue
        excess = np.sqrt(np.maximum(relation.residual**2 - relation.floor**2, 0.0))
        bad = relation.residual > MISFIT * relation.floor
        bad &= excess > MOST_LEFT * np.maximum(relation.signal, relation.floor)
        if bad.any():
            axes = ", ".join(np.array(["x", "y", "z"])[bad])
            floors = float(relation.residual[bad].max()) / relation.floor
            text = relation.words
            if corrected:
                text += " once what is named is corrected"
            text += f"; along {axes} up to {floors:.1f} times what sensors differ by"
            allowed = f"{MISFIT:g} times, or {MOST_LEFT:.0%}"
            findings.append(Finding("misfit", "warning", relation.columns, text, allowed))
    return findings


def stray(windows: Windows) -> list[tuple[Finding, np.ndarray]]:
    """Stretches where an accelerometer or gyro contradicts the other sensors but agrees with them elsewhere.

    Each with the first and last times of its windows, (n, 2) (s).
    """
    if len(windows.t) < LEAST_WINDOWS:
        return []
    every = {pair.name: pair for pair in pairs(windows, "wf")}
    ends = windows.t[:, [0, -1]]
    findings = []
    for name, (relations, least, columns) in STRAYING.items():
        pair = next((every[relation] for relation in relations if relation in every), None)
        if pair is None:
            continue
        size = norms(pair.measured - pair.expected)
        limit = max(STRAY * 1.4826 * float(np.median(size)), least)
        bad = size > limit
        if FEW_STRAY <= bad.mean() <= MANY_STRAY:
            when = np.tile(ends, (len(size) // len(ends), 1))[bad]
            low = when[:, 0].min()
            high = when[:, 0].max()
            text = f"off by up to {size.max():.4g} {pair.relation.unit} in {bad.mean():.1%} of the windows"
            where = f"{columns}, {low:.2f}..{high:.2f} s"
            span = (float(low), float(high))
            allowed = f"{limit:.3g} from the motion"
            findings.append((Finding(name, "blocking", where, text, allowed, LEAVE_OUT, span), when))
    return findings
