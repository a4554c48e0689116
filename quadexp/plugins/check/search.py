"""The search: which candidates make the streams of a flight agree with one another, and by how much.

The evidence is the log likelihood of the relations' residuals, each axis with a variance of its own, of INDEPENDENT
windows (the errors of a sensor last: more windows of one flight do not tell more),

    E = -INDEPENDENT / 2 sum over relations and axes of log(r^2 + floor^2)         (log units),

r the root mean square residual of the smaller nine tenths (spikes are another check's business). A candidate is taken
when it raises E by more than MARGIN and leaves what it changed in agreement; then the search goes on with the mended
flight, so that faults in several streams are named one by one. Where the next best candidate lies less than MARGIN
behind, both are named, and which one holds is asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from quadexp.errors import DataError
from quadexp.physics.state import norms
from quadexp.plugins.check.axis_scale import axis_candidates
from quadexp.plugins.check.candidates import (
    COLUMNS,
    Candidate,
    bias_candidates,
    candidates,
    clock_candidate,
    heading_candidates,
    mounting_candidates,
    scale_candidates,
)
from quadexp.plugins.check.turn_and_bias import CLEAR as SURELY
from quadexp.plugins.check.turn_and_bias import better, turned_and_biased
from quadexp.plugins.logs.finding import LEAVE_OUT, SEVERITIES, Finding
from quadexp.plugins.logs.signal.windows import Pair, Relation, Windows, pairs

INDEPENDENT = 60  # that a flight counts for, however long it is: a sensor's errors last
LEAST_WINDOWS = 10  # fewer say too little of a candidate
MARGIN = 10.0  # log units: clean flights of every kind at hand stay below 2
PER_COST = 4.5  # log units a unit of cost: a candidate that claims more must explain more
KEPT = 0.9  # share of the windows that a residual is taken over
MOST_FAULTS = 4  # named one by one, each a search of its own
MOST_LEFT = 0.4  # of a misfit: a candidate that leaves as much names no fault
MEASURED = ("scale", "heading")
CALIBRATIONS = {"mounting", "bias", "scale"}
MOVES = ("velocity", "rate", "force", "force (p)")  # relations whose both sides move
MISFIT = 3.0  # floors: what is left of a relation's axis beyond is said, whatever was found
INCONSISTENT = "compare the mapping with what `quadexp import --describe LOG` proposes, or leave the stream out of it"
FEW, FINALISTS = 100, 10  # every candidate is tried on so many windows first, the best ones on all
STRAY = 12.0  # robust standard deviations
STRAY_FLOOR = {"acceleration_outlier": 8.0, "rate_outlier": 4.0}  # m/s^2 and rad/s, means over a window
MOVING = 2.0  # floors that a stream must move by to be compared
TELLING = 0.6  # of a residual that may be left once a factor is undone
CLEAR = 0.4  # of a residual that may be left for a log without IMU to have axes that no convention has
ALIKE = 0.98  # correlation above which a factor between two streams is judged
DISAGREE = 0.7  # residual over signal above which two streams disagree


class Agreement(NamedTuple):
    """Of one relation: residual, signal, (3,), both root mean square; correlation and gain over its moving axes.

    size: root mean square of the expected side, its mean (gravity) included; likeness and whole: correlation and gain
    with the means. evidence: log units. excess: squared
    residual beyond the floor, in floors.
    """

    relation: Relation
    residual: np.ndarray
    signal: np.ndarray
    correlation: float
    gain: float
    floor: float
    size: float
    likeness: float
    whole: float
    evidence: float
    excess: float

    @property
    def left(self) -> float:
        return float(np.linalg.norm(self.residual))

    @property
    def ratio(self) -> float:
        """Residual over signal, the floor taken off: 0 perfect, 1 unrelated, 2 reversed."""
        excess = np.sqrt(max(0.0, self.left**2 - 3 * self.floor**2))
        return float(excess / max(np.linalg.norm(self.signal), self.floor))

    @property
    def columns(self) -> str:
        return ", ".join(COLUMNS[stream] for stream in self.relation.streams)

    @property
    def words(self) -> str:
        size = np.linalg.norm(self.signal)
        unit = self.relation.unit
        return f"{self.relation.words}: the RMS difference is {self.left:.3g} {unit}, the RMS value {size:.3g}"


Agreements = dict[str, Agreement]  # by relation


def agreement(pair: Pair, floor: float | None = None) -> Agreement:
    """Compare the two sides of a relation over the smaller nine tenths of its windows. floor: other than the usual."""
    gap = pair.measured - pair.expected
    half, most = len(gap) // 2, int(KEPT * (len(gap) - 1))
    scale = np.maximum(np.partition(np.abs(gap), half, axis=0)[half], 1e-9)
    apart = np.einsum("ni,ni,i->n", gap, gap, scale**-2)
    kept = apart <= np.partition(apart, most)[most]
    gap, expected, seen = gap[kept], pair.expected[kept], pair.measured[kept]
    a, b = expected - expected.mean(axis=0), seen - seen.mean(axis=0)
    aa, bb, ab = float(np.vdot(a, a)), float(np.vdot(b, b)), float(np.vdot(a, b))
    correlation, gain = (ab / np.sqrt(aa * bb), float(np.sqrt(bb / aa) * np.sign(ab))) if aa * bb > 0 else (0.0, 1.0)
    dot, power, power_seen = (float(np.vdot(*two)) for two in ((expected, seen), (expected, expected), (seen, seen)))
    square = np.mean(gap**2, axis=0)
    weight, floor = pair.relation.weight, floor or pair.relation.floor
    return Agreement(
        pair.relation, np.sqrt(square), a.std(axis=0), float(correlation), gain, floor,
        size=float(np.sqrt(np.vdot(expected, expected) / len(gap))),
        likeness=dot / np.sqrt(power * power_seen + 1e-300),
        whole=dot / (power + 1e-300),
        evidence=-INDEPENDENT / 2 * weight * float(np.sum(np.log(square + floor**2))),
        excess=weight * max(0.0, float(square.sum()) / floor**2 - 3.0),
    )  # fmt: skip


def agreements(windows: Windows, known: Agreements | None = None, changed: str = "tpqvwf") -> Agreements:
    """Of every relation; those that have none of the streams `changed` are taken from `known`."""
    return {**(known or {}), **{pair.name: agreement(pair) for pair in pairs(windows, changed)}}


def evidence(relations: Agreements) -> float:
    """E (log units)."""
    return sum(relation.evidence for relation in relations.values())


@dataclass(frozen=True)
class Trial:
    """A candidate that was tried: the windows mended by it, and how well their streams agree before and after."""

    candidate: Candidate
    windows: Windows
    before: Agreements
    after: Agreements
    besides: float = 0.0  # what a mount that is left besides claims (log units)

    @property
    def value(self) -> float:
        """By how much the candidate raises E, less what it claims (log units)."""
        return evidence(self.after) - evidence(self.before) - self.besides - PER_COST * self.candidate.cost

    @property
    def conventional(self) -> bool:
        """Whether it is a convention, not a mount."""
        return self.candidate.fault != "mounting"

    @property
    def measured(self) -> bool:
        """Whether its size is measured, so that a small one that leaves much of the misfit is real all the same."""
        return not self.candidate.blocks or self.candidate.fault in MEASURED or len(self.candidate.axes) < 3

    @property
    def better(self) -> list[str]:
        """Relations that it betters."""
        return [name for name, misfit in self.after.items() if misfit.evidence > self.before[name].evidence + 3.0]

    @property
    def left(self) -> float:
        """Share of the misfit beyond what sensors differ by, root mean square, that stays in the relations bettered."""
        was, stays = (sum(side[name].excess for name in self.better) for side in (self.before, self.after))
        return float(np.sqrt(stays / was)) if was > 0 else 1.0

    @property
    def within_floors(self) -> bool:
        """Whether what it betters was no more than sensors differ by: of a slow flight, where it is a warning."""
        return all(self.before[name].excess == 0 for name in self.better)

    @property
    def as_warning(self) -> Trial:
        return replace(self, candidate=replace(self.candidate, severity="warning"))

    def shrinks(self, share: float, names: Sequence[str], axes: Sequence[int] = (0, 1, 2)) -> bool:
        """Whether of one of these relations less than this share of the residual is left, along these axes."""
        for name in set(names) & self.after.keys():
            was, after = (np.linalg.norm(side[name].residual[list(axes)]) for side in (self.before, self.after))
            if after < share * was:
                return True
        return False

    def plausible(self) -> bool:
        """A candidate must make two moving streams agree, not only make both small, and make no relation worse."""
        fault, better, after = self.candidate.fault, self.better, self.after
        if any(misfit.evidence < self.before[name].evidence - 30.0 for name, misfit in after.items()):
            return False
        if fault in ("scale", "clock_scale") and not self.shrinks(TELLING, MOVES, self.candidate.axes):
            return False  # a slope due to noise
        if fault == "units" and not self._more_than_nothing():
            return False
        unusual = fault in ("axis_swap", "sign_flip", "units") and all(name.startswith("thrust") for name in better)
        if unusual and not self.shrinks(CLEAR, better):
            return False
        if fault == "units" and self.candidate.streams == "f" and self.shrinks(CLEAR, ("force", "force (p)")):
            return True  # gravity says it, whichever way the sensor stands
        return any(after[name].ratio < DISAGREE and after[name].size > MOVING * after[name].floor for name in better)

    def _more_than_nothing(self) -> bool:
        """Whether a stream in another unit explains more than the same stream set to zero does."""
        zero = {name: 0.0 * self.windows.streams[name] for name in self.candidate.streams if name in "pvwf"}
        silent = Windows(self.windows.t, {**self.windows.streams, **zero})
        nothing = _without_own(self.candidate, agreements(silent, self.before, self.candidate.streams), self.before)
        return not zero or evidence(self.after) - evidence(nothing) > MARGIN

    def competes(self, other: Trial) -> bool:
        """Whether both are calibrations of one sensor: a turn, a bias, a factor."""
        faults = {self.candidate.fault, other.candidate.fault} <= CALIBRATIONS
        return faults and bool(set(self.candidate.streams) & set(other.candidate.streams) & set("wf"))

    @property
    def gains(self) -> bool:
        """Whether it makes what it changes agree better, and nothing agree worse."""
        worse = any(misfit.evidence < self.before[name].evidence - 1.0 for name, misfit in self.after.items())
        return not worse and evidence(self.after) > evidence(self.before)

    @property
    def telling(self) -> str:
        """The relation that it betters most."""
        return max(self.better or self.after, key=lambda name: self.after[name].evidence - self.before[name].evidence)

    def finding(self, rival: Trial | None) -> Finding:
        """rival: the next best candidate, where it lies less than MARGIN behind."""
        candidate, name = self.candidate, self.telling
        rest, unit = self.after[name].left, self.after[name].relation.unit
        text = f"{candidate.text}: {self.before[name].words}; corrected, the difference is {rest:.3g} {unit}"
        advice = "correct the mapping of the import: " + ", ".join(f"`{line}`" for line in candidate.lines)
        advice += f"; or import {candidate.options}" if candidate.options else ""
        if rival is not None:
            other, behind = rival.candidate, self.value - rival.value
            likely = f"{behind:.1f} log units less likely only ({MARGIN:g} are sure)" if behind > 0 else "as likely"
            text += f"; but {other.where}: {other.text}, is {likely}"
            advice += f"; decide between this and {', '.join(other.lines)}, which the data do not"
        allowed = "SI units, world ENU, body FLU, quaternion body to world with w first"
        both = [candidate.severity] if rival is None else [candidate.severity, rival.candidate.severity]
        return Finding(
            candidate.fault,
            max(both, key=SEVERITIES.index),
            candidate.where,
            text,
            allowed,
            advice,
            correction=candidate.correction,
        )


def explain(windows: Windows) -> tuple[list[Candidate], list[Finding]]:
    """The candidates that explain the flight, best first; and the findings, what none explains among them.

    A turned sensor is the first candidate: another one is taken only where it explains the flight clearly better. One
    that would block and leaves MOST_LEFT of the misfit or more is not taken.
    """
    taken: list[Candidate] = []
    findings: list[Finding] = []
    before = agreements(windows)
    clock = _clock(before)
    tried = None if clock is None else _tried(clock, windows, before)
    named = [tried] if tried is not None and tried.shrinks(TELLING, ["velocity", "rate"]) else []
    while before and len(taken) < MOST_FAULTS:
        if not named:
            if all((each.residual < 0.7 * each.floor).all() for each in before.values()):  # there is nothing to explain
                break
            trials = _ranked(windows, before, taken)
            named = [trial for trial in trials if trial.left < MOST_LEFT or trial.measured]
            named = named or [trial.as_warning for trial in trials if trial.within_floors]
            if trials and not named:
                findings.append(_unexplained(trials[0]))
        if not named:
            break
        best = named[0]
        mount = next((trial for trial in named if not trial.conventional), None)
        if mount is not None and not mount.candidate.blocks and mount.value > best.value - MARGIN:
            best = mount
        findings.append(best.finding(_rival(best, named)))
        taken.append(best.candidate)
        windows, named = best.windows, []
        before = agreements(windows)
    for relation in before.values():
        moving = np.linalg.norm(relation.signal) > 2 * relation.floor
        if moving and relation.ratio > DISAGREE and relation.correlation < 0.5:
            text = (
                f"{relation.words}, correlation {relation.correlation:.2f}; no change of unit, frame or sign mends it"
            )
            allowed = f"{DISAGREE:.0%} of the signal"
            findings.append(Finding("inconsistent", "blocking", relation.columns, text, allowed, INCONSISTENT))
    small, before = _small_factors(windows, before, taken)
    findings += small
    return taken, findings + _misfits(before, findings)


def _rival(best: Trial, named: list[Trial]) -> Trial | None:
    """The next best explanation, where it lies less than MARGIN behind."""
    for trial in named:
        near = best.value - trial.value < MARGIN and not _same(trial, best)
        if near and best.candidate.blocks and trial.conventional and trial.candidate.blocks:
            return trial
        if near and trial.candidate.fault != best.candidate.fault and best.competes(trial):
            return trial
    return None


def _same(trial: Trial, best: Trial) -> bool:
    """Whether both say one thing: a unit, and the factor that it is."""
    factors = {trial.candidate.fault, best.candidate.fault} == {"units", "scale"}
    return trial is best or (factors and trial.candidate.streams == best.candidate.streams)


def _small_factors(windows: Windows, before: Agreements, taken: list[Candidate]) -> tuple[list[Finding], Agreements]:
    """Factors of axes that are sure by their own standard errors, and too small to count against what sensors differ
    by: warnings. And how well the streams agree without them."""
    scaled = {stream for mended in taken if mended.fault in ("scale", "units") for stream in mended.streams}
    findings = []
    reported: set[str] = set()
    for candidate in axis_candidates(windows, small=True):
        relation = {"w": "rate", "f": "force"}.get(candidate.streams, "velocity")
        if candidate.fault == "scale":
            candidate = replace(candidate, severity="warning")
        trial = _tried(candidate, windows, before)
        if candidate.streams in scaled or relation in reported or trial is None or not trial.gains:
            continue
        reported.add(relation)
        findings.append(trial.finding(None))
        windows, before = trial.windows, trial.after
    return findings, before


def _misfits(before: Agreements, findings: list[Finding]) -> list[Finding]:
    """What is left between two streams once all that was found is corrected, where it is beyond what sensors differ
    by."""
    said = {finding.where for finding in findings if finding.name in ("misfit", "inconsistent")}
    misfits = []
    for name in MOVES:
        relation = before.get(name)
        if relation is None or relation.columns in said:
            continue
        excess = np.sqrt(np.maximum(relation.residual**2 - relation.floor**2, 0.0))
        large = relation.residual > MISFIT * relation.floor
        bad = large & (excess > MOST_LEFT * np.maximum(relation.signal, relation.floor))
        if not bad.any():
            continue
        axes = ", ".join(axis for axis, is_bad in zip("xyz", bad, strict=True) if is_bad)
        floors = float(np.max(relation.residual[bad])) / relation.floor
        corrected = " once what is named is corrected" if findings else ""
        text = f"{relation.words}{corrected}; along {axes} up to {floors:.1f} times what sensors differ by"
        said.add(relation.columns)
        misfits.append(Finding("misfit", "warning", relation.columns, text, f"{MISFIT:g} times, or {MOST_LEFT:.0%}"))
    return misfits


def _tried(candidate: Candidate, windows: Windows, before: Agreements) -> Trial | None:
    """None where it cannot be done."""
    try:
        changed = candidate.apply(windows)
    except DataError:
        return None
    return Trial(
        candidate, changed, before, _without_own(candidate, agreements(changed, before, candidate.streams), before)
    )


def _without_own(candidate: Candidate, after: Agreements, before: Agreements) -> Agreements:
    """Of two streams changed alike, their relation says nothing."""
    return {**after, "velocity": before["velocity"]} if candidate.streams == "pv" else after


def _ranked(windows: Windows, before: Agreements, taken: list[Candidate]) -> list[Trial]:
    """Candidates that may be taken next, the best first."""
    done = {(last.streams, last.fault) for last in taken[-1:]}
    turned = {stream for mended in taken if mended.fault == "mounting" for stream in mended.streams}
    every = [*candidates(frozenset(windows.streams)), *_scales(before), *heading_candidates(windows)]
    every += bias_candidates(windows)
    every += axis_candidates(windows)
    few = windows.every(max(1, len(windows.t) // FEW))
    known = agreements(few)
    new = [candidate for candidate in every if (candidate.streams, candidate.fault) not in done]
    coarse = [trial for candidate in new if (trial := _tried(candidate, few, known))]
    best = sorted((trial for trial in coarse if trial.value > 0), key=lambda trial: -trial.value)
    likely = [trial.candidate for trial in best[:FINALISTS]]
    mounts = [*mounting_candidates(windows), *turned_and_biased(windows)]
    mounts = [mount for mount in mounts if not set(mount.streams) & turned]
    trials = [trial for candidate in (*likely, *mounts) if (trial := _tried(candidate, windows, before)) is not None]
    explaining = [trial for trial in trials if trial.value > MARGIN and trial.plausible()]
    if not any(trial.candidate.blocks and trial.left < MOST_LEFT for trial in explaining):
        explaining += _under_a_mount(windows, before, likely, max((trial.value for trial in explaining), default=0.0))
    best_other = max((trial.value for trial in explaining if trial.conventional), default=-np.inf)
    explaining = [
        trial
        for trial in explaining
        if trial.conventional or not trial.candidate.blocks or trial.value > best_other + MARGIN
    ]
    return _without_beaten(sorted(explaining, key=lambda trial: -trial.value))


def _without_beaten(trials: list[Trial]) -> list[Trial]:
    """Without calibrations of a sensor that another one of it surely beats, stretch by stretch of the flight."""
    kept: list[Trial] = []
    for trial in trials:
        rivals = [other for other in kept if trial.competes(other)]
        if any(_beats(other, trial) for other in rivals):
            continue
        beaten = [other for other in rivals if _beats(trial, other)]
        kept = [other for other in kept if all(other is not lost for lost in beaten)] + [trial]
    return sorted(kept, key=lambda trial: -trial.value)


def _beats(a: Trial, b: Trial) -> bool:
    """Whether the variations surely say `a`, and all together does not say `b`."""
    return a.value > b.value - MARGIN and better(a.windows, b.windows, b.candidate.streams) > SURELY


def _under_a_mount(windows: Windows, before: Agreements, likely: list[Candidate], alone: float) -> list[Trial]:
    """Faults of a sensor that is turned besides: each is judged with the turn that is left once it is mended too.

    alone: what the best single candidate explains; two must explain clearly more.
    """
    explaining = []
    for candidate in likely:
        if candidate.fault == "scale" or not set("pvqf") & set(candidate.streams):
            continue
        trial = _tried(candidate, windows, before)
        turns = [] if trial is None else mounting_candidates(trial.windows)
        mount = next((turn for turn in turns if turn.streams == "f" and not turn.blocks), None)
        if trial is None or mount is None:
            continue
        both = agreements(mount.apply(trial.windows), trial.after, "f")
        judged = Trial(candidate, trial.windows, before, both, PER_COST * mount.cost)
        if judged.value > alone + 2 * MARGIN and judged.plausible():
            explaining.append(judged)
    return explaining


def _unexplained(best: Trial) -> Finding:
    """A misfit that no candidate explains, as a finding without a cause."""
    candidate, was = best.candidate, best.before[best.telling]
    text = f"{was.words}; the nearest hypothesis ({candidate.where}: {candidate.text}) leaves {best.left:.0%} of it,"
    return Finding("misfit", "warning", was.columns, f"{text} so none is named", f"{MOST_LEFT:.0%}")


def _scales(agreed: Agreements) -> tuple[Candidate, ...]:
    """Factors between two streams that are otherwise alike. The force has gravity for a known length."""
    scaled: list[Candidate] = []
    for relation, streams, least in (("velocity", "vp", 0.015), ("rate", "wq", 0.05), ("force", "fv", 0.04),
                                     ("force (p)", "fp", 0.04)):  # fmt: skip
        alike = agreed.get(relation)
        if alike is None or (relation == "force (p)" and "force" in agreed):
            continue
        likeness, gain = (alike.likeness, alike.whole) if streams[0] == "f" else (alike.correlation, alike.gain)
        if likeness > ALIKE and abs(gain - 1) > least:
            scaled += scale_candidates(gain, streams if relation == "velocity" else streams[0])
    return tuple(scaled)


def _clock(agreed: Agreements) -> Candidate | None:
    """A clock that runs wrong: velocity against dp/dt and rates against the attitude are off by one factor.

    Where the gyro is too noisy to say by how much it is off, a small factor is put down to the clock as well: scales
    of position or velocity that are wrong by a few per cent are rarer than that.
    """
    velocity, rate = agreed.get("velocity"), agreed.get("rate")
    if velocity is None:
        sure = rate is not None and rate.correlation > 0.995 and abs(rate.gain - 1) > 0.03
        degrees = rate is not None and abs(rate.gain / np.degrees(1) - 1) < 0.1
        return clock_candidate(rate.gain) if rate is not None and sure and not degrees else None
    if velocity.correlation < ALIKE or abs(velocity.gain - 1) < 0.015:
        return None
    size = np.log(velocity.gain)
    alike = abs(size) < 0.15
    if rate is not None and rate.correlation > 0.7:
        alike = 0.5 < np.log(rate.gain) / size < 1.5 or not (rate.correlation > ALIKE or abs(size) > 0.3)
    return clock_candidate(velocity.gain) if alike else None


def stray(windows: Windows) -> list[tuple[Finding, np.ndarray]]:
    """Stretches where an accelerometer or gyro contradicts the other sensors but agrees with them elsewhere.

    Each with the first and last times of its windows, (n, 2) (s).
    """
    if len(windows.t) < LEAST_WINDOWS:
        return []
    findings = []
    every = {pair.name: pair for pair in pairs(windows)}
    for name, relations in (("acceleration_outlier", ("force", "force (p)")), ("rate_outlier", ("rate",))):
        pair = next((every[relation] for relation in relations if relation in every), None)
        if pair is None:
            continue
        size = norms(pair.measured - pair.expected)
        limit = max(STRAY * 1.4826 * float(np.median(size)), STRAY_FLOOR[name])
        bad = size > limit
        if bad.mean() < 0.005 or bad.mean() > 0.4:  # a knock, or something else than a stretch
            continue
        ends = np.column_stack([windows.t[:, 0], windows.t[:, -1]])
        when = (np.concatenate([ends, ends]) if len(size) == 2 * len(ends) else ends)[bad]
        low, high = float(when[:, 0].min()), float(when[:, 0].max())
        text = f"off by up to {size.max():.4g} {pair.relation.unit} in {bad.mean():.1%} of the windows"
        where = f"{COLUMNS['w' if name == 'rate_outlier' else 'f']}, {low:.2f}..{high:.2f} s"
        allowed = f"{limit:.3g} from the motion"
        findings.append((Finding(name, "blocking", where, text, allowed, LEAVE_OUT, (low, high)), when))
    return findings
