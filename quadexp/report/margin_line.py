"""The delay and lag that a loop stands, in words."""

from __future__ import annotations

from collections.abc import Mapping

LONG = 0.499  # s: margins are not looked for beyond half a second


def margin_line(margins: Mapping[str, float] | None) -> str:
    """What a loop stands of what nobody predicted; "" where it is not known. margins: see experiment.loop_margins."""
    if not margins:
        return ""
    if not margins["delay"]:
        return "hover is not stable, even without a delay"
    delay, lag, known = (_milliseconds(margins[name]) for name in ("delay", "lag", "dead_time"))
    line = f"stands {delay} of unmodelled delay, {lag} of unmodelled lag"
    if not margins["dead_time"]:
        return f"{line} (at hover)"
    return f"{line} beyond the {known} predicted, and {_milliseconds(margins['early'])} less than these (at hover)"


def world_note(margins: Mapping[str, float] | None) -> str:
    """Where the world's own delays are more than the loop stands; "" where they are not."""
    if not margins or margins["world_stable"] or not margins["delay"]:
        return ""
    world = f"{_milliseconds(margins['world_latency'])} of delay and {_milliseconds(margins['world_lag'])} of motor lag"
    return (
        f"this world has {world}, the controller predicts {_milliseconds(margins['dead_time'])} of dead time and"
        f" {_milliseconds(margins['motor_lag'])} of lag: the loop is not stable at hover; give controller.dead_time,"
        " controller.motor_lag, or a longer controller.first_node (horizon=robust)"
    )


def _milliseconds(time: float) -> str:
    return "over 500 ms" if time > LONG else f"{1e3 * time:.0f} ms"
