"""Panels over time: battery and rotors of flights in a world, and coefficients identified in flight."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from quadexp.log.outcome import UNFLOWN
from quadexp.log.schema import ESTIMATE_COLUMNS, Flight, describe
from quadexp.report.page.replay import by_rank, case_of, case_title, ordered_cases
from quadexp.report.page.sheet import INK, Sheet, sheet_name
from quadexp.report.page.source import Comparison
from quadexp.report.style import Look
from quadexp.report.text import number, percent

MAX_GROUPS = 6  # worlds with panels on the page
MAX_FLIGHTS = 4  # of one panel
BINS = 200  # of time
COEFFICIENTS = [name for name in ESTIMATE_COLUMNS if name.startswith("C_")]
TRUTH = {"C_d0": ("profile_drag", None), "C_la": ("lift_slope", None)} | {
    f"C_D{axis}": ("body_drag", i) for i, axis in enumerate("xyz")
}
SHOWN = (
    ("battery_voltage", "Battery voltage"),
    ("rotor_speed", "Rotor speed"),
    ("delivered", "Rotor thrust delivered"),
)

Named = Sequence[tuple[str, Flight]]  # label -> flight


def columns_of(flight: Flight, name: str) -> list[str]:
    """The columns of a quantity: itself, or one a rotor."""
    return [column for column in flight.columns if column == name or column.startswith(f"{name}_")]


def power_sheets(comparison: Comparison) -> list[Sheet]:
    """The first case of every world but the clean one, if it has a battery or rotors."""
    first: dict[tuple[str, str], Any] = {}
    for case in ordered_cases(comparison):
        plant, vehicle = case[0][:2]
        if "/" in plant:  # such as simplified/race
            first.setdefault((plant, vehicle), case)
    sheets = []
    for case in first.values():
        rows = by_rank(comparison, [row for row in comparison.rows if case_of(row) == case])[:MAX_FLIGHTS]
        flights = [(comparison.label(row), flight) for row in rows if (flight := comparison.flight(row))]
        title = case_title(comparison, case)
        there = [what for what in SHOWN if any(columns_of(flight, what[0]) for _, flight in flights)]
        if there:
            draws = {
                f"{words}, {title}": partial(panel_over_time, name=name, flights=flights, look=comparison.look)
                for name, words in there[:2]  # what the rotors deliver only where their speed is not known
            }
            ends = [f"{label} {share}" for label, flight in flights if (share := end_of_charge(flight))]
            text = f"Charge left at the end: {', '.join(ends)}." if ends else ""
            sheets.append(Sheet(sheet_name("power", title), title, draws, [label for label, _ in flights], text))
    return sheets


def estimate_sheets(comparison: Comparison) -> list[Sheet]:
    """Of each trajectory and plant the flights that identified coefficients: fastest speed, one per contestant."""
    fastest: dict[tuple[str, str], dict[str, Mapping[str, Any]]] = {}
    for row in sorted(comparison.rows, key=lambda row: -(row["speed"] or 0.0)):
        identifies = "rls" in row["controller"] or row["controller"].startswith("literal")
        if identifies and row["outcome"] not in UNFLOWN:
            fastest.setdefault((row["plant"], row["trajectory"]), {}).setdefault(comparison.label(row), row)
    sheets = []
    for (plant, trajectory), rows in fastest.items():
        flights = [(label, f) for label, row in rows.items() if (f := comparison.flight(row)) and identified(f)]
        if not flights:
            continue
        (label, first), place = flights[0], f"{trajectory} on {plant}"
        names = identified(first)
        draws = {
            f"{name} identified over time": partial(
                panel_over_time, name=name, flights=flights, look=comparison.look, true=truth(first, name)
            )
            for name in names
        }
        ends = {name: (float(first[name][-1]), truth(first, name)) for name in names}
        texts = [f"{n} {number(end)} of {number(true)}" for n, (end, true) in ends.items() if math.isfinite(end * true)]
        text = f"Dashed: the plant's own value. At the end, {label}: {', '.join(texts)}." if texts else ""
        labels = [label for label, _ in flights]
        title = f"Coefficients identified in flight, {place}"
        sheets.append(Sheet(sheet_name("coefficients", place), title, draws, labels, text))
    return sheets


def identified(flight: Flight) -> list[str]:
    """Coefficients that a flight's controller identified: those that change."""
    return [name for name in COEFFICIENTS if name in flight.columns and np.ptp(flight[name]) > 0]


def truth(flight: Flight, name: str) -> float:
    """True value of a coefficient; NaN if the flight's plant has no constant one."""
    plant = flight.metadata.get("config", {}).get("plant", {})
    key, index = TRUTH[name]
    if (value := plant.get(key)) is None or plant.get("schedule"):
        return math.nan
    return float(value if index is None else value[index])


def binned(t: np.ndarray, values: np.ndarray, bins: int = BINS) -> np.ndarray:
    """Mean time (s), smallest, mean and largest of values (k, n), in bins of neighbouring samples; (4, bins)."""
    parts = np.array_split(np.arange(len(t)), min(bins, len(t)))
    return np.array([(t[i].mean(), values[i].min(), values[i].mean(), values[i].max()) for i in parts]).T


def panel_over_time(panel: Any, name: str, flights: Named, look: Mapping[str, Look], true: float = math.nan) -> None:
    """A quantity over time, a line a flight; of several rotors the mean, with a band from the lowest to the highest.
    true: a value that is marked. What a filter does at its start takes no part in the limits."""
    shown = [np.array([true])]
    for label, flight in flights:
        if columns := columns_of(flight, name):
            at, low, mean, high = binned(flight.t, flight.stack(columns))
            if len(columns) > 1:
                panel.fill_between(at, low, high, color=look[label].colour, alpha=0.18, linewidth=0)
            panel.plot(at, mean, linewidth=1.2, **look[label].line())
            shown += [values[len(at) // 20 :] for values in (low, high)]
            column = describe(columns[0], "estimates" if name in COEFFICIENTS else "flight")
    if math.isfinite(true):
        panel.axhline(true, color=INK, linestyle=(0, (4, 3)), linewidth=1.1)
    lowest, highest = np.nanquantile(np.concatenate(shown), [0.005, 0.995])
    margin = 0.15 * (highest - lowest) or 0.1 * abs(highest) or 1.0
    if math.isfinite(margin):
        panel.set_ylim(lowest - margin, highest + margin)
    panel.set_title(dict(SHOWN).get(name) or f"{name}  {column.description.removesuffix(', in use')}")
    panel.set_xlabel("time (s)")
    panel.set_ylabel(name if column.unit in ("", "1") else column.unit)


def end_of_charge(flight: Flight) -> str:
    """The charge that a flight left in the battery, such as "62 %"; "" without a battery."""
    left = float(flight["state_of_charge"][-1]) if "state_of_charge" in flight.columns else math.nan
    return percent(100 * left)[0] if math.isfinite(left) else ""
