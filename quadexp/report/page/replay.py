"""Flights packed for the replay: a case is one condition and seed, flown by several controllers over one reference.

A track has, on a time grid that all tracks of a case share, the position error (so that it can be magnified without
loss) and the attitude, as integers in base64:

    error = int16 * error_step (m)      attitude = int16 / 32767
    position = reference + error        reference = centre + int16 * reference_step (m)
"""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quadexp.log.schema import Flight
from quadexp.log.signal import continuous
from quadexp.report.page.source import Comparison
from quadexp.report.pairing import Condition, condition_of, grouped
from quadexp.report.text import speed_text

BUDGET = 800_000  # characters of packed tracks
MAX_TRACKS = 12
MAX_CASES = 24
MAX_FLOWN = 60  # with other seeds of these
MAX_SAMPLES = 1500
LEAST_STEP = 0.02  # s
INT16 = 32767

Case = tuple[Condition, int]  # condition, seed


def case_of(row: Mapping[str, Any]) -> Case:
    return condition_of(row), int(row["seed"])


def choose_cases(comparison: Comparison, worst: Sequence[Mapping[str, Any]]) -> list[Case]:
    """The fastest condition with the largest error first, the cases of the worst flights, then all other conditions,
    then their other seeds. Conditions of the main world stand before others, and of a condition the seeds that most
    completed."""
    completed: dict[Case, int] = {}
    largest: dict[Condition, float] = {}
    for row in comparison.rows:
        if row["outcome"] != "infeasible":
            completed[case_of(row)] = completed.get(case_of(row), 0) + (row["outcome"] == "ok")
        if row["outcome"] == "ok":
            largest[condition_of(row)] = max(largest.get(condition_of(row), 0.0), row["max_error"])

    def place(case: Case) -> tuple[Any, ...]:
        condition, seed = case
        aside, speed = condition.world != comparison.world, condition.speed or 0.0
        return aside, -speed, -largest.get(condition, 0.0), str(condition), -completed[case], seed

    ordered = sorted(completed, key=place)
    leading = list({case[0]: case for case in reversed(ordered)}.values())[::-1]
    leading[1:1] = [case_of(row) for row in worst[:3]]
    others = sorted(ordered, key=lambda case: case[1])
    return list(dict.fromkeys([*leading[:MAX_CASES], *others]))[:MAX_FLOWN]


def case_title(comparison: Comparison, case: Case) -> str:
    """Such as "circle, payload 0.1 kg at 8 m/s, seed 3", with plant and vehicle where there are several."""
    condition, seed = case
    rate = "" if condition.speed is None else f" at {speed_text(condition.speed)}"
    return f"{comparison.course_title(condition)}{rate}, seed {seed}"


def pack_replay(
    comparison: Comparison, cases: Sequence[Case], budget: int = BUDGET
) -> tuple[list[dict[str, Any]], list[Case]]:
    """As many cases as fit into the budget, as JSON, and their names."""
    by_case = grouped((case_of(row), row) for row in comparison.rows)
    packed: list[dict[str, Any]] = []
    kept: list[Case] = []
    for case in cases:
        tracks = _pack(comparison, case, by_case[case])
        if tracks is None:
            continue
        budget -= _size(tracks)
        if budget < 0 and packed:
            break
        packed.append(tracks)
        kept.append(case)
    return packed, kept


def _pack(comparison: Comparison, case: Case, rows: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    rank = {label: k for k, label in enumerate(comparison.look)}
    first = [comparison.verdict.least, comparison.reference, *comparison.bounds]  # where there are too many
    labelled = {comparison.label(row): row for row in rows}
    ordered = sorted(labelled, key=lambda label: (label not in first, rank[label]))
    read = [(label, comparison.flight(labelled[label])) for label in ordered[:MAX_TRACKS]]
    flights = [(label, flight) for label, flight in read if flight is not None]
    flights = [(label, flight) for label, flight in flights if "ref_p_x" in flight.columns]
    if not flights:
        return None
    longest = max((flight for _, flight in flights), key=lambda flight: flight.t[-1])
    duration = float(longest.t[-1])
    step = max(LEAST_STEP, float(np.median(np.diff(longest.t))), duration / MAX_SAMPLES)
    t = np.arange(math.floor(duration / step + 1e-9) + 1) * step
    reference = _resample(longest, _reference(longest), t)
    centre = (reference.min(axis=0) + reference.max(axis=0)) / 2
    tracks = [_track(comparison, label, flight, t) for label, flight in flights]
    return {
        "title": case_title(comparison, case),
        "step": step,
        "samples": len(t),
        "rotors": longest.rotor_position.tolist(),
        "centre": centre.tolist(),
        **_integers("reference", reference - centre),
        "left_out": ordered[MAX_TRACKS:],
        "tracks": sorted(tracks, key=lambda track: rank[track["label"]]),
    }


def _track(comparison: Comparison, label: str, flight: Flight, t: np.ndarray) -> dict[str, Any]:
    t = t[t <= flight.t[-1] + 1e-9]
    error = _resample(flight, flight.stack(["p_x", "p_y", "p_z"]) - _reference(flight), t)
    attitude = _resample(flight, continuous(flight.stack(["q_w", "q_x", "q_y", "q_z"])), t)
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    look = comparison.look[label]
    return {
        "label": label,
        "colour": look.colour,
        "glyph": look.glyph,
        "samples": len(t),
        "outcome": flight.outcome,
        "cause": flight.metadata.get("cause", ""),
        **_integers("error", error),
        "attitude": _text(np.round(attitude * INT16)),
    }


def _reference(flight: Flight) -> np.ndarray:
    return flight.stack(["ref_p_x", "ref_p_y", "ref_p_z"])


def _resample(flight: Flight, values: np.ndarray, t: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(t, flight.t, column) for column in values.T], axis=-1)


def _integers(name: str, values: np.ndarray) -> dict[str, Any]:
    """Values as int16 and the step between two of them."""
    step = float(np.abs(values).max()) / INT16 or 1e-9
    return {name: _text(np.round(values / step)), f"{name}_step": step}


def _text(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values.astype("<i2")).tobytes()).decode()


def _size(case: Mapping[str, Any]) -> int:
    return len(case["reference"]) + sum(len(track["error"]) + len(track["attitude"]) for track in case["tracks"])
