"""The delay and lag that a flight's loop stands, for the record of the flight."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

from quadexp.config.flight import PlantConfig

_known: WeakKeyDictionary[Any, dict[tuple[float, float], dict[str, float]]] = WeakKeyDictionary()  # flown many times


def loop_margins(controller: Any, config: PlantConfig, plant: Any = None) -> dict[str, float] | None:
    """{delay, lag, early} (s), see quadexp.control.mpc.margins; None for what is no MPC of this program.

    Then what is predicted, {dead_time, motor_lag}, what the plant's options and the world around it have of both,
    {world_latency, world_lag} (s), and world_stable: whether the loop is stable at hover there.
    plant: what is flown; a World knows the delays of its link, actuators and estimator.
    """
    from quadexp.control.mpc.controller import PredictiveController

    if not isinstance(controller, PredictiveController):
        return None
    latency, lag = (float(getattr(config, name, 0.0) or 0.0) for name in ("latency", "motor_lag"))
    latency += getattr(plant, "loop_delay", 0.0)
    lag += getattr(plant, "loop_lag", 0.0)
    made = _known.setdefault(controller, {})
    if (latency, lag) not in made:
        from quadexp.control.mpc.margins import STABLE, HoverLoop, margins

        settings = controller.settings
        beyond = {"delay": latency - settings.dead_time, "lag": max(lag - settings.known_lag, 0.0)}
        made[latency, lag] = {
            **margins(controller)._asdict(),
            "dead_time": settings.dead_time,
            "motor_lag": settings.known_lag,
            "world_latency": latency,
            "world_lag": lag,
            "world_stable": HoverLoop(controller).radius(**beyond) <= STABLE,
        }
    return made[latency, lag]
