"""Text of `quadexp identify` on a vehicle model, and of `quadexp validate`: coefficients, errors, models compared.

model: a VehicleModel (vehicle_model.py).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from quadexp.models.regression import LEAST_FLIGHTS
from quadexp.plugins.aerodynamics.blocks import FLIGHT_CLUSTERS
from quadexp.plugins.aerodynamics.drag_choice import drag_line
from quadexp.plugins.identification.vehicle_numbers import number_lines
from quadexp.report.table import Table

Row = Mapping[str, Any]
NORMS = ("x", "y", "z", "norm")
# Ways to predict the rotation in an open-loop prediction: name -> (short title, description).
MODES = {
    "attitude": ("attitude as measured", "attitude, rates and rotor signals as measured"),
    "held": ("rates held", "rates held: all 13 states from the start on, body rates constant as measured there"),
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


def identification_lines(model: Any, report: Row) -> list[str]:
    """The result of an identification. report: as in the checkpoint folder."""
    lines = [_data_line(model), *model_lines(model), *_numbers(model, report), drag_line(report["air"])]
    if len(report["flights"]) > 1:
        lines.append("each flight alone")
        for flight in report["flights"]:
            text = flight.get("note") or f"{_linear_drag(flight.get('coefficients', ()), '.4f')} 1/s"
            lines.append(f"  {flight['flight']}: {text}")
    lines += _curve_lines(report["curves"], model)
    lines += selection_lines(report["selection"], report.get("best_row", report["best"]))
    return lines + [f"note        {note}" for note in report["notes"]]


def main_lines(model: Any, report: Row) -> list[str]:
    """What matters first, in four lines: data, thrust, drag, the best model; and the notes."""
    drag = _linear_drag(model.linear.records(), ".4g")
    lines = [_data_line(model), f"thrust      {model.thrust}", f"drag        {drag} 1/s"]
    level = report.get("best_row", report["best"])
    for row in (row for row in report["selection"] if row["level"] == level):
        score = row["held_out"] or row["in_sample"]
        where = "on flights left out" if row["held_out"] else "in sample"
        error = f": RMSE {score['norm']:.3f} m/s^2 {where}" if score else ""
        lines.append(f"best        {row['name'].strip('+ ')}{error}")
    lines += _numbers(model, report)
    return lines + [f"note        {note}" for note in report["notes"]]


def _numbers(model: Any, report: Row) -> list[str]:
    """Numbers that a person uses, and the torque."""
    lines = number_lines(report["numbers"], model.linear.records())
    if model.torque is None:
        return lines
    return [f"torque      {model.torque}", *lines]


def _data_line(model: Any) -> str:
    data = model.dataset
    name = model.vehicle.get("name") or "an unnamed vehicle"
    return f"regression on {data['flights']} flights of {name}, {data['rows']} samples, {data['duration']:.0f} s"


def _linear_drag(rows: Sequence[Row], form: str) -> str:
    """The linear coefficients of an axis each, +- half their interval."""
    linear = [row for row in rows if row["term"] == "linear"]
    return ", ".join(f"d_{r['axis']} {r['value']:{form}} +- {r['high'] - r['value']:.2g}" for r in linear)


def model_lines(model: Any) -> list[str]:
    """Thrust curve and coefficients, +- half the 95 % interval, and its scope (quadexp.models.regression)."""
    flights = model.dataset.get("flights", 0)
    scope = _scope(flights, FLIGHT_CLUSTERS)
    lines = [f"intervals   +- is half the 95 % interval {scope}", f"thrust      {model.thrust}"]
    for kind, terms in model.models.items():
        for axis in "xyz":
            rows = [row for row in terms.records() if row["axis"] == axis]
            text = ", ".join(f"{r['term']} {r['value']:.4g} +- {r['high'] - r['value']:.2g} {r['unit']}" for r in rows)
            name = kind.replace("_", " ") if axis == "x" else ""
            lines.append(f"{name:<14}{axis}: {text}")
    return lines


def _scope(flights: int, least: int) -> str:
    """What an interval is of."""
    if flights >= least:
        return f"over {flights} flights"
    only = "of these flights only, from blocks of time: differences between flights are not in it"
    return f"{only} ({least} flights or more show them)"


def _curve_lines(curves: Sequence[Row], model: Any) -> list[str]:
    """The thrust curves that were compared, and which one is used."""
    if not curves:
        return []
    curve = model.thrust
    used = "unused"
    if curve.reference_voltage:
        used = "V" if curve.voltage_exponent == 1 else "V^g"
    signals = {"unused": "command", "V": "command V/V_ref", "V^g": "command (V/V_ref)^g"}
    title = "thrust curves: RMSE along z (m/s^2), in sample, on flights left out"
    parts = {"in_sample": "in sample", "held_out": "left out"}
    if any(row.get("halves_out") is not None for row in curves):
        title += ", and on half a flight left out"
        parts["halves_out"] = "half left out"
    rows = []
    for row in curves:
        terms = " + ".join("c_1 s" if power == 1 else f"c_{power} s^{power}" for power in row["powers"])
        errors = ["-" if row[part] is None else f"{row[part]:.3f}" for part in parts]
        chosen = row["voltage"] == used and list(row["powers"]) == curve.powers.astype(int).tolist()
        rows.append([f"  {terms}, s = {signals[row['voltage']]}", *errors, "<- used" if chosen else ""])
    return Table(["", *parts.values(), ""], rows, title, left=frozenset({0, len(parts) + 1})).lines()


def selection_lines(rows: Sequence[Row], best: str) -> list[str]:
    """The models from nominal to blade element as a table."""
    groups = {1: "in sample"}
    parts = ["in_sample"]
    if any(row["held_out"] for row in rows):
        groups[1 + len(NORMS)] = "left out"
        parts.append("held_out")
    lines = []
    for row in rows:
        cells = [f"{row[part][key]:.3f}" if row[part] else "" for part in parts for key in NORMS]
        notes = []
        if not row["in_sample"]:
            notes.append("not fitted:")
        notes.append(row["note"])
        if row["level"] == best:
            notes.append("<- best")
        lines.append([row["name"], *cells, " ".join(filter(None, notes))])
    heads = ["RMSE (m/s^2)", *NORMS * len(parts), ""]
    note = (
        "  (nominal: a curve fitted without drag beside it; `validate` takes the curve fitted beside drag."
        " best: of the air alone, see `air`, as `quadexp fit` compares)"
    )
    return Table(heads, lines, left=frozenset({0, len(heads) - 1}), groups=groups, notes=[note]).lines()


def mean_of(mode: str) -> str:
    """The mean of a mode's errors over the starts: "RMS", or "median", because a few that tumble dominate an RMS."""
    return "RMS" if mode == "attitude" else "median"


def error_of(row: Row, quantity: str) -> float:
    """The mean error of an open-loop row, in the printed unit."""
    name = quantity if mean_of(row["mode"]) == "RMS" else f"{quantity}_median"
    return QUANTITIES[quantity][1] * row[name]


def validation_lines(report: Row) -> list[str]:
    """Notes, one-step residuals, speed bands, open-loop errors."""
    flights = report["flights"]
    rows = report["rows"]
    how = "each by models refitted to the others" if report["leave_one_out"] else "by the models as they are"
    lines = [*report["notes"], f"{len(flights)} flights, {rows[0]['rows']} samples, {how}", ""]
    lines += _one_step_lines(rows, len(flights))
    if report.get("nominal"):
        lines.append(f"nominal: the thrust curve {report['nominal']}, as fitted beside drag, without the drag")
    lines += [*_least_lines(rows), "", *_band_lines(report["bands"])]
    for mode, (_, description) in MODES.items():
        rollouts = [row for row in report["rollouts"] if row["mode"] == mode]
        if rollouts:
            if mode != "attitude":
                description += "; rotor thrusts as measured, thrust scale tracked up to the start"
            head = f"open loop: {description}; {mean_of(mode)} over {rollouts[0]['starts']} starts"
            lines += ["", head, *rollout_lines(rollouts)]
    return [*lines, "", *_torque_lines(report["torque"])]


def _torque_lines(torque: Row) -> list[str]:
    """Attitude by the replay model of the torque, beside rates held and blind to the motors."""
    from quadexp.plugins.identification.torque import DOES_NOT_SHOW, replay_lines

    if "note" in torque:
        return [torque["note"]]
    lines = replay_lines(torque["rollouts"])
    if not torque["shown"]:
        lines.append(f"{DOES_NOT_SHOW}: the replay model is no better than blind")
    return lines


def _least_lines(rows: Sequence[Row]) -> list[str]:
    """The best model's share of nominal's residual: as fitted, and with the thrust scale tracked."""

    def least(rows: Sequence[Row]) -> Row:
        return min(rows, key=lambda row: row["rms"])

    def text(row: Row, key: str) -> str:
        return f"{_percent(row, key)} [{100 * row[key + '_low']:.1f}, {100 * row[key + '_high']:.1f}] of nominal"

    fitted = least(rows[::2])
    tracked = least(rows[1::2])
    if "share" not in fitted:
        return []
    alike = text(tracked, "share_alike")
    share = text(tracked, "share")
    return [
        f"least, as fitted: {fitted['predictor']}, {text(fitted, 'share')} as fitted",
        f"least, thrust scale tracked: {tracked['predictor']}, {alike} with its scale tracked too, {share} as fitted",
    ]


def _percent(row: Row, key: str) -> str:
    return f"{100 * row[key]:.1f} %" if row.get(key) is not None else ""


def _one_step_lines(rows: Sequence[Row], flights: int) -> list[str]:
    """A line per predictor: axes and vector as fitted, then vector and shares with the thrust scale tracked.

    The shares are of nominal as fitted, and of nominal with its scale tracked too.
    """
    outside = any(row.get("outside") for row in rows)

    def vector(row: Row) -> list[str]:
        return [f"{row['rms']:.3f}", f"[{row['rms_low']:.3f}, {row['rms_high']:.3f}]", _percent(row, "share")]

    lines = []
    for fitted, tracked in zip(rows[::2], rows[1::2], strict=True):  # of a predictor each
        cells = [fitted["predictor"], *(f"{fitted[key]:.3f}" for key in ("rms_x", "rms_y", "rms_z"))]
        cells += [*vector(fitted), *vector(tracked), _percent(tracked, "share_alike")]
        lines.append([*cells, *[_percent(fitted, "outside")] * outside])
    heads = ["", "x", "y", "z", "vector", "interval", "of nominal", "vector", "interval", "of nominal", "of tracked"]
    title = f"residual of the specific force, RMS (m/s^2); 95 % interval {_scope(flights, LEAST_FLIGHTS)}"
    groups = {1: "as fitted", 7: "thrust scale tracked"}
    return Table(heads + ["outside the fit"] * outside, lines, title, groups=groups).lines()


def _band_lines(bands: Sequence[Row]) -> list[str]:
    """RMS of the vector by speed, a line per predictor."""
    edges = sorted({(row["low"], row["high"]) for row in bands})
    texts = {(row["predictor"], row["low"]): f"{row['rms']:.3f} / {row['rms_tracked']:.3f}" for row in bands}
    names = dict.fromkeys(row["predictor"] for row in bands)
    rows = [[name, *(texts.get((name, low), "") for low, _ in edges)] for name in names]
    counts = {row["low"]: row["rows"] for row in bands}
    rows.append(["samples", *(str(counts.get(low, 0)) for low, _ in edges)])
    heads = ["", *(f"{low:g} to {high:g}" for low, high in edges)]
    return Table(heads, rows, "by speed (m/s), as fitted / thrust scale tracked").lines()


def rollout_lines(rows: Sequence[Row]) -> list[str]:
    """Errors of one mode at each horizon, a line per predictor (and per thrust scale, tracked or not)."""
    horizons = sorted({row["horizon"] for row in rows})
    quantities = [name for name in QUANTITIES if name in rows[0]]
    several = len({row["thrust_tracked"] for row in rows}) > 1
    by_line: dict[str, dict[float, Row]] = {}
    for row in rows:
        name = row["predictor"] + ", tracked" * (row["thrust_tracked"] and several)
        by_line.setdefault(name, {})[row["horizon"]] = row
    lines = []
    for name, at in by_line.items():
        cells = []
        for quantity in quantities:
            cells += [f"{error_of(at[horizon], quantity):.3f}" if horizon in at else "" for horizon in horizons]
        lines.append([name, *cells])
    groups = {1 + i * len(horizons): f"{name} ({QUANTITIES[name][0]})" for i, name in enumerate(quantities)}
    return Table(["", *[f"{horizon:g} s" for horizon in horizons] * len(quantities)], lines, groups=groups).lines()
