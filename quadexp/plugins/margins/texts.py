"""Texts about the margins of a loop, for pages and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

LONG = 0.499  # s: margins are not looked for beyond half a second


def margin_line(margins: Mapping[str, Any] | None) -> str:
    """What a loop tolerates beyond what it was flown with; "" where no record says. margins: as
    loop_margins.py has them."""
    if not margins:
        return ""
    if why := margins.get("unknown"):
        return f"what it tolerates is not known: {why}"
    where = _judged(margins)
    if not margins["delay"]:
        return f"is not stable {where}"
    delay = _milliseconds(margins["delay"])
    lag = _milliseconds(margins["lag"])
    return f"tolerates {delay} more of delay, {lag} more of motor lag ({where})"


def world_note(margins: Mapping[str, Any]) -> str:
    """That a loop was flown which is not stable; "" where it is."""
    if margins.get("delay", 1.0):
        return ""
    doubles = f"an error doubles every {math.log(2) / margins['growth']:.2g} s"
    return f"the loop is not stable {_judged(margins)}: {doubles}"


def _judged(margins: Mapping[str, Any]) -> str:
    """What a loop was judged as."""
    return ", ".join(filter(None, ("at hover", margins.get("judged"))))


def _milliseconds(time: float) -> str:
    return "over 500 ms" if time > LONG else f"{1e3 * time:.0f} ms"
