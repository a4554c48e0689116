"""Units, frames, signs and clock of a flight: which hypothesis makes its streams agree with one another.

The score of a hypothesis is the log likelihood of the relations' residuals, each axis with a variance of its own,

    J = sum over relations and axes of log(r^2 + floor^2),

r the root mean square residual of the smaller nine tenths (spikes are another check's business). A repair is taken
when it lowers J by more than `LEAST_GAIN` and leaves what it changed in agreement; then the search goes on with the
repaired flight, so that faults in several streams are named one by one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from quadexp.log.check.finding import LEAVE_OUT, Finding
from quadexp.log.check.mounting import mounting_repairs
from quadexp.log.check.repairs import COLUMNS, Repair, clock_repair, repairs, scale_repairs
from quadexp.log.check.windows import SIDES, STREAMS, Pair, Windows, pairs

KEPT = 0.9  # share of the windows that a residual is taken over
LEAST_GAIN = 0.35  # clean flights of every kind at hand stay below 0.06
TIE = 0.15  # of J a unit of cost: a repair that claims more must explain more
MOST_FAULTS = 4
MOST_LEFT = 0.4  # of a misfit: a repair that leaves as much names no fault
CLEARLY = 0.3  # of J, by which a fault must explain more than a turned sensor does
FEW, FINALISTS = 100, 10  # every hypothesis is tried on so many windows first, the best ones on all
STRAY = 12.0  # robust standard deviations
STRAY_FLOOR = {"acceleration_outlier": 8.0, "rate_outlier": 4.0}  # m/s^2 and rad/s, means over a window
MOVING = 2.0  # floors that a stream must move by to be compared
TELLING = 0.6  # of a residual that may be left once a factor is undone
CLEAR = 0.4  # of a residual that may be left where a log without IMU is said to have axes that no convention has
ALIKE = 0.98  # correlation above which a factor between two streams means something
DISAGREE = 0.7  # residual over signal above which two streams say different things
WEIGHT = {"force (p)": 0.5, "thrust": 1.0, "thrust (p)": 0.5}
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


def agreements(
    windows: Windows, known: dict[str, Agreement] | None = None, changed: str = "tpqvwf"
) -> dict[str, Agreement]:
    """Of every relation; those that have none of the streams `changed` are taken from `known`."""
    return {**(known or {}), **{pair.relation: agreement(pair) for pair in pairs(windows, touching=changed)}}


def present(windows: Windows) -> frozenset[str]:
    return frozenset(name for name in STREAMS if getattr(windows, name) is not None)


def _total(found: dict[str, Agreement]) -> float:
    return sum(one.score for one in found.values())


@dataclass(frozen=True)
class Explained:
    """A repair that was taken, what it did to the relations it touches, and by how much it lowered J."""

    repair: Repair
    before: dict[str, Agreement]
    after: dict[str, Agreement]
    gain: float

    def finding(self) -> Finding:
        touched = [
            name
            for name, one in self.before.items()
            if np.sum(one.residual**2) > 1.3 * np.sum(self.after[name].residual ** 2)
        ] or list(self.before)
        name = max(touched, key=lambda relation: self.before[relation].score - self.after[relation].score)
        _, unit = WORDS[name]
        rest = np.sqrt(np.sum(self.after[name].residual ** 2))
        return Finding(
            self.repair.name,
            self.repair.severity,
            self.repair.where,
            f"{self.repair.text}: {self.before[name].words}, by {rest:.3g} {unit} once that is undone",
            "SI units, world ENU, body FLU, quaternion body to world with w first",
            self.repair.advice,
        )


@dataclass(frozen=True)
class Candidate:
    """A repair that was tried. value: by how much it lowers J, its cost taken off; left: share of the misfit of the
    relations it betters that stays."""

    value: float
    repair: Repair
    windows: Windows
    after: dict[str, Agreement]
    left: float


def explain(windows: Windows) -> tuple[list[Explained], Windows, list[Finding]]:
    """The repairs that the flight needs, most telling first; the windows after them; a misfit that none explains.

    A turned sensor is the first hypothesis: another one is taken only where it explains the flight clearly better. A
    repair that would block and leaves MOST_LEFT of the misfit or more is not taken.
    """
    taken: list[Explained] = []
    before = agreements(windows)
    clock = _clock(before)
    if clock is not None:
        changed = clock.apply(windows)
        after = agreements(changed)
        if _telling(before, after):
            windows = changed
            taken.append(Explained(clock, before, after, _total(before) - _total(after)))
            before = after
    doubtful: list[Finding] = []
    while before and not _settled(before) and len(taken) < MOST_FAULTS:
        found = _candidates(windows, before, taken)
        doubtful = []
        named = [one for one in found if one.left < MOST_LEFT or one.repair.severity != "blocking"]
        if not named:
            doubtful = [_unexplained(found[0], before)] if found else []
            break
        best = named[0]
        mount = next((one for one in named if one.repair.name == "mounting"), None)
        if mount is not None and mount.repair.severity != "blocking" and mount.value > best.value - CLEARLY:
            best = mount
        taken.append(Explained(best.repair, before, best.after, best.value))
        windows = best.windows
        before = agreements(windows)
    return taken, windows, doubtful


def _candidates(windows: Windows, before: dict[str, Agreement], taken: list[Explained]) -> list[Candidate]:
    """Repairs that may be taken next, the best first."""
    done = {(one.repair.streams, one.repair.name) for one in taken[-1:]}
    done |= {(streams, "mounting") for one in taken if one.repair.name == "mounting" for streams in ("f", "w", "wf")
             if set(streams) & set(one.repair.streams)}  # fmt: skip
    every = [
        repair for repair in (*repairs(present(windows)), *_scales(before)) if (repair.streams, repair.name) not in done
    ]
    few = windows.every(max(1, len(windows.t) // FEW))
    known = agreements(few)
    coarse = [_tried(repair, few, known)[0] for repair in every]
    likely = [every[i] for i in np.argsort(coarse)[::-1][:FINALISTS] if coarse[i] > 0]
    likely += [repair for repair in mounting_repairs(windows) if (repair.streams, repair.name) not in done]
    found = []
    for repair in likely:
        value, changed, after = _tried(repair, windows, before)
        if repair.name == "scale" and not _telling(before, after):
            continue
        if repair.name == "units" and not _more_than_nothing(repair, windows, before, after):
            continue
        if value > LEAST_GAIN and _plausible(repair, before, after):
            found.append(Candidate(value, repair, changed, after, _left(before, after)))
    if not any(one.repair.severity == "blocking" and one.left < MOST_LEFT for one in found):
        found += _under_a_mount(windows, before, likely, max((one.value for one in found), default=0.0))
    blocking = max((one.value for one in found if one.repair.name != "mounting"), default=-np.inf)
    found = [
        one
        for one in found
        if one.repair.name != "mounting" or one.repair.severity != "blocking" or one.value > blocking + CLEARLY
    ]
    return sorted(found, key=lambda one: -one.value)


def _under_a_mount(
    windows: Windows, before: dict[str, Agreement], likely: list[Repair], alone: float
) -> list[Candidate]:
    """Faults of a sensor that is turned besides: each repair is judged with the turn that is left undone too.

    alone: what the best single repair explains; two must explain clearly more.
    """
    found = []
    for repair in likely:
        if (
            repair.severity != "blocking"
            or repair.name in ("mounting", "scale")
            or not set("pvqf") & set(repair.streams)
        ):
            continue
        changed = repair.apply(windows)
        known = agreements(changed, before, repair.streams)
        mount = next(
            (one for one in mounting_repairs(changed) if one.streams == "f" and one.severity != "blocking"), None
        )
        if mount is None:
            continue
        after = agreements(mount.apply(changed), known, "f")
        value = _total(before) - _total(after) - TIE * (repair.cost + mount.cost)
        if value > alone + CLEARLY + LEAST_GAIN and _plausible(repair, before, after):
            found.append(Candidate(value, repair, changed, known, _left(before, after)))
    return found


def _left(before: dict[str, Agreement], after: dict[str, Agreement]) -> float:
    """Share of the misfit beyond what sensors differ by, root mean square, that stays in the relations bettered."""
    better = [name for name in after if after[name].score < before[name].score - 0.1]
    was, stays = (sum(found[name].excess for name in better) for found in (before, after))
    return float(np.sqrt(stays / was)) if was > 0 else 1.0


def _unexplained(best: Candidate, before: dict[str, Agreement]) -> Finding:
    """A misfit that is said, and no name given to it."""
    name = max(best.after, key=lambda relation: before[relation].score - best.after[relation].score)
    columns = ", ".join(COLUMNS[stream] for stream in SIDES[name])
    text = f"{before[name].words}; the hypothesis that comes nearest ({best.repair.where}: {best.repair.text}) leaves"
    return Finding("misfit", "warning", columns, f"{text} {best.left:.0%} of it, so none is named", f"{MOST_LEFT:.0%}")


def _tried(
    repair: Repair, windows: Windows, before: dict[str, Agreement]
) -> tuple[float, Windows, dict[str, Agreement]]:
    """By how much a repair lowers J, less what it claims; the windows after it and how well they agree."""
    changed = repair.apply(windows)
    after = agreements(changed, before, repair.streams)
    if repair.streams == "pv":  # of two streams changed alike, their relation says nothing
        after["velocity"] = before["velocity"]
    return _total(before) - _total(after) - TIE * repair.cost, changed, after


def _more_than_nothing(
    repair: Repair, windows: Windows, before: dict[str, Agreement], after: dict[str, Agreement]
) -> bool:
    """Whether a stream in another unit explains more than the same stream set to zero: small is not right."""
    zero = {name: 0.0 * windows.of(name) for name in repair.streams if name in "pvwf"}
    nothing = agreements(windows.having(**zero), before, repair.streams)
    if repair.streams == "pv":
        nothing["velocity"] = before["velocity"]
    return not zero or _total(nothing) - _total(after) > LEAST_GAIN


def _scales(found: dict[str, Agreement]) -> tuple[Repair, ...]:
    """Factors between two streams that are otherwise alike."""
    for relation, streams, least in (("velocity", "vp", 0.015), ("rate", "wq", 0.05)):
        one = found.get(relation)
        if one is not None and one.correlation > ALIKE:
            return scale_repairs(one.gain, streams) if abs(one.gain - 1) > least else ()
    return ()


def _clock(found: dict[str, Agreement]) -> Repair | None:
    """A clock that runs wrong: velocity against dp/dt and rates against the attitude are off by one factor.

    Where the gyro is too noisy to say by how much it is off, a small factor is put down to the clock as well: scales
    of position or velocity that are wrong by a few per cent are rarer than that.
    """
    velocity, rate = found.get("velocity"), found.get("rate")
    if velocity is None:
        if rate is None or rate.correlation < 0.995 or abs(rate.gain - 1) < 0.03:
            return None
        return clock_repair(rate.gain) if abs(rate.gain / np.degrees(1) - 1) > 0.1 else None
    if velocity.correlation < ALIKE or abs(velocity.gain - 1) < 0.015:
        return None
    size = np.log(velocity.gain)
    if rate is None or rate.correlation < 0.7:
        return clock_repair(velocity.gain) if abs(size) < 0.15 else None
    share = np.log(rate.gain) / size
    if rate.correlation > ALIKE or abs(size) > 0.3:
        return clock_repair(velocity.gain) if 0.5 < share < 1.5 else None
    return clock_repair(velocity.gain)


def _settled(found: dict[str, Agreement]) -> bool:
    """Whether every relation holds to within what its sensors differ by, on every axis: there is nothing to explain."""
    return all((one.residual < 0.7 * one.floor).all() for one in found.values())


def _plausible(repair: Repair, before: dict[str, Agreement], after: dict[str, Agreement]) -> bool:
    """A repair must bring two streams together that move, not only make both small, and must break nothing."""
    better = [name for name in after if after[name].score < before[name].score - 0.1]
    worse = [name for name in after if after[name].score > before[name].score + 1.0]
    odd = repair.name in ("axis_swap", "sign_flip", "units") and all(name.startswith("thrust") for name in better)
    if odd and not any(
        np.sum(after[name].residual ** 2) < CLEAR**2 * np.sum(before[name].residual ** 2) for name in better
    ):
        return False
    return not worse and any(
        after[name].ratio < DISAGREE and after[name].size > MOVING * after[name].floor for name in better
    )


def _telling(before: dict[str, Agreement], after: dict[str, Agreement]) -> bool:
    """Whether a factor takes most of a residual away: a slope that noise has made does not."""
    return any(
        np.sum(after[name].residual ** 2) < TELLING**2 * np.sum(before[name].residual ** 2)
        for name in ("velocity", "rate")
        if name in after
    )


def stray(windows: Windows) -> list[tuple[Finding, np.ndarray]]:
    """Stretches where an accelerometer or gyro leaves the motion that the other sensors see, agreeing elsewhere.

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
        halves = len(size) == 2 * len(windows.t)
        time = np.concatenate([windows.t[:, 0]] * 2) if halves else windows.t[:, 0]
        low, high = float(time[bad].min()), float(time[bad].max())
        text = f"off by up to {size.max():.4g} {WORDS[pair.relation][1]} in {bad.mean():.1%} of the windows"
        column = COLUMNS["w" if name == "rate_outlier" else "f"]
        where = f"{column}, {low:.2f}..{high:.2f} s"
        ends = np.stack([windows.t[:, 0], windows.t[:, -1]], axis=1)
        when = (np.concatenate([ends, ends]) if halves else ends)[bad]
        allowed = f"{limit:.3g} from the motion"
        found.append((Finding(name, "blocking", where, text, allowed, LEAVE_OUT, (low, high)), when))
    return found


def disagreements(windows: Windows) -> list[Finding]:
    """Relations that no repair explains."""
    found = []
    for one in agreements(windows).values():
        moving = np.sqrt(np.sum(one.signal**2)) > 2 * one.floor
        if moving and one.ratio > DISAGREE and one.correlation < 0.5:
            columns = ", ".join(COLUMNS[name] for name in SIDES[one.relation])
            found.append(
                Finding(
                    "inconsistent",
                    "blocking",
                    columns,
                    f"{one.words}, correlation {one.correlation:.2f}; no change of unit, frame or sign mends it",
                    f"{DISAGREE:.0%} of the signal",
                )
            )
    return found
