"""What `quadexp identify` prints of a vehicle model: coefficients with their intervals, and the ladder of models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from quadexp.learn.regression import FLIGHT_CLUSTERS
from quadexp.learn.terms import TermModel
from quadexp.learn.torque import torque_lines
from quadexp.learn.vehicle_model import VehicleModel


def identification_lines(model: VehicleModel, report: Mapping[str, Any]) -> list[str]:
    """What was found, for people; report: as in the checkpoint folder."""
    data, vehicle = model.dataset, model.vehicle
    lines = [
        (
            f"regression on {data['flights']} flights of {vehicle.get('name') or 'an unnamed vehicle'},"
            f" {data['rows']} samples, {data['duration']:.0f} s"
        ),
    ]
    lines += model_lines(model)
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


def model_lines(model: VehicleModel) -> list[str]:
    """Thrust curve and coefficients, +- half the 95 % interval."""
    lines = [f"intervals   +- is half the 95 % interval {interval_of(model.dataset.get('flights', 0))}"]
    lines.append(f"thrust      {model.thrust}")
    for kind, one in model.models.items():
        lines += _coefficient_lines(kind, one)
    if model.torque is not None:
        lines += torque_lines(model.torque)
    return lines


def interval_of(flights: int) -> str:
    """What the intervals of a fit to so many flights cover (quadexp.learn.regression)."""
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
        head = kind.replace("_", " ") if axis == "x" else ""
        lines.append(f"{head:<14}{axis}: {text}")
    return lines


def _flight_lines(flights: Sequence[Mapping[str, Any]]) -> list[str]:
    if len(flights) < 2:
        return []
    lines = ["each flight alone"]
    for one in flights:
        if "note" in one:
            lines.append(f"  {one['flight']}: {one['note']}")
            continue
        drag = [row for row in one["coefficients"] if row["term"] == "linear"]
        text = ", ".join(f"d_{r['axis']} {r['value']:.4f} +- {r['high'] - r['value']:.2g}" for r in drag)
        lines.append(f"  {one['flight']}: {text} 1/s")
    return lines


def _curve_lines(curves: Sequence[Mapping[str, Any]], model: VehicleModel) -> list[str]:
    if not curves:
        return []
    halves = any(row.get("halves_out") is not None for row in curves)
    with_halves = ", and on half a flight left out" if halves else ""
    lines = [f"thrust curves: RMSE along z (m/s^2), in sample, on flights left out{with_halves}"]
    for row in curves:
        names = " + ".join(f"c_{p} s^{p}" if p > 1 else "c_1 s" for p in row["powers"])
        voltage = {"unused": ", s = command", "V": ", s = command V/V_ref", "V^g": ", s = command (V/V_ref)^g"}[
            row["voltage"]
        ]
        used = tuple(row["powers"]) == tuple(model.thrust.powers.astype(int).tolist())
        used &= row["voltage"] == (("V" if model.thrust.voltage_exponent == 1 else "V^g")
                                   if model.thrust.reference_voltage else "unused")  # fmt: skip
        cells = " ".join(
            "      -" if value is None else f"{value:7.3f}"
            for value in (row["in_sample"], row["held_out"], *([row["halves_out"]] if halves else []))
        )
        lines.append(f"  {names + voltage:<46}{cells}{'  <- used' if used else ''}")
    return lines


def selection_lines(rows: Sequence[Mapping[str, Any]], best: str) -> list[str]:
    """The ladder as a table."""
    held = any(row["held_out"] for row in rows)
    head = f"{'RMSE (m/s^2)':<24}{'in sample x':>12}{'y':>8}{'z':>8}{'norm':>8}"
    if held:
        head += f"{'left out x':>13}{'y':>8}{'z':>8}{'norm':>8}{'trimmed':>9}"
    lines = [head]
    for row in rows:
        if row["in_sample"] is None:
            lines.append(f"{row['name']:<24} not fitted: {row['note']}")
            continue
        text = f"{row['name']:<24}" + _cells(row["in_sample"], 12)
        if row["held_out"]:
            text += _cells(row["held_out"], 13) + f"{row['trimmed']['norm']:>9.3f}"
        elif held:
            text += f"   {row['note']}"
        lines.append(text + ("  <- best" if row["level"] == best else ""))
    return [*lines, "  (nominal: a curve fitted without drag beside it; `validate` takes the curve fitted beside drag)"]


def _cells(values: Mapping[str, float], first: int) -> str:
    return "".join(f"{values[key]:>{first if key == 'x' else 8}.3f}" for key in ("x", "y", "z", "norm"))
