"""The search: which candidates make the streams of a flight agree with one another, and by how much (agreement.py).

A candidate is taken when it raises the evidence by more than MARGIN and leaves what it changed in agreement; then the
search goes on with the mended flight, so that faults in several streams are named one by one. Where the next best
candidate lies less than MARGIN behind, both are named, and which one holds is asked for.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadexp.errors import DataError
from quadexp.plugins.check.agreement import (
    DISAGREE,
    MOST_LEFT,
    MOVES,
    Agreements,
    agreements,
    evidence,
    inconsistencies,
    misfits,
)
from quadexp.plugins.check.axis_scale import axis_candidates
from quadexp.plugins.check.calibration import CLEAR, better, bias_candidates, heading_candidates, mounting_candidates
from quadexp.plugins.check.candidates import Candidate, candidates, clock_candidate, scale_candidates
from quadexp.plugins.logs.finding import SEVERITIES, Finding
from quadexp.plugins.logs.signal.windows import Windows

MARGIN = 10.0  # log units: clean flights of every kind at hand stay below 2
PER_COST = 4.5  # log units a unit of cost: a candidate that claims more must explain more
BETTERS = 3.0  # log units by which a candidate changes a relation
WORSENS = 1.0  # likewise
RUINS = 30.0  # log units, likewise
MOST_FAULTS = 4  # named one by one, each a search of its own
MEASURED = ("scale", "heading")
CALIBRATIONS = {"mounting", "bias", "scale"}
FEW = 100  # windows that every candidate is tried on first
FINALISTS = 10  # the best of them, which are tried on all
NOTHING = 0.7  # floors: smaller residuals leave nothing to explain
MOVING = 2.0  # floors that a stream must move by to be compared
TELLING = 0.6  # of a residual that may be left once a factor, or the fault of a slow flight, is undone
PLAIN = 0.4  # of a residual that may be left for a log without IMU to have axes that no convention has
ALIKE = 0.98  # correlation above which a factor between two streams is judged
# Factors between two streams: relation, streams, least deviation from 1. The force has gravity for a known length.
FACTORS = (("velocity", "vp", 0.015), ("rate", "w", 0.05), ("force", "f", 0.04), ("force (p)", "f", 0.04))
CONVENTION = "SI units, world ENU, body FLU, quaternion body to world with w first"


@dataclass(frozen=True, eq=False)
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
        fault = self.candidate.fault
        streams = self.candidate.streams
        return not self.candidate.blocks or fault in MEASURED or streams == "t" or len(self.candidate.axes) < 3

    def gain(self, name: str) -> float:
        """By how much it raises the evidence of a relation (log units)."""
        return self.after[name].evidence - self.before[name].evidence

    @property
    def better(self) -> list[str]:
        """Relations that it betters."""
        return [name for name in self.after if self.gain(name) > BETTERS]

    @property
    def left(self) -> float:
        """Share of the misfit beyond what sensors differ by, root mean square, that stays in the relations bettered."""
        was = sum(self.before[name].excess for name in self.better)
        stays = sum(self.after[name].excess for name in self.better)
        return float(np.sqrt(stays / was)) if was > 0 else 1.0

    @property
    def within_floors(self) -> bool:
        """Whether what it betters was no more than sensors differ by: of a slow flight, where it is a warning."""
        return all(self.before[name].excess == 0 for name in self.better)

    def shrinks(self, share: float, names: Sequence[str]) -> bool:
        """Whether of one of these relations less than this share of the residual is left, along the axes changed."""
        axes = list(self.candidate.axes)
        for name in set(names) & self.after.keys():
            was = np.linalg.norm(self.before[name].residual[axes])
            if np.linalg.norm(self.after[name].residual[axes]) < share * was:
                return True
        return False

    def plausible(self) -> bool:
        """A candidate must make two moving streams agree, not only make both small, and make no relation worse."""
        fault = self.candidate.fault
        better = self.better
        if any(self.gain(name) < -RUINS for name in self.after):
            return False
        if fault in ("scale", "clock_scale") and not self.shrinks(TELLING, MOVES):
            return False  # a slope due to noise
        if (fault == "units" or self.candidate.streams == "q") and not self._more_than_nothing():
            return False
        unusual = fault in ("axis_swap", "sign_flip", "units") and all(name.startswith("thrust") for name in better)
        if unusual and not self.shrinks(PLAIN, better):
            return False
        if fault == "units" and self.candidate.streams == "f" and self.shrinks(PLAIN, ("force", "force (p)")):
            return True  # gravity says it, whichever way the sensor stands
        bettered = (self.after[name] for name in better)
        return any(each.ratio < DISAGREE and each.size > MOVING * each.floor for each in bettered)

    def _more_than_nothing(self) -> bool:
        """Whether a stream in another unit explains more than the same stream set to zero does, and an attitude that is
        read otherwise more than a level one."""
        if self.candidate.streams == "t":
            return True
        silent = {name: 0.0 * self.windows.streams[name] for name in self.candidate.streams}
        if "q" in silent:
            silent["q"][..., 0] = 1.0
        windows = Windows(self.windows.t, {**self.windows.streams, **silent})
        nothing = _after(self.candidate, windows, self.before)
        return evidence(self.after) - evidence(nothing) > MARGIN

    def competes(self, other: Trial) -> bool:
        """Whether both are calibrations of one sensor: a turn, a bias, a factor."""
        faults = {self.candidate.fault, other.candidate.fault} <= CALIBRATIONS
        return faults and bool({*self.candidate.streams} & {*other.candidate.streams} & {*"wf"})

    def beats(self, other: Trial) -> bool:
        """Whether the variations surely say this one, and all together does not say the other."""
        near = self.value > other.value - MARGIN
        return near and better(self.windows, other.windows, other.candidate.streams) > CLEAR

    def finding(self, rival: Trial | None = None) -> Finding:
        """rival: the next best candidate, where it lies less than MARGIN behind."""
        candidate = self.candidate
        name = max(self.better or self.after, key=self.gain)
        after = self.after[name]
        text = f"{candidate.text}: {self.before[name].words}"
        text += f"; corrected, the difference is {after.left:.3g} {after.relation.unit}"
        lines = ", ".join(f"`{line}`" for line in candidate.lines)
        advice = f"correct the mapping of the import: {lines}"
        if candidate.options:
            advice += f"; or import {candidate.options}"
        severity = candidate.severity
        if rival is not None:
            other = rival.candidate
            behind = self.value - rival.value
            likely = "as likely"
            if behind > 0:
                likely = f"{behind:.1f} log units less likely only ({MARGIN:g} are sure)"
            text += f"; but {other.where}: {other.text}, is {likely}"
            advice += f"; decide between this and {', '.join(other.lines)}, which the data do not"
            severity = max(severity, other.severity, key=SEVERITIES.index)
        correction = candidate.correction
        return Finding(candidate.fault, severity, candidate.where, text, CONVENTION, advice, correction=correction)


def explain(windows: Windows) -> tuple[list[Candidate], list[Finding]]:
    """The candidates that explain the flight, best first; and the findings, what none explains among them.

    A turned sensor is the first candidate: another one is taken only where it explains the flight clearly better. One
    that would block and leaves MOST_LEFT of the misfit or more is not taken.
    """
    taken: list[Candidate] = []
    findings: list[Finding] = []
    before = agreements(windows)
    while before and len(taken) < MOST_FAULTS:
        trials = _ranked(windows, before, taken)
        named = [trial for trial in trials if trial.left < MOST_LEFT or trial.measured]
        if not named:
            for trial in trials:
                if trial.within_floors and trial.shrinks(TELLING, trial.better):
                    named.append(replace(trial, candidate=replace(trial.candidate, severity="warning")))
        if trials and not named and not trials[0].within_floors:
            findings.append(_unexplained(trials[0]))
        if not named:
            break
        best = named[0]
        mount = next((trial for trial in named if not trial.conventional), best)
        if not mount.candidate.blocks and mount.value > best.value - MARGIN:
            best = mount
        findings.append(best.finding(_rival(best, named)))
        taken.append(best.candidate)
        windows = best.windows
        before = agreements(windows)
    findings += inconsistencies(before)
    small, before = _small_factors(windows, before, taken)
    findings += small
    said = {finding.where for finding in findings if finding.name in ("misfit", "inconsistent")}
    return taken, findings + misfits(before, said, corrected=bool(findings))


def _unexplained(best: Trial) -> Finding:
    """A misfit that no candidate explains, as a finding without a cause."""
    candidate = best.candidate
    was = best.before[max(best.better or best.after, key=best.gain)]
    text = f"{was.words}; the nearest hypothesis ({candidate.where}: {candidate.text}) leaves {best.left:.0%} of it,"
    return Finding("misfit", "warning", was.columns, f"{text} so none is named", f"{MOST_LEFT:.0%}")


def _rival(best: Trial, named: Iterable[Trial]) -> Trial | None:
    """The next best explanation, where it lies less than MARGIN behind, and says something else: not a unit, and the
    factor that it is."""
    for trial in named:
        faults = {trial.candidate.fault, best.candidate.fault}
        same = faults == {"units", "scale"} and trial.candidate.streams == best.candidate.streams
        if trial is best or same or best.value - trial.value >= MARGIN:
            continue
        if best.candidate.blocks and trial.conventional and trial.candidate.blocks:
            return trial
        if len(faults) == 2 and best.competes(trial):
            return trial
    return None


def _small_factors(windows: Windows, before: Agreements, taken: list[Candidate]) -> tuple[list[Finding], Agreements]:
    """Factors of axes that are sure by their own standard errors, and too small to count against what sensors differ
    by: warnings. And how well the streams agree without them."""
    said = {stream for mended in taken if mended.fault in ("scale", "units") for stream in mended.streams}
    findings = []
    for candidate in axis_candidates(windows, small=True):
        if candidate.fault == "scale":
            candidate = replace(candidate, severity="warning")
        trial = _tried(candidate, windows, before)
        if trial is None or candidate.streams in said or evidence(trial.after) <= evidence(before):
            continue
        if all(trial.gain(name) >= -WORSENS for name in trial.after):
            findings.append(trial.finding())
            windows = trial.windows
            before = trial.after
            said |= {*candidate.streams} if candidate.streams in "wf" else {"p", "v", "pv"}
    return findings, before


# ------------------------------------------------------------------------------------------------------- candidates
def _tried(candidate: Candidate, windows: Windows, before: Agreements) -> Trial | None:
    """None where it cannot be done."""
    try:
        changed = candidate.apply(windows)
    except DataError:
        return None
    return Trial(candidate, changed, before, _after(candidate, changed, before))


def _all_tried(candidates: Iterable[Candidate], windows: Windows, before: Agreements) -> list[Trial]:
    trials = []
    for candidate in candidates:
        trial = _tried(candidate, windows, before)
        if trial is not None:
            trials.append(trial)
    return trials


def _after(candidate: Candidate, changed: Windows, before: Agreements) -> Agreements:
    """How well the streams agree once they are changed. Of two that are changed alike, their relation says nothing."""
    after = agreements(changed, before, candidate.streams)
    if candidate.streams == "pv":
        after["velocity"] = before["velocity"]
    return after


def _ranked(windows: Windows, before: Agreements, taken: list[Candidate]) -> list[Trial]:
    """Candidates that may be taken next, the best first; none where there is nothing to explain."""
    if not taken:
        clock = _all_tried(_clock(before), windows, before)
        if clock and clock[0].shrinks(TELLING, ("velocity", "rate")):
            return clock
    if all((each.residual < NOTHING * each.floor).all() for each in before.values()):
        return []
    likely = _likely(windows, before, taken)
    turned = {stream for mended in taken if mended.fault == "mounting" for stream in mended.streams}
    mounts = [mount for mount in mounting_candidates(windows) if not turned & {*mount.streams}]
    trials = _all_tried([*likely, *mounts], windows, before)
    explaining = [trial for trial in trials if trial.value > MARGIN and trial.plausible()]
    if not any(trial.candidate.blocks and trial.left < MOST_LEFT for trial in explaining):
        alone = max((trial.value for trial in explaining), default=0.0)
        explaining += _under_a_mount(windows, before, likely, alone)
    best_convention = max((trial.value for trial in explaining if trial.conventional), default=-np.inf)
    ranked = []
    for trial in sorted(explaining, key=lambda trial: -trial.value):
        if trial.conventional or not trial.candidate.blocks or trial.value > best_convention + MARGIN:
            ranked.append(trial)
    return _without_beaten(ranked)


def _likely(windows: Windows, before: Agreements, taken: list[Candidate]) -> list[Candidate]:
    """The likeliest candidates but mounts, by some of the windows."""
    every = [*candidates(frozenset(windows.streams)), *_scales(before), *heading_candidates(windows)]
    every += [*bias_candidates(windows), *axis_candidates(windows)]
    done = {(candidate.streams, candidate.fault) for candidate in taken[-1:]}
    new = [candidate for candidate in every if (candidate.streams, candidate.fault) not in done]
    few = windows.every(max(1, len(windows.t) // FEW))
    trials = [trial for trial in _all_tried(new, few, agreements(few)) if trial.value > 0]
    trials.sort(key=lambda trial: -trial.value)
    return [trial.candidate for trial in trials[:FINALISTS]]


def _without_beaten(trials: list[Trial]) -> list[Trial]:
    """Without calibrations of a sensor that another one of it surely beats, stretch by stretch of the flight."""
    kept: list[Trial] = []
    for trial in trials:
        rivals = [other for other in kept if trial.competes(other)]
        if any(other.beats(trial) for other in rivals):
            continue
        for other in rivals:
            if trial.beats(other):
                kept.remove(other)
        kept.append(trial)
    return kept


def _under_a_mount(windows: Windows, before: Agreements, likely: list[Candidate], alone: float) -> list[Trial]:
    """Faults of a sensor that is turned besides: each is judged with the turn that is left once it is mended too.

    alone: what the best single candidate explains; two must explain clearly more.
    """
    explaining = []
    for trial in _all_tried(likely, windows, before):
        if trial.candidate.fault == "scale" or not {*"pvqf"} & {*trial.candidate.streams}:
            continue
        turns = mounting_candidates(trial.windows)
        mount = next((turn for turn in turns if turn.streams == "f" and turn.options and not turn.blocks), None)
        if mount is not None:
            both = agreements(mount.apply(trial.windows), trial.after, "f")
            judged = replace(trial, after=both, besides=PER_COST * mount.cost)
            if judged.value > alone + 2 * MARGIN and judged.plausible():
                explaining.append(judged)
    return explaining


def _scales(agreed: Agreements) -> list[Candidate]:
    """Factors between two streams that are otherwise alike."""
    scaled: list[Candidate] = []
    for relation, streams, least in FACTORS:
        if relation in agreed and not (relation == "force (p)" and "force" in agreed):
            correlation, gain = agreed[relation].likeness(with_mean=streams == "f")
            if correlation > ALIKE and abs(gain - 1) > least:
                scaled += scale_candidates(gain, streams)
    return scaled


def _clock(agreed: Agreements) -> list[Candidate]:
    """A clock that runs wrong: velocity against dp/dt and rates against the attitude are off by one factor.

    Where the gyro is too noisy to say by how much it is off, a small factor is put down to the clock as well: scales
    of position or velocity that are wrong by a few per cent are rarer than that.
    """
    correlation, gain = agreed["velocity"].likeness() if "velocity" in agreed else (0.0, 1.0)
    turning, turning_gain = agreed["rate"].likeness() if "rate" in agreed else (0.0, 1.0)
    if "velocity" not in agreed:
        degrees = abs(turning_gain / np.degrees(1) - 1) < 0.1
        sure = turning > 0.995 and abs(turning_gain - 1) > 0.03 and not degrees
        return [clock_candidate(turning_gain)] if sure else []
    if correlation < ALIKE or abs(gain - 1) < 0.015:
        return []
    size = np.log(gain)
    alike = abs(size) < 0.15
    if turning > 0.7:
        alike = 0.5 < np.log(turning_gain) / size < 1.5 or not (turning > ALIKE or abs(size) > 0.3)
    return [clock_candidate(gain)] if alike else []
