"""The report of `quadexp validate` for people."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

MODES = {
    "attitude": "attitude, rates and rotor signals as measured",
    "held": "rates held: all 13 states from the start on, body rates constant as they were measured there",
    "torque": "fitted torque: all 13 states, its offset followed up to the start, rates held on axes that are refused",
    "full": "geometric torque: all 13 states, turned by the vehicle's arms and inertia",
}


def validation_lines(report: Mapping[str, Any]) -> list[str]:
    """Notes, one-step residuals, speed bands, open-loop errors."""
    flights = report["flights"]
    how = "each by models refitted to the others" if report["leave_one_out"] else "by the models as they are"
    rows = report["rows"]
    lines = [*report["notes"], f"{len(flights)} flights, {rows[0]['rows']} samples, {how}", ""]
    lines += one_step_lines(rows)
    base = next((row for row in rows if row["predictor"] == "nominal" and not row["thrust_tracked"]), None)
    if base is not None:
        lines.append(
            f"nominal about its mean (without the accelerometer's constant offsets): {base['rms_about_mean']:.3f}"
        )
    if report.get("nominal"):
        lines.append(f"nominal: the thrust curve {report['nominal']}, as fitted beside drag, without the drag")
    lines += least_lines(rows)
    lines += ["", *band_lines(report["bands"])]
    for mode, meaning in MODES.items():
        found = [row for row in report["rollouts"] if row["mode"] == mode]
        if found:
            if mode == "torque":
                lines += ["", *report["torque"]]
            mean = "RMS" if mode == "attitude" else "median"  # a few that tumble would be all that an RMS shows
            if mode != "attitude":
                meaning += "; rotor thrusts as measured, thrust scale tracked up to the start"
            starts = found[0]["starts"]
            lines += [
                "",
                f"open loop: {meaning}; {mean} over {starts} starts",
                *rollout_lines(found, median=mode != "attitude"),
            ]
    return lines


def least_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What the best model leaves of nominal's residual: as fitted, and with the thrust scale tracked."""
    best = {
        tracked: min((row for row in rows if row["thrust_tracked"] == tracked), key=lambda row: row["rms"])
        for tracked in (False, True)
    }
    if "share" not in best[False]:
        return []
    return [
        f"least, as fitted: {best[False]['predictor']}, {_percent(best[False], 'share')} of nominal as fitted",
        (
            f"least, thrust scale tracked: {best[True]['predictor']}, {_percent(best[True], 'share_alike')} of nominal"
            f" with its scale tracked too, {_percent(best[True], 'share')} of nominal as fitted"
        ),
    ]


def _percent(row: Mapping[str, Any], key: str) -> str:
    return f"{100 * row[key]:.1f} % [{100 * row[key + '_low']:.1f}, {100 * row[key + '_high']:.1f}]"


def one_step_lines(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line a predictor: axes and vector as fitted, then vector and shares with the thrust scale tracked.

    The shares are of nominal as fitted, and of nominal with its scale tracked too.
    """
    width = max(len(row["predictor"]) for row in rows) + 2
    outside = any(row.get("outside") for row in rows)
    lines = [
        "residual of the specific force, RMS (m/s^2), 95 % interval by block or flight",
        f"{'':<{width}}{'x':>7}{'y':>7}{'z':>7}{'vector':>9}{'interval':>18}{'of nominal':>12}"
        f"   {'thrust scale tracked':<21}{'of nominal':>12}{'of tracked':>12}"
        + ("  outside the fit" if outside else ""),
    ]
    static = [row for row in rows if not row["thrust_tracked"]]
    tracked = {row["predictor"]: row for row in rows if row["thrust_tracked"]}
    for row in static:
        other = tracked[row["predictor"]]
        share = f"{100 * row['share']:.1f} %" if "share" in row else ""
        own, alike = (f"{100 * other[key]:.1f} %" if key in other else "" for key in ("share", "share_alike"))
        text = (
            f"{row['predictor']:<{width}}{row['rms_x']:7.3f}{row['rms_y']:7.3f}{row['rms_z']:7.3f}{row['rms']:9.3f}"
            f"{'[' + format(row['rms_low'], '.3f') + ', ' + format(row['rms_high'], '.3f') + ']':>18}{share:>12}"
            f"   {other['rms']:.3f} [{other['rms_low']:.3f}, {other['rms_high']:.3f}]"
            f"{own:>12}{alike:>12}"
        )
        if outside and row.get("outside") is not None:
            text += f"{100 * row['outside']:10.1f} %"
        lines.append(text)
    return lines


def band_lines(bands: Sequence[Mapping[str, Any]]) -> list[str]:
    """RMS of the vector by speed, a line a predictor."""
    edges = sorted({(row["low"], row["high"]) for row in bands})
    names = list(dict.fromkeys(row["predictor"] for row in bands))
    width = max(len(name) for name in names) + 2
    values = {(row["predictor"], row["low"]): row for row in bands}
    counts = {row["low"]: row["rows"] for row in bands}
    lines = ["by speed (m/s), as fitted / thrust scale tracked"]
    lines.append(f"{'':<{width}}" + "".join(f"{f'{low:g} to {high:g}':>16}" for low, high in edges))
    for name in names:
        cells = [values.get((name, low)) for low, _ in edges]
        texts = [f"{cell['rms']:.3f} / {cell['rms_tracked']:.3f}" if cell else "" for cell in cells]
        lines.append(f"{name:<{width}}" + "".join(f"{text:>16}" for text in texts))
    lines.append(f"{'samples':<{width}}" + "".join(f"{counts.get(low, 0):>16}" for low, _ in edges))
    return lines


def rollout_lines(rows: Sequence[Mapping[str, Any]], *, median: bool = False) -> list[str]:
    """Errors at each horizon, a line a predictor (and whether its thrust scale was tracked)."""
    horizons = sorted({row["horizon"] for row in rows})
    quantities = [
        (name, unit, scale)
        for name, unit, scale in (
            ("position", "m", 1),
            ("velocity", "m/s", 1),
            ("attitude", "deg", 57.29578),
            ("rate", "rad/s", 1),
        )
        if name in rows[0]
    ]
    keys = list(dict.fromkeys((row["predictor"], row["thrust_tracked"]) for row in rows))
    several = len({tracked for _, tracked in keys}) > 1
    labels = {key: key[0] + (", tracked" if key[1] and several else "") for key in keys}
    width = max(map(len, labels.values())) + 2
    head = "".join(f"{f'{name} ({unit})':<{9 * len(horizons)}}" for name, unit, _ in quantities)
    lines = [f"{'':<{width}}{head}".rstrip()]
    lines.append(f"{'':<{width}}" + "".join(f"{f'{h:g} s':<9}" for _ in quantities for h in horizons))
    values = {(row["predictor"], row["thrust_tracked"], row["horizon"]): row for row in rows}
    for key in keys:
        cells = [
            f"{scale * values[(*key, h)][name + '_median' * median]:<9.3f}" if (*key, h) in values else f"{'':<9}"
            for name, _, scale in quantities
            for h in horizons
        ]
        lines.append(f"{labels[key]:<{width}}" + "".join(cells).rstrip())
    return lines
