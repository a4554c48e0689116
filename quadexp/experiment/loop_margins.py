"""The delay and lag that a flight's loop stands, for the record of the flight."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

from quadexp.config.flight import PlantConfig

_known: WeakKeyDictionary[Any, dict[tuple[float, float], dict[str, float]]] = WeakKeyDictionary()  # flown many times


def loop_margins(controller: Any, plant: PlantConfig, truth: Any = None) -> dict[str, float] | None:
    """{delay, lag, early} (s), see quadexp.control.mpc.margins; None for what is no MPC of this program.

    Then what is predicted, {dead_time, motor_lag}, what the plant's options say of the world, {world_latency,
    world_lag} (s), and world_stable: whether the loop is stable at hover there. truth: the plant itself, whose
    motor_lag (s) counts where its options do not state one.
    """
    from quadexp.control.mpc.controller import PredictiveController

    if not isinstance(controller, PredictiveController):
        return None
    latency = float(getattr(plant, "latency", 0.0) or 0.0)
    lag = float(getattr(truth, "motor_lag", getattr(plant, "motor_lag", 0.0)) or 0.0)
    made = _known.setdefault(controller, {})
    if (latency, lag) not in made:
        from quadexp.control.mpc.margins import STABLE, HoverLoop, margins

        settings = controller.settings
        beyond = {"delay": latency - settings.dead_time, "lag": max(lag - settings.motor_lag, 0.0)}
        made[latency, lag] = {
            **margins(controller)._asdict(),
            "dead_time": settings.dead_time,
            "motor_lag": settings.motor_lag,
            "world_latency": latency,
            "world_lag": lag,
            "world_stable": HoverLoop(controller).radius(**beyond) <= STABLE,
        }
    return made[latency, lag]
