"""The two families on one bench: every controller on both plants, as a table and as a figure.

Learned residuals (GP, linear drag) and identified physics (RLS on the blade-element model), under feedback and under
MPC. `perfect_mpc` and `oracle_feedback` know the plant and bound their kinds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from quadexp.report.style import looks, plain_log, styled

ORDER = (
    "nominal_mpc",
    "linear_drag_mpc",
    "gp_mpc",
    "rls_mpc",
    "perfect_mpc",
    "static_feedback",
    "rls_feedback",
    "oracle_feedback",
)
BOUNDS = ("perfect_mpc", "oracle_feedback")  # know the plant: never the winner

Row = Mapping[str, Any]
Condition = tuple[str, str, float]


def by_condition(rows: Sequence[Row]) -> dict[Condition, dict[str, list[Row]]]:
    """(plant, trajectory, speed) -> controller -> rows; conditions as they come, by speed within a trajectory."""
    found: dict[Condition, dict[str, list[Row]]] = {}
    for row in rows:
        condition = (row["plant"], row["trajectory"], float(row["speed"]))
        found.setdefault(condition, {}).setdefault(row["controller"], []).append(row)
    places = list(dict.fromkeys(condition[:2] for condition in found))
    return {c: found[c] for c in sorted(found, key=lambda c: (places.index(c[:2]), c[2]))}


def mean_error(rows: Sequence[Row]) -> float | None:
    """Mean position error over the flights (m), None unless all of them ended well."""
    if not rows or any(row["outcome"] != "ok" for row in rows):
        return None
    return float(np.mean([row["mean_error"] for row in rows]))


def families_table(rows: Sequence[Row]) -> str:
    """Markdown: mean position error (mm) by condition and controller; bold: the least of those who had to find out."""
    conditions = by_condition(rows)
    flown = {controller for row in conditions.values() for controller in row}
    names = [name for name in ORDER if name in flown] + sorted(flown - set(ORDER))
    lines = [
        "Mean position error over the flight (mm), over seeds; bold: the least but for the two that know the plant",
        "",
        "| plant | trajectory | m/s | " + " | ".join(names) + " |",
        "|---|---|---:|" + "---:|" * len(names),
    ]
    for (plant, trajectory, speed), by_controller in conditions.items():
        errors = {name: mean_error(by_controller.get(name, [])) for name in names}
        candidates = [error for name, error in errors.items() if error is not None and name not in BOUNDS]
        least = min(candidates, default=None)
        cells = [_cell(by_controller.get(name, []), errors[name], least, name) for name in names]
        lines.append(f"| {plant} | {trajectory} | {speed:g} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _cell(rows: Sequence[Row], error: float | None, least: float | None, name: str) -> str:
    if not rows:
        return ""
    if error is None:
        ended: dict[str, int] = {}
        for row in rows:
            if row["outcome"] != "ok":
                ended[row["outcome"]] = ended.get(row["outcome"], 0) + 1
        return ", ".join(f"{count} of {len(rows)} {what}" for what, count in ended.items())
    shown = f"{1e3 * error:.0f}" if error >= 0.1 else f"{1e3 * error:.3g}"
    return f"**{shown}**" if error == least and name not in BOUNDS else shown


@styled
def families_figure(rows: Sequence[Row]) -> Figure:
    """Mean position error (m, logarithmic) over speed; a line of panels per plant, a panel per trajectory.

    A condition in which a flight was not finished has no point.
    """
    conditions = by_condition(rows)
    plants = list(dict.fromkeys(plant for plant, _, _ in conditions))
    trajectories = list(dict.fromkeys(trajectory for _, trajectory, _ in conditions))
    present = {row["controller"] for row in rows}
    figure = Figure(figsize=(1.0 + 2.7 * len(trajectories), 0.9 + 2.6 * len(plants)), layout="constrained")
    panels = figure.subplots(len(plants), len(trajectories), sharey=True, squeeze=False)
    worn = looks(ORDER)
    for line, plant in zip(panels, plants, strict=True):
        for panel, trajectory in zip(line, trajectories, strict=True):
            here = {c[2]: v for c, v in conditions.items() if c[:2] == (plant, trajectory)}
            for name in (name for name in ORDER if name in present):
                points = [(speed, mean_error(found.get(name, []))) for speed, found in here.items()]
                points = [(speed, 1e3 * error) for speed, error in points if error is not None]
                if points:
                    panel.plot(*zip(*points, strict=True), label=name, linewidth=1.2, **worn[name].points())
            panel.set(yscale="log", title=f"{trajectory}, {plant}", xticks=sorted(here))
            panel.margins(x=0.1)
        line[0].set_ylabel("mean position error (mm)")
    plain_log(panels[0, 0].yaxis, minor=True)
    for panel in panels[-1]:
        panel.set_xlabel("trajectory.speed (m/s)")
    found: dict[str, Any] = {}
    for panel in panels.flat:
        for handle, label in zip(*panel.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    shown = [name for name in ORDER if name in found]
    figure.legend([found[name] for name in shown], shown, loc="outside lower center", ncols=4)
    return figure
