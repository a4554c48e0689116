"""Text of `quadexp identify` on a vehicle model: coefficients with their intervals, and the models compared."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from quadexp.models.regression import FLIGHT_CLUSTERS
from quadexp.models.terms import TermModel
from quadexp.models.torque import torque_lines
from quadexp.models.vehicle_model import VehicleModel
from quadexp.report.table import Table

NORMS = ("x", "y", "z", "norm")


def identification_lines(model: VehicleModel, report: Mapping[str, Any]) -> list[str]:
    """The result of an identification. report: as in the checkpoint folder."""
    data, vehicle = model.dataset, model.vehicle
    of = f"regression on {data['flights']} flights of {vehicle.get('name') or 'an unnamed vehicle'}"
    lines = [f"{of}, {data['rows']} samples, {data['duration']:.0f} s", *model_lines(model)]
    if report.get("beside_quadratic"):
        lines.append(
            "thrust      its interval holds where drag along z is linear in v_z; beside quadratic drag it is"
            f" {report['beside_quadratic']}"
        )
    other = {(row["axis"], row["term"]): row["value"] for row in report["other_loss"]["rows"]}
    drag = ", ".join(f"d_{axis} {other[axis, 'linear']:.4f}" for axis in "xyz")
    lines.append(f"by {report['other_loss']['loss']:<9}linear {drag} 1/s")
    lines += _flight_lines(report["flights"])
    lines += _curve_lines(report["curves"], model)
    lines += selection_lines(report["selection"], report.get("best_row", report["best"]))
    lines += [f"note        {note}" for note in report["notes"]]
    return lines


def main_lines(model: VehicleModel, report: Mapping[str, Any]) -> list[str]:
    """What matters first, in four lines: data, thrust, drag, the best model; and the notes."""
    terms = {row["axis"]: row for row in model.linear.records() if row["term"] == "linear"}
    drag = ", ".join(f"d_{axis} {r['value']:.4g} +- {r['high'] - r['value']:.2g}" for axis, r in terms.items())
    lines = [identification_lines(model, report)[0], f"thrust      {model.thrust}", f"drag        {drag} 1/s"]
    for row in report["selection"]:
        if row["level"] == report.get("best_row", report["best"]):
            score, where = (
                (row["held_out"], "on flights left out") if row["held_out"] else (row["in_sample"], "in sample")
            )
            error = f": RMSE {score['norm']:.3f} m/s^2 {where}" if score else ""
            lines.append(f"best        {row['name'].strip('+ ')}{error}")
    return lines + [f"note        {note}" for note in report["notes"]]


def model_lines(model: VehicleModel) -> list[str]:
    """Thrust curve and coefficients, +- half the 95 % interval."""
    lines = [f"intervals   +- is half the 95 % interval {interval_of(model.dataset.get('flights', 0))}"]
    lines.append(f"thrust      {model.thrust}")
    for kind, one in model.models.items():
        lines += _coefficient_lines(kind, one)
    return lines + (torque_lines(model.torque) if model.torque is not None else [])


def interval_of(flights: int) -> str:
    """The scope of the intervals of a fit to so many flights (quadexp.models.regression)."""
    if flights >= FLIGHT_CLUSTERS:
        return f"over {flights} flights"
    return (
        "of these flights only, from blocks of time: what differs from flight to flight is not in it"
        f" ({FLIGHT_CLUSTERS} flights or more show that)"
    )


def _coefficient_lines(kind: str, model: TermModel) -> list[str]:
    lines = []
    for axis in "xyz":
        terms = [row for row in model.records() if row["axis"] == axis]
        text = ", ".join(f"{r['term']} {r['value']:.4g} +- {r['high'] - r['value']:.2g} {r['unit']}" for r in terms)
        lines.append(f"{kind.replace('_', ' ') if axis == 'x' else '':<14}{axis}: {text}")
    return lines


def _flight_lines(flights: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = ["each flight alone"] if len(flights) > 1 else []
    for one in flights if lines else ():
        drag = [row for row in one.get("coefficients", ()) if row["term"] == "linear"]
        text = ", ".join(f"d_{r['axis']} {r['value']:.4f} +- {r['high'] - r['value']:.2g}" for r in drag)
        lines.append(f"  {one['flight']}: {one.get('note') or f'{text} 1/s'}")
    return lines


def _curve_lines(curves: Sequence[Mapping[str, Any]], model: VehicleModel) -> list[str]:
    if not curves:
        return []
    curve = model.thrust
    used = "unused" if not curve.reference_voltage else "V" if curve.voltage_exponent == 1 else "V^g"
    signals = {"unused": "command", "V": "command V/V_ref", "V^g": "command (V/V_ref)^g"}
    parts = {"in_sample": "in sample", "held_out": "left out"}
    parts |= {"halves_out": "half left out"} if any(row.get("halves_out") is not None for row in curves) else {}
    lines = []
    for row in curves:
        name = " + ".join(f"c_{p} s^{p}" if p > 1 else "c_1 s" for p in row["powers"])
        chosen = row["voltage"] == used and tuple(row["powers"]) == tuple(curve.powers.astype(int).tolist())
        cells = ["-" if row[part] is None else f"{row[part]:.3f}" for part in parts]
        lines.append([f"  {name}, s = {signals[row['voltage']]}", *cells, "<- used" if chosen else ""])
    halves = ", and on half a flight left out" if "halves_out" in parts else ""
    title = f"thrust curves: RMSE along z (m/s^2), in sample, on flights left out{halves}"
    return Table(["", *parts.values(), ""], lines, title, left=frozenset({0, len(parts) + 1})).lines()


def selection_lines(rows: Sequence[Mapping[str, Any]], best: str) -> list[str]:
    """The models from nominal to blade element as a table."""
    held = any(row["held_out"] for row in rows)
    lines = []
    for row in rows:
        cells = [f"{row['in_sample'][key]:.3f}" if row["in_sample"] else "" for key in NORMS]
        if held:
            cells += [f"{row['held_out'][key]:.3f}" if row["held_out"] else "" for key in NORMS]
            cells.append(f"{row['trimmed']['norm']:.3f}" if row["held_out"] else "")
        note = "<- best" if row["level"] == best else ""
        if not row["in_sample"] or (held and not row["held_out"]):
            note = f"{'' if row['in_sample'] else 'not fitted: '}{row['note']} {note}".strip()
        lines.append([row["name"], *cells, note])
    heads = ["RMSE (m/s^2)", *NORMS, *([*NORMS, "trimmed"] if held else []), ""]
    left, groups = frozenset({0, len(heads) - 1}), {1: "in sample", **({5: "left out"} if held else {})}
    note = "  (nominal: a curve fitted without drag beside it; `validate` takes the curve fitted beside drag)"
    return Table(heads, lines, left=left, groups=groups, notes=[note]).lines()
