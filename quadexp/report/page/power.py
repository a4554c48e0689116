"""Battery and rotors over time, of flights in a world."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from quadexp.log.schema import Flight, describe
from quadexp.report.page.palette import Palette, dress
from quadexp.report.page.replay import Case, by_rank, case_of, case_title, ordered_cases
from quadexp.report.page.sheet import Draw, Sheet, sheet_name
from quadexp.report.page.source import Comparison, spoken
from quadexp.report.style import Look
from quadexp.report.text import percent

MAX_GROUPS = 6  # worlds with panels
MAX_FLIGHTS = 4  # of one panel
BINS = 200  # of time


def rotor_columns(flight: Flight) -> list[str]:
    """Speeds of the rotors, or what they deliver where no speed is known."""
    for name in ("rotor_speed", "delivered"):
        if found := [column for column in flight.columns if column.startswith(f"{name}_")]:
            return found
    return []


def power_sheets(comparison: Comparison) -> tuple[list[Sheet], int]:
    """The first case of every world but the clean one, if it has a battery or rotors; and how many more there are."""
    first: dict[tuple[str, str], Case] = {}
    for case in ordered_cases(comparison):
        plant, vehicle = case[0][:2]
        if "/" in plant:  # such as simplified/race
            first.setdefault((plant, vehicle), case)
    rows: dict[Case, list[Mapping[str, Any]]] = {case: [] for case in first.values()}
    for row in comparison.rows:
        if case_of(row) in rows:
            rows[case_of(row)].append(row)
    made = []
    for case, own in rows.items():
        flown = [(comparison.label(row), comparison.flight(row)) for row in by_rank(comparison, own)[:MAX_FLIGHTS]]
        flights = [(label, f) for label, f in flown if f and ("battery_voltage" in f.columns or rotor_columns(f))]
        made += [_sheet(comparison, case_title(comparison, case), flights)] if flights else []
    return made[:MAX_GROUPS], max(0, len(made) - MAX_GROUPS)


def _sheet(comparison: Comparison, title: str, flights: list[tuple[str, Flight]]) -> Sheet:
    draws: dict[str, Draw] = {}
    if any("battery_voltage" in flight.columns for _, flight in flights):
        draws[f"Battery voltage, {title}"] = partial(battery_panel, flights=flights, look=comparison.look)
    if any(rotor_columns(flight) for _, flight in flights):
        draws[f"Rotors, {title}"] = partial(rotor_panel, flights=flights, look=comparison.look)
    ends = [f"{spoken(label)} {share}" for label, flight in flights if (share := end_of_charge(flight))]
    text = f"Charge left at the end: {', '.join(ends)}." if ends else ""
    return Sheet(sheet_name("power", title), title, draws, [label for label, _ in flights], text)


def binned(t: np.ndarray, values: np.ndarray, bins: int = BINS) -> np.ndarray:
    """Mean time (s), smallest, mean and largest of values (k, n), in bins of neighbouring samples; (4, bins)."""
    parts = np.array_split(np.arange(len(t)), min(bins, len(t)))
    return np.array([(t[i].mean(), values[i].min(), values[i].mean(), values[i].max()) for i in parts]).T


def battery_panel(
    panel: Any, flights: Sequence[tuple[str, Flight]], look: Mapping[str, Look], palette: Palette
) -> None:
    """Voltage over time, a line per flight (label, flight)."""
    for label, flight in flights:
        if "battery_voltage" in flight.columns:
            at, _, mean, _ = binned(flight.t, flight.stack(["battery_voltage"]))
            panel.plot(at, mean, linewidth=1.2, color=palette.series[look[label].token], linestyle=look[label].dash)
    _label(panel, "Battery voltage", "V", palette)


def rotor_panel(panel: Any, flights: Sequence[tuple[str, Flight]], look: Mapping[str, Look], palette: Palette) -> None:
    """Mean of the rotors over time, a line per flight, with a band from the slowest to the fastest."""
    title, unit = "", ""
    for label, flight in flights:
        if names := rotor_columns(flight):
            at, low, mean, high = binned(flight.t, flight.stack(names))
            colour = palette.series[look[label].token]
            panel.fill_between(at, low, high, color=colour, alpha=0.18, linewidth=0)
            panel.plot(at, mean, linewidth=1.2, color=colour, linestyle=look[label].dash)
            title = "Rotor speed" if names[0].startswith("rotor_speed") else "Thrust that the rotors deliver"
            unit = describe(names[0]).unit
    _label(panel, title, unit, palette)


def _label(panel: Any, title: str, unit: str, palette: Palette) -> None:
    panel.set_title(title, fontweight="normal", color=palette.ink)
    panel.set_xlabel("time (s)")
    panel.set_ylabel(unit)
    dress(panel, palette)


def end_of_charge(flight: Flight) -> str:
    """The charge that a flight left in the battery, such as "62 %"; "" without a battery."""
    left = float(flight["state_of_charge"][-1]) if "state_of_charge" in flight.columns else math.nan
    return percent(100 * left)[0] if math.isfinite(left) else ""
