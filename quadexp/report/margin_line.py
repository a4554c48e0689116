"""The delay and lag that a loop tolerates, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

LONG = 0.499  # s: margins are not looked for beyond half a second


def margin_line(margins: Mapping[str, Any] | None) -> str:
    """What a loop tolerates of what nobody predicted; "" where it is not known. margins: see experiment.loop_margins.
    They are those of the MPC by itself, which is said where a remedy is around it."""
    if not margins:
        return ""
    if not margins["delay"]:
        return "hover is not stable, even without a delay"
    delay, lag = (_milliseconds(margins[name]) for name in ("delay", "lag"))
    of = "the bare MPC tolerates" if margins.get("without") or margins.get("age") else "tolerates"
    line, predicted = f"{of} {delay} of unmodelled delay, {lag} of unmodelled lag", _predicted(margins)
    left_out = "".join(f", without {name}" for name in margins.get("without", ()))
    if not predicted:
        return f"{line} (at hover{left_out})"
    line = f"{line} beyond the {_milliseconds(predicted)} predicted"
    if not margins["dead_time"]:
        return f"{line} (at hover{left_out})"
    return f"{line}, and {_milliseconds(margins['early'])} less than these (at hover{left_out})"


def world_note(margins: Mapping[str, Any] | None) -> str:
    """Where the world's own delays are more than the loop tolerates; "" where they are not."""
    if not margins or margins["world_stable"] or not margins["delay"]:
        return ""
    world = f"{_milliseconds(margins['world_latency'])} of delay and {_milliseconds(margins['world_lag'])} of motor lag"
    loop = "the loop of the bare MPC" if margins.get("without") else "the loop"
    return (
        f"this world has {world}, the controller predicts {_milliseconds(_predicted(margins))} of dead time and"
        f" {_milliseconds(margins['motor_lag'])} of lag: {loop} is not stable at hover; give controller.dead_time,"
        " controller.motor_lag, or a longer controller.first_node (horizon=robust)"
    )


def delays_note(columns: Mapping[str, Any]) -> str:
    """What delay=identified found in a flight, and how the controller flew until then; "" of other flights."""
    if "delay_known" not in columns:
        return ""
    soft = "the published grid with soft weights"
    known = [float(t) for t, found in zip(columns["t"], columns["delay_known"], strict=True) if found]
    if not known:
        return f"the delays were not all found in this flight: {soft} flew"
    names = {"delay_time": "state", "delay_dead_time": "commands", "delay_lag": "motors"}
    found = ", ".join(f"{word} {_milliseconds(float(columns[name][-1]))}" for name, word in names.items())
    return f"delays found in flight: {found}; {soft} flew until t={known[0]:.2f} s"


def _predicted(margins: Mapping[str, Any]) -> float:
    """What is predicted of delays (s), of commands and of the state; flights of earlier versions have no age."""
    return float(margins["dead_time"] + margins.get("age", 0.0))


def _milliseconds(time: float) -> str:
    return "over 500 ms" if time > LONG else f"{1e3 * time:.0f} ms"
