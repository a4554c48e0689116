"""The delay and lag that a flight's loop tolerates, and refusing one whose loop they make unstable at hover.

The loop is that of quadexp.control.mpc.margins, linear at hover around the controller's own model. What is tried
instead of an unstable one: telling the controller lag and delay, and other control rates and horizons without.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller
from quadexp.experiment.checkpoints import ModelFile
from quadexp.parts.schema import Config
from quadexp.physics.state import ATTITUDE, N_STATE
from quadexp.physics.vehicle import Vehicle

RATES, SHARES = (100.0, 200.0), (1.0, 0.5)  # control rates that are tried (Hz), and shares of the horizon
DIGITS = 3  # decimals of what is proposed

_known: WeakKeyDictionary[Any, dict[tuple[float, float], dict[str, Any]]] = WeakKeyDictionary()  # flown many times


def loop_margins(controller: Any, config: Any, plant: Any = None) -> dict[str, Any] | None:
    """{delay, lag, early} (s), see quadexp.control.mpc.margins; None for what is no MPC of this program.

    Then what is predicted, {dead_time, motor_lag, age}, age of the state by the delay remedies; what the plant's
    options and the world around it have of both, {world_latency, world_lag} (s); and world_stable: whether the loop is
    stable at hover there. A state that comes late counts as commands that do: around the loop they are the same, and so
    is a state that is brought to now. without: remedies that change the loop and are not in it, such as observers,
    whose bandwidth is outside this linear loop.
    plant: what is flown; a World knows the delays of its link, actuators and estimator.
    """
    from quadexp.control.mpc.controller import PredictiveController
    from quadexp.control.wrapped import innermost, layers

    core = innermost(controller)
    if not isinstance(core, PredictiveController):
        return None
    latency, lag = (float(getattr(config, name, 0.0) or 0.0) for name in ("latency", "motor_lag"))
    latency += getattr(plant, "loop_delay", 0.0)
    lag += getattr(plant, "loop_lag", 0.0)
    made = _known.setdefault(controller, {})
    if (latency, lag) not in made:
        from quadexp.control.base import Window
        from quadexp.control.mpc.margins import STABLE, HoverLoop, margins

        n, rest = controller.vehicle.n_rotors, np.eye(N_STATE)[ATTITUDE.start]
        nodes = len(controller.node_times)
        thrusts = np.full((nodes - 1, n), controller.vehicle.hover_thrust)
        controller.reset(rest, Window(np.tile(rest, (nodes, 1)), thrusts, np.zeros((5, 3)), np.zeros(3)))
        around = layers(controller)
        age = sum(float(getattr(one, "delay", 0.0)) for one in around if one.in_margins)
        settings = core.settings
        made[latency, lag] = {
            **margins(core)._asdict(),
            "dead_time": settings.dead_time,
            "motor_lag": settings.known_lag,
            "age": age,
            "world_latency": latency,
            "world_lag": lag,
            "world_stable": HoverLoop(core).radius(**unmodelled(core, age, latency, lag)) <= STABLE,
            "without": [type(one).__name__.lower() for one in around if not one.in_margins],
        }
    return made[latency, lag]


def unmodelled(core: Any, age: float, latency: float, lag: float) -> dict[str, float]:
    """{delay, lag} (s) of a world beyond what an MPC and the remedy around it predict, for HoverLoop."""
    known = core.settings
    return {"delay": max(latency - age, 0.0) - known.dead_time, "lag": max(lag - known.known_lag, 0.0)}


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
