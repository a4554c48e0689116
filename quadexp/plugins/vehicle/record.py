"""A flight of the bench, recorded so that C can make it again: what the controller is given and answers, and the plant.

Vectors have a row a control instant, in the precision of the controller; a reading that is missing is not a number. The
plant's row has every argument of its compiled period but state, inner states and thrusts, so that C can close the loop.
"""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.control.base import Measurement, Window
from quadexp.control.control_step import stepped
from quadexp.control.mpc.active_set import Status
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.world.integrator import SimulatedPlant

MOST = 1500  # control instants of a recorded flight
FAILED = 2  # what C answers to a step without an answer
OF_LOOP = ("x", "inner", "u")  # arguments of a plant's period that the loop itself gives


class Enough(Exception):
    """As much is recorded as is asked for."""


class Recorder:
    """A controller that flies as `controller` does, in Python, and keeps what passes. rows: a row a control instant.
    contexts: of the plant's periods between them; None where C cannot fly this plant."""

    def __init__(self, controller: Any, plant: Any, most: int) -> None:
        self.controller, self.plant, self.most = controller, plant, most
        self.rows = list[np.ndarray]()
        self.positions = list[np.ndarray]()
        self.contexts: list[np.ndarray] | None = [] if compiled_period(plant, controller.control_period) else None
        self.first = np.zeros(0)
        self._pending: dict[str, np.ndarray] | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.controller, name)

    def step(self, measurement: Measurement, window: Window) -> tuple[np.ndarray, Any]:
        """See Controller.step."""
        self._keep_period()
        if len(self.rows) == self.most:
            raise Enough
        thrusts, record = stepped(self.controller, measurement, window)
        self.rows.append(vector(measurement, window, thrusts, FAILED if record.status == Status.FAILED else 0))
        return thrusts, record

    def _keep_period(self) -> None:
        """Of the period before this instant, what the plant was given; and what it will be given, but for noise."""
        if self.contexts is None:
            return
        period = compiled_period(self.plant, self.controller.control_period)
        assert period is not None
        if self._pending is None:
            measured = getattr(self.plant, "measured", np.zeros(0))
            self.first = np.concatenate([np.array(self.plant.inner), measured])
        else:
            drawn = {name: period.arguments[name].copy() for name in ("noise", "draws") if name in period.arguments}
            context = self._pending | drawn
            self.contexts.append(np.concatenate([np.zeros(0), *(context[name].ravel() for name in context)]))
            self.positions.append(period.results["x_next"][:3].copy())
            if period.results["doubt"].any():
                self.contexts = None
                return
        arguments = period.arguments.items()
        self._pending = {name: array.copy() for name, array in arguments if name not in OF_LOOP}


def compiled_period(plant: Any, duration: float) -> BufferedFunction | None:
    """The function of a control period of a plant that is one compiled function, else None."""
    if not isinstance(plant, SimulatedPlant) or type(plant).advance is not SimulatedPlant.advance:
        return None
    period = plant.prepared(duration)
    return period if hasattr(period.function, "origin") else None


def vector(measurement: Measurement, window: Window, thrusts: np.ndarray, status: int) -> np.ndarray:
    """A row: state, window, force, speed, command, status."""
    force, speed = measurement.specific_force, measurement.rotor_speed
    missing = np.full(3, np.nan), np.full(len(thrusts), np.nan)
    readings = missing[0] if force is None else force, missing[1] if speed is None else speed
    return np.concatenate([measurement.state, packed(window, len(thrusts)), *readings, thrusts, [status]])


def packed(window: Window, rotors: int) -> np.ndarray:
    """A window of the reference as C has it."""
    inputs = np.zeros((max(len(window.state) - 1, 1), rotors))
    inputs[: len(window.input)] = window.input
    path = np.ravel(window.position)
    return np.concatenate([window.state.ravel(), inputs.ravel(), path, window.yaw, [window.drift]])


def recorded(controller: Any, plant: Any, reference: SampledReference, rng: Any) -> Recorder:
    """A flight of the reference, of at most MOST instants."""
    recorder = Recorder(controller, plant, MOST)
    with contextlib.suppress(Enough):
        fly(plant, recorder, reference, rng)
    return recorder
