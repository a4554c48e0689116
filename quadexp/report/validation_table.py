"""The report of `quadexp validate` as text: one-step residuals, speed bands, open-loop errors."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from quadexp.report.table import Table

# Ways to predict the rotation in an open-loop prediction: name -> (short title, description).
MODES = {
    "attitude": ("attitude as measured", "attitude, rates and rotor signals as measured"),
    "held": ("rates held", "rates held: all 13 states from the start on, body rates constant as measured there"),
    "torque": (
        "fitted torque",
        "fitted torque: all 13 states, its offset tracked up to the start, rates held on axes that are refused",
    ),
    "full": (
        "geometric torque",
        "geometric torque: all 13 states, torque from the vehicle's rotor positions and inertia",
    ),
}
QUANTITIES = {
    "position": ("m", 1.0),
    "velocity": ("m/s", 1.0),
    "attitude": ("deg", 180 / math.pi),
    "rate": ("rad/s", 1.0),
}

Row = Mapping[str, Any]


def mean_of(mode: str) -> str:
    """The mean of a mode's errors over the starts: "RMS", or "median", because a few that tumble dominate an RMS."""
    return "RMS" if mode == "attitude" else "median"


def error_of(row: Row, quantity: str) -> float:
    """The mean error of an open-loop row, in the printed unit."""
    name = quantity if mean_of(row["mode"]) == "RMS" else f"{quantity}_median"
    return QUANTITIES[quantity][1] * row[name]


def validation_lines(report: Mapping[str, Any]) -> list[str]:
    """Notes, one-step residuals, speed bands, open-loop errors."""
    flights, rows = report["flights"], report["rows"]
    how = "each by models refitted to the others" if report["leave_one_out"] else "by the models as they are"
    lines = [*report["notes"], f"{len(flights)} flights, {rows[0]['rows']} samples, {how}", ""]
    lines += one_step_lines(rows)
    base = next((row for row in rows if row["predictor"] == "nominal" and not row["thrust_tracked"]), None)
    if base is not None:
        about = "nominal about its mean (without the accelerometer's constant offsets)"
        lines.append(f"{about}: {base['rms_about_mean']:.3f}")
    if report.get("nominal"):
        lines.append(f"nominal: the thrust curve {report['nominal']}, as fitted beside drag, without the drag")
    lines += [*least_lines(rows), "", *band_lines(report["bands"])]
    for mode, (_, description) in MODES.items():
        found = [row for row in report["rollouts"] if row["mode"] == mode]
        if found:
            lines += ["", *report["torque"]] if mode == "torque" else []
            if mode != "attitude":
                description += "; rotor thrusts as measured, thrust scale tracked up to the start"
            head = f"open loop: {description}; {mean_of(mode)} over {found[0]['starts']} starts"
            lines += ["", head, *rollout_lines(found)]
    return lines


def least_lines(rows: Sequence[Row]) -> list[str]:
    """The best model's share of nominal's residual: as fitted, and with the thrust scale tracked."""
    fitted, tracked = (
        min((row for row in rows if row["thrust_tracked"] == tracked), key=lambda row: row["rms"])
        for tracked in (False, True)
    )
    if "share" not in fitted:
        return []

    def text(row: Row, key: str) -> str:
        return f"{100 * row[key]:.1f} % [{100 * row[key + '_low']:.1f}, {100 * row[key + '_high']:.1f}]"

    return [
        f"least, as fitted: {fitted['predictor']}, {text(fitted, 'share')} of nominal as fitted",
        (
            f"least, thrust scale tracked: {tracked['predictor']}, {text(tracked, 'share_alike')} of nominal"
            f" with its scale tracked too, {text(tracked, 'share')} of nominal as fitted"
        ),
    ]


def one_step_lines(rows: Sequence[Row]) -> list[str]:
    """A line per predictor: axes and vector as fitted, then vector and shares with the thrust scale tracked.

    The shares are of nominal as fitted, and of nominal with its scale tracked too.
    """
    tracked = {row["predictor"]: row for row in rows if row["thrust_tracked"]}
    outside = any(row.get("outside") for row in rows)

    def share(row: Row, key: str = "share") -> str:
        return f"{100 * row[key]:.1f} %" if row.get(key) is not None else ""

    lines = []
    for row in (row for row in rows if not row["thrust_tracked"]):
        other = tracked[row["predictor"]]
        cells = [row["predictor"], *(f"{row[key]:.3f}" for key in ("rms_x", "rms_y", "rms_z", "rms"))]
        for one, keys in ((row, ["share"]), (other, ["share", "share_alike"])):
            cells += [f"{one['rms']:.3f}"] if one is other else []
            cells += [f"[{one['rms_low']:.3f}, {one['rms_high']:.3f}]", *(share(one, key) for key in keys)]
        lines.append([*cells, *([share(row, "outside")] if outside else [])])
    heads = ["", "x", "y", "z", "vector", "interval", "of nominal", "vector", "interval", "of nominal", "of tracked"]
    title = "residual of the specific force, RMS (m/s^2), 95 % interval by block or flight"
    groups = {1: "as fitted", 7: "thrust scale tracked"}
    return Table(heads + ["outside the fit"] * outside, lines, title, groups=groups).lines()


def band_lines(bands: Sequence[Row]) -> list[str]:
    """RMS of the vector by speed, a line per predictor."""
    edges = sorted({(row["low"], row["high"]) for row in bands})
    values = {(row["predictor"], row["low"]): row for row in bands}
    rows = [
        [
            name,
            *(
                f"{one['rms']:.3f} / {one['rms_tracked']:.3f}" if (one := values.get((name, low))) else ""
                for low, _ in edges
            ),
        ]
        for name in dict.fromkeys(row["predictor"] for row in bands)
    ]
    counts = {row["low"]: row["rows"] for row in bands}
    rows.append(["samples", *(str(counts.get(low, 0)) for low, _ in edges)])
    heads = ["", *(f"{low:g} to {high:g}" for low, high in edges)]
    return Table(heads, rows, "by speed (m/s), as fitted / thrust scale tracked").lines()


def rollout_lines(rows: Sequence[Row]) -> list[str]:
    """Errors of one mode at each horizon, a line per predictor (and per thrust scale, tracked or not)."""
    horizons = sorted({row["horizon"] for row in rows})
    quantities = [name for name in QUANTITIES if name in rows[0]]
    keys = list(dict.fromkeys((row["predictor"], row["thrust_tracked"]) for row in rows))
    several = len({tracked for _, tracked in keys}) > 1
    values = {(row["predictor"], row["thrust_tracked"], row["horizon"]): row for row in rows}
    lines = []
    for key in keys:
        cells = [
            f"{error_of(row, name):.3f}" if (row := values.get((*key, h))) else ""
            for name in quantities
            for h in horizons
        ]
        lines.append([key[0] + (", tracked" if key[1] and several else ""), *cells])
    groups = {1 + i * len(horizons): f"{name} ({QUANTITIES[name][0]})" for i, name in enumerate(quantities)}
    return Table(["", *(f"{h:g} s" for _ in quantities for h in horizons)], lines, groups=groups).lines()
