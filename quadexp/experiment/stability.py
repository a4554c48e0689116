"""Refusing a flight whose loop the plant's own lag or delay makes unstable at hover, and what would make it stable.

The loop is that of quadexp.control.mpc.margins, linear at hover around the controller's own model. What is tried
instead: telling the controller lag and delay, and other control rates and horizons without.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller
from quadexp.experiment.identity import ModelFile
from quadexp.experiment.loop_margins import unmodelled
from quadexp.parts.schema import Config
from quadexp.physics.vehicle import Vehicle

RATES, SHARES = (100.0, 200.0), (1.0, 0.5)  # control rates that are tried (Hz), and shares of the horizon
DIGITS = 3  # decimals of what is proposed


def instability(
    config: Config, margins: Mapping[str, Any] | None, vehicle: Vehicle, plant: Any, model: ModelFile | None
) -> str:
    """Why the loop of a flight is not stable at hover, in one line with what helps; "" where it is, where that is not
    known (margins None, see loop_margins), where the world is not to blame, and where the configuration allows it."""
    if not margins or margins["world_stable"] or not margins["delay"]:
        return ""
    controller: Any = config.controller
    if controller.allow_unstable:
        return ""
    late = max(margins["world_latency"] - margins["age"], 0.0)
    lag = "motor_lead" if controller.motor_lead else "motor_lag"
    world = {lag: round(margins["world_lag"], DIGITS), "dead_time": round(late, DIGITS)}
    known = {lag: margins["motor_lag"], "dead_time": margins["dead_time"]}
    unknown = {name: value for name, value in world.items() if value != known[name]}

    def stable(changes: Mapping[str, float]) -> bool:
        from quadexp.control.mpc.margins import STABLE, HoverLoop
        from quadexp.control.wrapped import innermost

        try:
            other = replace(config, controller=replace(controller, backend="interpreted", **changes))
            loop = innermost(build_controller(other, vehicle, plant, model))
        except UsageError:  # of settings that contradict each other
            return False
        beyond = unmodelled(loop, margins["age"], margins["world_latency"], margins["world_lag"])
        return bool(HoverLoop(loop).radius(**beyond) <= STABLE)

    grids = [
        {"rate": max(rate, controller.rate), "horizon": round(share * controller.horizon, DIGITS)}
        for rate in RATES
        for share in SHARES
    ]
    told = next((_keys(unknown | grid) for grid in grids if stable(unknown | grid)), "")
    if stable(unknown):
        told = f"{_keys(unknown)} at this rate and horizon"
    faster = next((_keys(grid) for grid in grids if stable(grid)), "")
    found = ", or ".join(filter(None, (told, faster))) or "nothing that was tried"
    causing = {
        "motors that lag by": margins["world_lag"],
        "commands and measurements that are late by": margins["world_latency"],
    }
    causes = " and ".join(f"{words} {_ms(value)}" for words, value in causing.items() if value)
    predicts = {"lag": margins["motor_lag"], "delay": margins["dead_time"] + margins["age"]}
    told_of = " and ".join(f"{_ms(value)} of {name}" for name, value in predicts.items() if value)
    return (
        f"{controller.name} on {config.plant.name}: {causes or 'no delay'}; at {controller.rate:g} Hz with a horizon of"
        f" {controller.horizon:g} s this loop tolerates {_ms(margins['lag'])} of lag or {_ms(margins['delay'])} of"
        f" delay{f' beyond the {told_of} that it predicts' if told_of else ''}, and is not stable at hover; what makes"
        f" it stable: {found}; to fly it all the same: controller.allow_unstable=true"
    )


def _keys(changes: Mapping[str, float]) -> str:
    return " ".join(f"controller.{name}={value:g}" for name, value in changes.items())


def _ms(time: float) -> str:
    return f"{1e3 * time:.0f} ms"
