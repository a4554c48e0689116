"""The report's figures: each panel as inline SVG for the page, and together as Figures for paper."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import matplotlib
from matplotlib.lines import Line2D

from quadexp.log.outcome import UNFLOWN
from quadexp.log.schema import Flight, describe
from quadexp.report.page.palette import PAGE, PAPER, STYLE, inline_svg
from quadexp.report.page.panels import (
    Checkpoint,
    Course,
    course_title,
    courses,
    estimate_panel,
    fit_panel,
    identified,
    labels_on,
    pareto_front,
    pareto_panel,
    pareto_points,
    read_checkpoint,
    speed_panel,
    truth,
)  # fmt: skip
from quadexp.report.page.power import Powered, battery_panel, end_of_charge, powered, rotor_columns, rotor_panel
from quadexp.report.page.source import Comparison, spoken
from quadexp.report.page.swept import Swept, swept_figures, swept_paper
from quadexp.report.style import Figure
from quadexp.report.text import number, percent

SIZE = 3.9, 3.0  # inches, of a panel
WIDE = 6.2, 4.1
MAX_COURSES = 12
PREDICTORS = {"gp": "GP", "linear_drag": "linear drag", "zero": "nothing"}

Draw = Callable[..., None]  # (panel, palette=Palette)


@dataclass
class PageFigures:
    """SVG of every part, and the data of the text beside it. swept: over the keys swept. speed: a panel per course.
    power, fits, estimates: for the template. powered, checkpoints, estimated: their sources. power_left: worlds that
    power leaves out."""

    swept: Swept = field(default_factory=Swept)
    speed: list[str] = field(default_factory=list)
    speed_labels: list[str] = field(default_factory=list)
    pareto: str = ""
    points: dict[str, tuple[float, float, float, float]] = field(default_factory=dict)
    front: list[str] = field(default_factory=list)
    power: list[dict[str, Any]] = field(default_factory=list)
    power_left: int = 0
    fits: list[dict[str, Any]] = field(default_factory=list)
    estimates: list[dict[str, Any]] = field(default_factory=list)
    powered: list[Powered] = field(default_factory=list)
    checkpoints: list[Checkpoint] = field(default_factory=list)
    estimated: list[tuple[str, list[tuple[str, Flight]]]] = field(default_factory=list)


def draw_page(comparison: Comparison) -> PageFigures:
    """All figures of the page."""
    made = PageFigures(swept_figures(comparison))
    drawn: list[list[str]] = []
    for i, course in enumerate(shown_courses(comparison, made.swept)[:MAX_COURSES]):
        draw = partial(speed_panel, comparison=comparison, course=course)
        made.speed.append(panel_svg(draw, f"speed{i}", f"Error over speed, {course_title(comparison, course)}"))
        drawn.append(labels_on(comparison, course))
    made.speed_labels = list(dict.fromkeys(label for labels in drawn for label in labels))
    made.points = pareto_points(comparison)
    made.front = pareto_front(made.points, comparison.bounds)
    if made.points:
        draw = partial(pareto_panel, comparison=comparison)
        made.pareto = panel_svg(draw, "pareto", "Error against computing time", WIDE)
    made.powered, made.power_left = powered(comparison)
    made.power = [_power(comparison, one, i) for i, one in enumerate(made.powered)]
    made.checkpoints = checkpoints(comparison)
    made.fits = [_fit(checkpoint, i) for i, checkpoint in enumerate(made.checkpoints)]
    made.estimated = estimated(comparison)
    made.estimates = [_estimates(comparison, title, flights, i) for i, (title, flights) in enumerate(made.estimated)]
    return made


def shown_courses(comparison: Comparison, swept: Swept) -> list[Course]:
    """The courses whose error over the speed is drawn: none where one speed was flown, or where the figures over what
    was swept have it."""
    speeds = {row["speed"] for row in comparison.rows if row["speed"] is not None}
    return [] if len(speeds) < 2 or swept.over_speed and not swept.left else courses(comparison)


def panel_svg(draw: Draw, name: str, label: str, size: tuple[float, float] = SIZE) -> str:
    """One panel as inline SVG."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure.subplots(), palette=PAGE)
        return inline_svg(figure, name, label)


def _power(comparison: Comparison, one: Powered, i: int) -> dict[str, Any]:
    draws = _power_draws(comparison, one)
    panels = [panel_svg(draw, f"power{i}{k}", f"{name}, {one.title}") for k, (name, draw) in enumerate(draws.items())]
    ends = [f"{spoken(label)} {share}" for label, flight in one.flights if (share := end_of_charge(flight))]
    text = f"Charge left at the end: {', '.join(ends)}." if ends else ""
    return {"title": one.title, "labels": [label for label, _ in one.flights], "panels": panels, "text": text}


def _power_draws(comparison: Comparison, one: Powered) -> dict[str, Draw]:
    battery = any("battery_voltage" in flight.columns for _, flight in one.flights)
    rotors = any(rotor_columns(flight) for _, flight in one.flights)
    draws = {"Battery voltage": battery_panel} if battery else {}
    draws |= {"Rotors": rotor_panel} if rotors else {}
    return {name: partial(draw, flights=one.flights, look=comparison.look) for name, draw in draws.items()}


def checkpoints(comparison: Comparison) -> list[Checkpoint]:
    """Checkpoints that flew, each once."""
    found: dict[str, str] = {}
    for row in comparison.rows:
        if row["model"] and row["model"] not in found and row["outcome"] not in UNFLOWN:
            record = comparison.flight_record(row)
            found[row["model"]] = (record or {}).get("model_sha256", "")
    return [read_checkpoint(path, sha256) for path, sha256 in found.items()]


def _fit(checkpoint: Checkpoint, i: int) -> dict[str, Any]:
    path = checkpoint.path.rstrip("/")
    if checkpoint.model is None:
        return {"path": path, "panels": [], "text": f"Not drawn: {checkpoint.note or 'it holds linear drag only'}."}
    outputs, data = checkpoint.model.outputs, checkpoint.model.dataset
    draws = [partial(fit_panel, checkpoint=checkpoint, output=output) for output in outputs]
    names = [f"Residual {output.output} over {output.features[0]}" for output in outputs]
    panels = [panel_svg(draw, f"fit{i}{k}", name) for k, (draw, name) in enumerate(zip(draws, names, strict=True))]
    text = "; ".join(f"{o.output} from {', '.join(o.features)}, {len(o.alpha)} points" for o in outputs) + "."
    text += f" Fitted to {data['rows']} samples of {data['flights']} flights." if data.get("rows") else ""
    has_data = checkpoint.data is not None
    scores = _scores(checkpoint.report.get("rows", []))
    return {"path": path, "panels": panels, "text": text, "has_data": has_data, **scores}


def _scores(rows: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Held-out errors of a checkpoint's report, a line per output and a column per predictor."""
    predictors = [name for name in dict.fromkeys(row["predictor"] for row in rows) if name in PREDICTORS]
    texts = {
        (row["output"], row["predictor"]): {
            "rmse": f"{row['rmse']:.3g}",
            "inside": percent(100 * row["inside_2"], least=0)[0],
        }
        for row in rows
        if row["predictor"] in PREDICTORS
    }
    lines = []
    for output in dict.fromkeys(row["output"] for row in rows):
        name, _, index = output.partition("_")
        unit = describe(output, "residuals").unit.replace("^2", "²")
        cells = [texts.get((output, predictor), {}) for predictor in predictors]
        lines.append({"name": name, "index": index, "unit": unit, "cells": cells})
    return {"scores": lines, "predictors": [PREDICTORS[name] for name in predictors]}


def estimated(comparison: Comparison) -> list[tuple[str, list[tuple[str, Flight]]]]:
    """Per trajectory and plant the flights that identified coefficients: fastest speed, one per contestant."""
    chosen: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for row in comparison.rows:
        identifies = "rls" in row["controller"] or row["controller"].startswith("literal")
        if identifies and row["outcome"] not in UNFLOWN:
            fastest = chosen.setdefault((row["plant"], row["trajectory"]), {})
            rival = fastest.setdefault(comparison.label(row), row)
            if (row["speed"] or 0) > (rival["speed"] or 0):
                fastest[comparison.label(row)] = row
    made = []
    for (plant, trajectory), rows in chosen.items():
        flights = [(label, f) for label, row in rows.items() if (f := comparison.flight(row)) is not None]
        if flights := [(label, f) for label, f in flights if identified(f)]:
            made.append((f"{trajectory} on {plant}", flights))
    return made


def _estimates(comparison: Comparison, title: str, flights: list[tuple[str, Flight]], i: int) -> dict[str, Any]:
    (label, last), draws = flights[0], _estimate_draws(comparison, flights)
    panels = [panel_svg(draw, f"estimate{i}{name}", f"{name} identified over time") for name, draw in draws.items()]
    ends = [
        f"{name} {number(float(last[name][-1]))} of {number(float(true[-1]))}"
        for name in draws
        if (true := truth(last, name)) is not None and math.isfinite(float(last[name][-1]))
    ]
    text = f"Dashed: the plant's own value. At the end, {spoken(label)}: {', '.join(ends)}." if ends else ""
    return {"title": title, "labels": [label for label, _ in flights], "panels": panels, "text": text}


def _estimate_draws(comparison: Comparison, flights: list[tuple[str, Flight]]) -> dict[str, Draw]:
    draw = partial(estimate_panel, flights=flights, look=comparison.look)
    return {name: partial(draw, name=name) for name in identified(flights[0][1])}


def draw_paper(comparison: Comparison, drawn: PageFigures) -> dict[str, Figure]:
    """The same figures for a paper: name -> Figure with all its panels and a legend."""
    figures: dict[str, Figure] = {}
    figures |= swept_paper(drawn.swept)
    flown = shown_courses(comparison, drawn.swept)[:MAX_COURSES]
    if flown:
        draws: list[Draw] = [partial(speed_panel, comparison=comparison, course=course) for course in flown]
        figures["error_against_speed"] = _sheet(draws, _handles(comparison, drawn.speed_labels))
    if drawn.points:
        figures["error_against_time"] = _sheet([partial(pareto_panel, comparison=comparison)], [], WIDE)
    for one in drawn.powered:
        draws = list(_power_draws(comparison, one).values())
        figures[_file("power", one.title)] = _sheet(draws, _handles(comparison, [label for label, _ in one.flights]))
    for checkpoint in drawn.checkpoints:
        if checkpoint.model is not None:
            draws = [partial(fit_panel, checkpoint=checkpoint, output=output) for output in checkpoint.model.outputs]
            figures[_file("residuals", checkpoint.path)] = _sheet(draws, [])
    for title, flights in drawn.estimated:
        draws = list(_estimate_draws(comparison, flights).values())
        figures[_file("coefficients", title)] = _sheet(draws, _handles(comparison, [label for label, _ in flights]))
    return figures


def _sheet(draws: list[Draw], handles: list[Line2D], size: tuple[float, float] = SIZE) -> Figure:
    """Panels in rows of up to three, a legend below."""
    columns = min(3, len(draws))
    lines = -(-len(draws) // columns)
    with matplotlib.rc_context(STYLE):
        legend = 0.35 * -(-len(handles) // 4)
        figure = Figure(figsize=(0.85 * size[0] * columns, 0.9 * size[1] * lines + legend), layout="constrained")
        panels = figure.subplots(lines, columns, squeeze=False)
        for panel, draw in zip(panels.flat, draws, strict=False):
            draw(panel, palette=PAPER)
        for panel in panels.flat[len(draws) :]:
            panel.set_axis_off()
        if handles:
            figure.legend(handles=handles, loc="outside lower center", ncols=min(4, len(handles)))
    return figure


def _handles(comparison: Comparison, labels: list[str]) -> list[Line2D]:
    look = comparison.look
    return [Line2D([], [], linestyle=look[x].dash, label=spoken(x), **PAPER.mark(look[x])) for x in labels]


def _file(prefix: str, name: str) -> str:
    """A file name without blanks or separators."""
    return f"{prefix}_" + "".join(c if c.isalnum() else "_" for c in name.strip("/")).strip("_")
