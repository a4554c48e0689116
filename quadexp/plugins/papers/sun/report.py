"""Tables and a figure of a sweep over the conditions of Sun et al. 2022, ours beside the published ones."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from quadexp.log.outcome import COMPLETED
from quadexp.names import distinct, named
from quadexp.plugins.drawing.style import Figure
from quadexp.plugins.page.draw import figure_of
from quadexp.plugins.page.places import Place, Point
from quadexp.plugins.page.view import Axis, View
from quadexp.plugins.papers.sun.conditions import (
    INFEASIBLE_SET,
    PUBLISHED,
    TITLES,
    Condition,
    conditions,
    ellipse_of,
    in_order,
    mean_of,
    with_logged,
    world_of,
)
from quadexp.plugins.papers.sun.data import CRASHED, FLIGHTS, INFEASIBLE, Ellipse, Published, published
from quadexp.report.inference import holm, mean_interval, paired_permutation
from quadexp.report.pairing import Row, Rows
from quadexp.report.paper import Drawn
from quadexp.report.table import Table

ALPHA = 0.05  # of intervals and tests
CLOSE = 0.2  # share by which a mean may differ and count as reproduced
OURS = "sun_mpc"  # the controller others are compared with
KNOWN_AGE = "+strapdown"  # late rows have it, others need not


def reproduced(mean: float, survivors: float, printed: Published) -> str:
    """ "yes" for a mean position error (m) within CLOSE of the printed one; "crashes" where that of the flights that
    did not crash is within it, so that the number of crashes explains the difference; else "no"; "" for NaN."""
    if np.isnan(mean):
        return ""
    if abs(mean / printed.position - 1) <= CLOSE:
        return "yes"
    if abs(survivors / printed.survivors - 1) <= CLOSE:
        return "crashes"
    return "no"


def draw(rows: Rows, out: Path) -> Drawn:
    """Tables and figure of a sweep."""
    flown = conditions(with_logged(rows, out))
    texts = [sun_table(flown), *(table.markdown() for table in [compared(rows)] if table.rows)]
    return {"sun": "\n\n".join(texts)}, {"sun": sun_figure(flown)}


def compared(flights: Iterable[Row]) -> Table:
    """Every controller against OURS with the same remedies, paired by ellipse; no line without one.

    Mean over ellipses of the RMSE with its 95 % interval, a lost flight counted as there. The ellipses are what varies:
    none of these plants has noise.
    """
    errors = _errors(flights)
    p = {}
    names = []  # of those that are compared, in the order of the rows
    for (name, world), of_ellipse in errors.items():
        ours = errors.get((_ours_of(name), world), {})
        both = [ellipse for ellipse in of_ellipse if ellipse in ours]
        if name != _ours_of(name) and both:
            differences = np.array([of_ellipse[ellipse] - ours[ellipse] for ellipse in both])
            p[name, world] = paired_permutation(differences)
            names += [name, _ours_of(name)]
    differs = named(p, holm(np.array([*p.values()])) < ALPHA)
    columns = [name for name in distinct(name for name, _ in errors) if name in names]
    lines = []
    for world in in_order(distinct(world for _, world in p)):
        cells = []
        for name in columns:
            star = "*" if differs.get((name, world)) else ""
            values = np.array([*errors.get((name, world), {}).values()])
            cells.append(f"{_with_limits(values)}{star}" if len(values) else "")
        lines.append([TITLES.get(world, world), *cells])
    title = f"RMSE (m), mean over ellipses [95 % interval], a lost flight {CRASHED[0]:g} m; * differs from {OURS} with"
    title += f" the same remedies (p < {ALPHA:g}, permutations paired by ellipse, Holm over {len(p)})"
    return Table(["condition", *columns], lines, title)


def _errors(flights: Iterable[Row]) -> dict[tuple[str, str], dict[Ellipse, float]]:
    """(controller, world) -> ellipse -> RMSE (m), that of a lost flight as it counts there. Late rows are those of a
    controller that knows the age of its pose, under the name of the one that it is elsewhere."""
    rows = list(flights)
    flown = {(row["controller"], world_of(row)) for row in rows}
    errors: dict[tuple[str, str], dict[Ellipse, float]] = {}
    for row in rows:
        name = str(row["controller"])
        world = world_of(row)
        short = name.removesuffix(KNOWN_AGE)
        if (short, world) not in flown:
            name = short
        lost = row["outcome"] not in COMPLETED
        errors.setdefault((name, world), {})[ellipse_of(row)] = CRASHED[0] if lost else float(row["rmse"])
    return errors


def _ours_of(name: str) -> str:
    """OURS with the same remedies."""
    _, plus, remedies = name.partition("+")
    return OURS + plus + remedies


def _with_limits(errors: np.ndarray) -> str:
    """A mean over ellipses with its interval."""
    low, high, method = mean_interval(errors, 1 - ALPHA, least=0.0)
    limits = "" if method == "none" else f" [{low:.3f}, {high:.3f}]"
    return f"{mean_of(errors):.3f}{limits}"


def sun_table(flown: Mapping[str, Mapping[str, Condition]]) -> str:
    """Markdown: every published controller, ours and theirs; every other one beside the best printed; all together."""
    tables = [_beside(name, flown[name]) for name in PUBLISHED if name in flown]
    tables += [_against_best(name, worlds) for name, worlds in flown.items() if name not in PUBLISHED]
    return "\n\n".join([*tables, _all(flown).markdown()])


def overview(rows: Iterable[Row]) -> Table:
    """All controllers side by side."""
    return _all(conditions(rows))


def _beside(name: str, worlds: Mapping[str, Condition]) -> str:
    printed = published()
    lines = []
    verdicts: dict[str, list[str]] = {"true position": [], "as logged": []}
    for world, ours in worlds.items():
        line = [TITLES.get(world, world), *_texts(ours), _number(ours.survivors, 3)]
        beside = [""] * 6
        if (theirs := printed.get((world, name))) is not None:
            verdicts["true position"].append(reproduced(ours.position[0], ours.survivors, theirs))
            verdicts["as logged"].append(reproduced(ours.logged[0], ours.logged_survivors, theirs))
            beside = [
                _with_sd((theirs.position, theirs.position_sd), 3),
                _with_sd((theirs.heading, theirs.heading_sd), 1),
            ]
            beside += [str(theirs.lost), _number(theirs.survivors, 3), *(texts[-1] for texts in verdicts.values())]
        lines.append(line + beside)
    heads = (
        "condition",
        "position (m)",
        "as logged (m)",
        "heading (deg)",
        "lost + > 2 m",
        "survivors (m)",
        "printed position (m)",
        "printed heading (deg)",
        "printed lost",
        "printed survivors (m)",
        "reproduced",
        "as logged",
    )
    notes = []
    for title, texts in verdicts.items():
        if texts:
            counts = ", ".join(f"{word} {texts.count(word)}" for word in ("yes", "crashes", "no"))
            notes.append(f"Mean position within {CLOSE:.0%} of the printed one, {title}: {counts} of {len(texts)}")
    flights = ", ".join(str(number) for number in sorted({condition.flights for condition in worlds.values()}))
    title = f"{name}: mean (SD) over {flights} flights of the RMSE; a lost flight counts {CRASHED[0]:g} m"
    return Table(heads, lines, title, notes=[*notes, *_apart(name, worlds)]).markdown()


def _against_best(name: str, worlds: Mapping[str, Condition]) -> str:
    """Both readings of the error beside the best mean that is printed, whichever controller has it."""
    best: dict[str, float] = {}
    for (world, _), theirs in published().items():
        best[world] = min(theirs.position, best.get(world, math.inf))
    lines = []
    for world, ours in worlds.items():
        possible = f"{_number(ours.possible_position, 3)} ({ours.possible})" if ours.possible < ours.flights else ""
        below = []
        for error in (ours.position, ours.logged):
            below.append("yes" if error[0] < best.get(world, -math.inf) else "no")
        printed = _number(best.get(world, math.nan), 3)
        lines.append([TITLES.get(world, world), *_texts(ours), possible, printed, *below])
    heads = (
        "condition",
        "position (m)",
        "as logged (m)",
        "heading (deg)",
        "lost + > 2 m",
        "possible (m, flights)",
        "best printed (m)",
        "below",
        "as logged",
    )
    return Table(heads, lines, f"{name}: mean (SD) over the flights, beside the best mean printed").markdown()


def _apart(name: str, worlds: Mapping[str, Condition]) -> list[str]:
    """Lines on the ellipses that the rotors can fly, where they cannot fly all, and on the infeasible set."""
    lines = [
        f"{TITLES.get(world, world)}: {condition.possible} ellipses take no more thrust than there is;"
        f" {condition.possible_lost} of these lost, the others {condition.possible_position:.3f} m"
        for world, condition in worlds.items()
        if condition.possible < condition.flights
    ]
    if INFEASIBLE_SET in worlds and name in INFEASIBLE:
        ours = worlds[INFEASIBLE_SET]
        (position, heading) = INFEASIBLE[name]
        lines.append(
            f"Infeasible ellipses, flights that did not crash: {ours.survivors:.3f} m, {ours.survivors_heading:.1f}"
            f" degrees; printed {position:.2f} m, {heading:.1f} degrees"
        )
    return lines


def _all(flown: Mapping[str, Mapping[str, Condition]]) -> Table:
    """All controllers: mean of the flights that did not crash, and how many did or are more than OFF m away."""
    worlds = in_order({world: None for by_world in flown.values() for world in by_world})
    lines = []
    for world in worlds:
        lines.append([TITLES.get(world, world), *(_short(by_world.get(world)) for by_world in flown.values())])
    title = "RMSE of the flights that did not crash (m); in brackets how many crashed + how many others are off by 2 m"
    return Table(["condition", *flown], lines, title)


def _texts(condition: Condition) -> list[str]:
    """Position, the same as logged, heading, and how many are lost or off."""
    lost = f"{condition.lost} + {condition.off}" if condition.off else str(condition.lost)
    return [_with_sd(condition.position, 3), _with_sd(condition.logged, 3), _with_sd(condition.heading, 1), lost]


def _short(condition: Condition | None) -> str:
    if condition is None:
        return ""
    text = _number(condition.survivors, 3)
    if condition.lost or condition.off:
        return f"{text} ({condition.lost}+{condition.off})"
    return text


def _with_sd(values: tuple[float, float], digits: int) -> str:
    return f"{values[0]:.{digits}f} ({values[1]:.{digits}f})"


def _number(value: float, digits: int) -> str:
    if np.isfinite(value):
        return f"{value:.{digits}f}"
    return "-"


def sun_figure(flown: Mapping[str, Mapping[str, Condition]]) -> Figure:
    """Position error of the flights that did not crash by condition, "k/n" where some did, beside what is printed."""
    places: dict[Place, Point] = {}
    for name, worlds in flown.items():
        for world, ours in worlds.items():
            places[name, world] = Point(ours.survivors, ended=ours.flights - ours.lost, trials=ours.flights)
        for (world, controller), theirs in published().items():
            if controller == name and world in worlds:
                point = Point(theirs.survivors, ended=FLIGHTS - theirs.lost, trials=FLIGHTS)
                places[f"{name} printed", world] = point
    names = TITLES | {"survivors": "survivors' position error (m)", "world": "condition"}
    x = Axis("world", tuple(in_order(dict.fromkeys(world for _, world in places))), "group", names)
    return figure_of(View("lines", "survivors", x, ("controller",), places=places, names=names))
