"""What a reader of a comparison must know besides its numbers, one sentence each, from the rows alone.

Shown under the error table (terminal, table.md, table.tex) and on the report's page. A note about another column of the
rows is another function here; it is called with the rows of each contestant, and may find the column absent.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from quadexp.learn.support import REPORTED_SHARE
from quadexp.report.flown_by import mixed_programs
from quadexp.report.pairing import condition_of, contestant_labels, contestant_of

LARGE_ATTITUDE_ERROR = math.radians(10.0)  # rad, RMS over a flight
UNFLOWN = ("failed", "infeasible")  # outcomes without a sample

Row = Mapping[str, Any]


def notes(rows: Sequence[Row]) -> list[str]:
    """The notes on result rows; empty where there is nothing to say."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault(contestant_of(row), []).append(row)
    labels = contestant_labels(list(groups))
    said = []
    for note in OF_A_CONTESTANT:
        texts = {labels[who]: note(own) for who, own in groups.items()}
        said += [f"{label}: {text}" for label, text in texts.items() if text]
    return said + mixed_programs(rows)


def _outside_data(rows: Sequence[Row]) -> str:
    """Samples outside the data that a learned model was fitted to, and flights of which that is not known."""
    shares = [(share, row) for row in rows if not math.isnan(share := _number(row.get("outside_data")))]
    unknown = sum(
        bool(row.get("model")) and row["outcome"] not in UNFLOWN and math.isnan(_number(row.get("outside_data")))
        for row in rows
    )
    parts = [f"unknown of {unknown} flights whether inside the data of its model (older checkpoint)"] if unknown else []
    if shares and max(share for share, _ in shares) > REPORTED_SHARE:
        mean = sum(share for share, _ in shares) / len(shares)
        largest, row = max(shares, key=lambda one: one[0])
        most = f" (most: {100 * largest:.3g} %, {_place(row)})" if len(shares) > 1 else ""
        parts.insert(0, f"{100 * mean:.3g} % of samples outside the data its model was fitted to{most}")
    return "; ".join(parts)


def _reference_residual(rows: Sequence[Row]) -> str:
    """References that contain the residual in part, or not at all."""
    known = [value for row in rows if not math.isnan(value := _number(row.get("reference_residual")))]
    partly, without = sum(0 < value < 1 for value in known), sum(value <= 0 for value in known)
    parts = [f"{partly} of {len(known)} references contain the residual only in part"] if partly else []
    parts += [f"{without} of {len(known)} references do not contain the residual"] if without else []
    return ", ".join(parts)


def _attitude_error(rows: Sequence[Row]) -> str:
    """Large attitude errors of flights that ended well; of a lost flight the outcome says enough."""
    errors = [
        (error, row)
        for row in rows
        if row["outcome"] == "ok" and not math.isnan(error := _number(row.get("attitude_rmse")))
    ]
    large = [one for one in errors if one[0] > LARGE_ATTITUDE_ERROR]
    if not large:
        return ""
    worst, row = max(large, key=lambda one: one[0])
    return (
        f"attitude error above {math.degrees(LARGE_ATTITUDE_ERROR):.0f} degrees in {len(large)} of {len(errors)}"
        f" flight{'s' if len(errors) > 1 else ''}"
        f" (most: {math.degrees(worst):.3g} degrees, {_place(row)})"
    )


OF_A_CONTESTANT: tuple[Callable[[Sequence[Row]], str], ...] = (_outside_data, _reference_residual, _attitude_error)


def _number(value: Any) -> float:
    return math.nan if value is None or value == "" else float(value)


def _place(row: Row) -> str:
    _, _, trajectory, speed, setting = condition_of(row)
    return " ".join(part for part in (trajectory, "" if speed is None else f"{speed:g} m/s", setting) if part)
