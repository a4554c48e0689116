"""The search: which hypotheses make the streams of a flight agree with one another.

The score of a hypothesis is the log likelihood of the relations' residuals, each axis with a variance of its own,

    J = sum over relations and axes of log(r^2 + floor^2),

r the root mean square residual of the smaller nine tenths (spikes are another check's business). A hypothesis is taken
when it lowers J by more than `LEAST_GAIN` and leaves what it changed in agreement; then the search goes on with the
mended flight, so that faults in several streams are named one by one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quadexp.log.finding import LEAVE_OUT, Finding
from quadexp.log.hypotheses.hypothesis import COLUMNS, Hypothesis, clock_hypothesis, hypotheses, scale_hypotheses
from quadexp.log.hypotheses.mounting import mounting_hypotheses
from quadexp.log.hypotheses.windows import SIDES, STREAMS, Pair, Windows, pairs

KEPT = 0.9  # share of the windows that a residual is taken over
LEAST_GAIN = 0.35  # clean flights of every kind at hand stay below 0.06
TIE = 0.15  # of J a unit of cost: a hypothesis that claims more must explain more
MOST_FAULTS = 4
MOST_LEFT = 0.4  # of a misfit: a hypothesis that leaves as much names no fault
CLEARLY = 0.3  # of J, by which a fault must explain more than a turned sensor does
FEW, FINALISTS = 100, 10  # every hypothesis is tried on so many windows first, the best ones on all
STRAY = 12.0  # robust standard deviations
STRAY_FLOOR = {"acceleration_outlier": 8.0, "rate_outlier": 4.0}  # m/s^2 and rad/s, means over a window
MOVING = 2.0  # floors that a stream must move by to be compared
TELLING = 0.6  # of a residual that may be left once a factor is undone
CLEAR = 0.4  # of a residual that may be left for a log without IMU to have axes that no convention has
ALIKE = 0.98  # correlation above which a factor between two streams is judged
DISAGREE = 0.7  # residual over signal above which two streams disagree
WEIGHT = {"force (p)": 0.5, "thrust (p)": 0.5}
WORDS = {
    "velocity": ("v against dp/dt", "m/s"),
    "rate": ("w against the derivative of the attitude", "rad/s"),
    "force": ("acc against R^T (dv/dt + g)", "m/s^2"),
    "force (p)": ("acc against R^T (d2p/dt2 + g)", "m/s^2"),
    "push": ("acc_z against thrust along +z", "m/s^2"),
    "thrust": ("R^T (dv/dt + g) against thrust along +z", "m/s^2"),
    "thrust (p)": ("R^T (d2p/dt2 + g) against thrust along +z", "m/s^2"),
}


@dataclass(frozen=True)
class Agreement:
    """Of one relation: residual, signal, (3,), both root mean square; correlation and gain over its moving axes.

    size: root mean square of the expected side, its mean (gravity) included.
    """

    relation: str
    residual: np.ndarray
    signal: np.ndarray
    correlation: float
    gain: float
    floor: float
    size: float

    @cached_property
    def score(self) -> float:
        return WEIGHT.get(self.relation, 1.0) * float(np.sum(np.log(self.residual**2 + self.floor**2)))

    @property
    def ratio(self) -> float:
        """Residual over signal, the floor taken off: 0 perfect, 1 unrelated, 2 reversed."""
        excess = np.sqrt(np.maximum(0.0, np.sum(self.residual**2) - 3 * self.floor**2))
        return float(excess / max(np.sqrt(np.sum(self.signal**2)), self.floor))

    @property
    def excess(self) -> float:
        """Squared residual beyond the floor, in floors."""
        return WEIGHT.get(self.relation, 1.0) * max(0.0, float(np.sum(self.residual**2)) / self.floor**2 - 3.0)

    @property
    def words(self) -> str:
        what, unit = WORDS[self.relation]
        r, s = np.sqrt(np.sum(self.residual**2)), np.sqrt(np.sum(self.signal**2))
        return f"{what}: differs by {r:.3g} {unit} rms of {s:.3g}"


Agreements = dict[str, Agreement]  # by relation


def agreement(pair: Pair) -> Agreement:
    """Compare the two sides of a relation over the smaller nine tenths of its windows."""
    gap = pair.found - pair.expected
    half, most = len(gap) // 2, int(KEPT * (len(gap) - 1))
    scale = np.maximum(np.partition(np.abs(gap), half, axis=0)[half], 1e-9)
    size = np.einsum("ni,ni,i->n", gap, gap, scale**-2)
    kept = size <= np.partition(size, most)[most]
    gap, expected, found = gap[kept], pair.expected[kept], pair.found[kept]
    a, b = expected - expected.mean(axis=0), found - found.mean(axis=0)
    spread, n = np.einsum("ni,ni->i", a, a), len(gap)
    aa, bb = float(spread.sum()), float(np.vdot(b, b))
    correlation = float(np.vdot(a, b)) / np.sqrt(aa * bb) if aa * bb > 0 else 0.0
    gain = float(np.sqrt(bb / aa) * np.sign(correlation)) if aa * bb > 0 else 1.0
    residual = np.sqrt(np.einsum("ni,ni->i", gap, gap) / n)
    size = float(np.sqrt(np.vdot(expected, expected) / n))
    return Agreement(pair.relation, residual, np.sqrt(spread / n), float(correlation), gain, pair.floor, size)


def agreements(windows: Windows, known: Agreements | None = None, changed: str = "tpqvwf") -> Agreements:
    """Of every relation; those that have none of the streams `changed` are taken from `known`."""
    return {**(known or {}), **{pair.relation: agreement(pair) for pair in pairs(windows, touching=changed)}}


def total(found: Agreements) -> float:
    """J."""
    return sum(one.score for one in found.values())


@dataclass(frozen=True)
class Explained:
    """A hypothesis that was taken, and what it did to the relations it touches."""

    hypothesis: Hypothesis
    before: Agreements
    after: Agreements

    def finding(self) -> Finding:
        touched = [
            name
            for name, one in self.before.items()
            if np.sum(one.residual**2) > 1.3 * np.sum(self.after[name].residual ** 2)
        ] or list(self.before)
        name = max(touched, key=lambda relation: self.before[relation].score - self.after[relation].score)
        _, unit = WORDS[name]
        rest = np.sqrt(np.sum(self.after[name].residual ** 2))
        one = self.hypothesis
        text = f"{one.text}: {self.before[name].words}, by {rest:.3g} {unit} once that is corrected"
        allowed = "SI units, world ENU, body FLU, quaternion body to world with w first"
        return Finding(one.name, one.severity, one.where, text, allowed, one.advice, correction=one.correction)


@dataclass(frozen=True)
class Candidate:
    """A hypothesis that was tried. value: by how much it lowers J, its cost taken off; left: share of the misfit of the
    relations it betters that stays."""

    value: float
    hypothesis: Hypothesis
    windows: Windows
    after: Agreements
    left: float

    @property
    def blocks(self) -> bool:
        return self.hypothesis.severity == "blocking"


def explain(windows: Windows) -> tuple[list[Explained], Windows, list[Finding]]:
    """The hypotheses that explain the flight, best first; the windows after them; a misfit that none explains.

    A turned sensor is the first hypothesis: another one is taken only where it explains the flight clearly better. One
    that would block and leaves MOST_LEFT of the misfit or more is not taken.
    """
    taken: list[Explained] = []
    before = agreements(windows)
    clock = _clock(before)
    if clock is not None:
        changed = clock.apply(windows)
        after = agreements(changed)
        if _telling(before, after):
            taken.append(Explained(clock, before, after))
            windows, before = changed, after
    while before and not _settled(before) and len(taken) < MOST_FAULTS:
        found = _candidates(windows, before, taken)
        named = [one for one in found if one.left < MOST_LEFT or not one.blocks]
        if not named:
            return taken, windows, [_unexplained(found[0], before)] if found else []
        best = named[0]
        mount = next((one for one in named if one.hypothesis.name == "mounting"), None)
        if mount is not None and not mount.blocks and mount.value > best.value - CLEARLY:
            best = mount
        taken.append(Explained(best.hypothesis, before, best.after))
        windows = best.windows
        before = agreements(windows)
    return taken, windows, []


def _candidates(windows: Windows, before: Agreements, taken: list[Explained]) -> list[Candidate]:
    """Hypotheses that may be taken next, the best first."""
    done = {(one.hypothesis.streams, one.hypothesis.name) for one in taken[-1:]}
    done |= {(streams, "mounting") for one in taken if one.hypothesis.name == "mounting" for streams in ("f", "w", "wf")
             if set(streams) & set(one.hypothesis.streams)}  # fmt: skip
    present = frozenset(name for name in STREAMS if getattr(windows, name) is not None)
    every = [one for one in (*hypotheses(present), *_scales(before)) if (one.streams, one.name) not in done]
    few = windows.every(max(1, len(windows.t) // FEW))
    known = agreements(few)
    coarse = [_tried(one, few, known)[0] for one in every]
    likely = [every[i] for i in np.argsort(coarse)[::-1][:FINALISTS] if coarse[i] > 0]
    likely += [one for one in mounting_hypotheses(windows) if (one.streams, one.name) not in done]
    found = []
    for one in likely:
        value, changed, after = _tried(one, windows, before)
        if one.name == "scale" and not _telling(before, after):
            continue
        if one.name == "units" and not _more_than_nothing(one, windows, before, after):
            continue
        if value > LEAST_GAIN and _plausible(one, before, after):
            found.append(Candidate(value, one, changed, after, _left(before, after)))
    if not any(one.blocks and one.left < MOST_LEFT for one in found):
        found += _under_a_mount(windows, before, likely, max((one.value for one in found), default=0.0))
    best = max((one.value for one in found if one.hypothesis.name != "mounting"), default=-np.inf)
    found = [one for one in found if one.hypothesis.name != "mounting" or not one.blocks or one.value > best + CLEARLY]
    return sorted(found, key=lambda one: -one.value)


def _under_a_mount(windows: Windows, before: Agreements, likely: list[Hypothesis], alone: float) -> list[Candidate]:
    """Faults of a sensor that is turned besides: each is judged with the turn that is left once it is mended too.

    alone: what the best single hypothesis explains; two must explain clearly more.
    """
    found = []
    for one in likely:
        if one.severity != "blocking" or one.name in ("mounting", "scale") or not set("pvqf") & set(one.streams):
            continue
        changed = one.apply(windows)
        known = agreements(changed, before, one.streams)
        turns = (turn for turn in mounting_hypotheses(changed) if turn.streams == "f" and turn.severity != "blocking")
        mount = next(turns, None)
        if mount is None:
            continue
        after = agreements(mount.apply(changed), known, "f")
        value = total(before) - total(after) - TIE * (one.cost + mount.cost)
        if value > alone + CLEARLY + LEAST_GAIN and _plausible(one, before, after):
            found.append(Candidate(value, one, changed, known, _left(before, after)))
    return found


def _left(before: Agreements, after: Agreements) -> float:
    """Share of the misfit beyond what sensors differ by, root mean square, that stays in the relations bettered."""
    better = _better(before, after)
    was, stays = (sum(found[name].excess for name in better) for found in (before, after))
    return float(np.sqrt(stays / was)) if was > 0 else 1.0


def _better(before: Agreements, after: Agreements) -> list[str]:
    return [name for name in after if after[name].score < before[name].score - 0.1]


def _unexplained(best: Candidate, before: Agreements) -> Finding:
    """A misfit that no hypothesis explains, as a finding without a cause."""
    name = max(best.after, key=lambda relation: before[relation].score - best.after[relation].score)
    columns = ", ".join(COLUMNS[stream] for stream in SIDES[name])
    one = best.hypothesis
    text = f"{before[name].words}; the nearest hypothesis ({one.where}: {one.text}) leaves {best.left:.0%} of it,"
    return Finding("misfit", "warning", columns, f"{text} so none is named", f"{MOST_LEFT:.0%}")


def _tried(one: Hypothesis, windows: Windows, before: Agreements) -> tuple[float, Windows, Agreements]:
    """By how much a hypothesis lowers J, less what it claims; the windows after it and how well they agree."""
    changed = one.apply(windows)
    after = agreements(changed, before, one.streams)
    if one.streams == "pv":  # of two streams changed alike, their relation says nothing
        after["velocity"] = before["velocity"]
    return total(before) - total(after) - TIE * one.cost, changed, after


def _more_than_nothing(one: Hypothesis, windows: Windows, before: Agreements, after: Agreements) -> bool:
    """Whether a stream in another unit explains more than the same stream set to zero does."""
    zero = {name: 0.0 * windows.of(name) for name in one.streams if name in "pvwf"}
    nothing = agreements(windows.having(**zero), before, one.streams)
    if one.streams == "pv":
        nothing["velocity"] = before["velocity"]
    return not zero or total(nothing) - total(after) > LEAST_GAIN


def _scales(found: Agreements) -> tuple[Hypothesis, ...]:
    """Factors between two streams that are otherwise alike."""
    for relation, streams, least in (("velocity", "vp", 0.015), ("rate", "wq", 0.05)):
        one = found.get(relation)
        if one is not None and one.correlation > ALIKE:
            return scale_hypotheses(one.gain, streams) if abs(one.gain - 1) > least else ()
    return ()


def _clock(found: Agreements) -> Hypothesis | None:
    """A clock that runs wrong: velocity against dp/dt and rates against the attitude are off by one factor.

    Where the gyro is too noisy to say by how much it is off, a small factor is put down to the clock as well: scales
    of position or velocity that are wrong by a few per cent are rarer than that.
    """
    velocity, rate = found.get("velocity"), found.get("rate")
    if velocity is None:
        if rate is None or rate.correlation < 0.995 or abs(rate.gain - 1) < 0.03:
            return None
        return clock_hypothesis(rate.gain) if abs(rate.gain / np.degrees(1) - 1) > 0.1 else None
    if velocity.correlation < ALIKE or abs(velocity.gain - 1) < 0.015:
        return None
    size = np.log(velocity.gain)
    if rate is None or rate.correlation < 0.7:
        return clock_hypothesis(velocity.gain) if abs(size) < 0.15 else None
    share = np.log(rate.gain) / size
    if rate.correlation > ALIKE or abs(size) > 0.3:
        return clock_hypothesis(velocity.gain) if 0.5 < share < 1.5 else None
    return clock_hypothesis(velocity.gain)


def _settled(found: Agreements) -> bool:
    """Whether every relation holds to within what its sensors differ by, on every axis: there is nothing to explain."""
    return all((one.residual < 0.7 * one.floor).all() for one in found.values())


def _plausible(one: Hypothesis, before: Agreements, after: Agreements) -> bool:
    """A hypothesis must make two moving streams agree, not only make both small, and must make no relation worse."""
    better = _better(before, after)
    worse = [name for name in after if after[name].score > before[name].score + 1.0]
    odd = one.name in ("axis_swap", "sign_flip", "units") and all(name.startswith("thrust") for name in better)
    if worse or (odd and not _smaller(CLEAR, before, after, better)):
        return False
    return any(after[name].ratio < DISAGREE and after[name].size > MOVING * after[name].floor for name in better)


def _telling(before: Agreements, after: Agreements) -> bool:
    """Whether a factor removes most of a residual; a slope due to noise does not."""
    return _smaller(TELLING, before, after, [name for name in ("velocity", "rate") if name in after])


def _smaller(share: float, before: Agreements, after: Agreements, names: list[str]) -> bool:
    """Whether of one of these relations less than this share of the residual is left."""
    left = [np.sum(after[name].residual ** 2) < share**2 * np.sum(before[name].residual ** 2) for name in names]
    return any(left)


def stray(windows: Windows) -> list[tuple[Finding, np.ndarray]]:
    """Stretches where an accelerometer or gyro contradicts the other sensors but agrees with them elsewhere.

    Each with the first and last times of its windows, (n, 2) (s).
    """
    found = []
    every = {pair.relation: pair for pair in pairs(windows)}
    for name, relations in (("acceleration_outlier", ("force", "force (p)")), ("rate_outlier", ("rate",))):
        pair = next((every[relation] for relation in relations if relation in every), None)
        if pair is None:
            continue
        size = np.linalg.norm(pair.found - pair.expected, axis=1)
        limit = max(STRAY * 1.4826 * float(np.median(size)), STRAY_FLOOR[name])
        bad = size > limit
        if bad.mean() < 0.005 or bad.mean() > 0.4:  # a knock, or something else than a stretch
            continue
        ends = np.stack([windows.t[:, 0], windows.t[:, -1]], axis=1)
        when = (np.concatenate([ends, ends]) if len(size) == 2 * len(ends) else ends)[bad]
        low, high = float(when[:, 0].min()), float(when[:, 0].max())
        text = f"off by up to {size.max():.4g} {WORDS[pair.relation][1]} in {bad.mean():.1%} of the windows"
        where = f"{COLUMNS['w' if name == 'rate_outlier' else 'f']}, {low:.2f}..{high:.2f} s"
        allowed = f"{limit:.3g} from the motion"
        found.append((Finding(name, "blocking", where, text, allowed, LEAVE_OUT, (low, high)), when))
    return found


def disagreements(windows: Windows) -> list[Finding]:
    """Relations that no hypothesis explains."""
    found = []
    for one in agreements(windows).values():
        moving = np.sqrt(np.sum(one.signal**2)) > 2 * one.floor
        if moving and one.ratio > DISAGREE and one.correlation < 0.5:
            columns = ", ".join(COLUMNS[name] for name in SIDES[one.relation])
            text = f"{one.words}, correlation {one.correlation:.2f}; no change of unit, frame or sign mends it"
            found.append(Finding("inconsistent", "blocking", columns, text, f"{DISAGREE:.0%} of the signal"))
    return found
