"""The delay and lag that a flight's loop tolerates, for the record of the flight."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from quadexp.physics.state import ATTITUDE, N_STATE

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
