"""The INDI rate loop around a controller, see law.py."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, realise, resolve
from quadexp.compile.symbolic import ca
from quadexp.control.base import Controller, Measurement, Window
from quadexp.control.delivered import DeliveredThrust
from quadexp.control.indi.law import INDIKeys, indi_function, settled_memory
from quadexp.control.instant import Operation, Told, call, copy
from quadexp.control.multirate import MultiRate
from quadexp.control.part import Remedy
from quadexp.control.wrapped import WrappedController, thrust_at_start
from quadexp.errors import UsageError
from quadexp.parts.settings import Backend, part
from quadexp.physics.state import RATE
from quadexp.physics.vehicle import Vehicle


class INDI(MultiRate):
    """A Controller: the inner one's thrusts as an INDI loop at inner.rate gives them to the rotors.

    Raises UsageError for settings that contradict each other.
    """

    def __init__(self, inner: Controller, keys: INDIKeys, *, backend: str = "auto") -> None:
        super().__init__(inner, keys.rate)
        self._keys, vehicle = keys, inner.vehicle
        self._law = BufferedFunction(_law(vehicle, keys, resolve(backend)))
        told = keys.dead_time, keys.motor_lag
        self._delivered = DeliveredThrust(vehicle, self.control_period, *told, backend=resolve(backend))

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset. The filters start as if rates and thrusts of the start had always been there."""
        super().reset(x, window)
        thrust = thrust_at_start(window, self.vehicle)
        self._delivered.reset(thrust)
        arguments, values = self._law.arguments, np.concatenate([x[RATE], np.sqrt(thrust)])
        arguments["before"][:], arguments["memory"][:] = values, settled_memory(self._keys, values)

    def shaped(self, measurement: Measurement, wanted: np.ndarray) -> np.ndarray:
        """See MultiRate.shaped."""
        arguments, results = self._law.arguments, self._law.results
        arguments["wanted"][:], arguments["rate"][:] = wanted, measurement.state[RATE]
        arguments["delivered"][:] = self._delivered.now(measurement)
        self._law()
        arguments["before"][:], arguments["memory"][:] = results["filtered"], results["memory_next"]
        thrust = results["thrust"].copy()
        self._delivered.record(thrust)
        return thrust

    def shaping(self, told: Told, wanted: np.ndarray) -> tuple[list[Operation], np.ndarray]:
        """See MultiRate.shaping."""
        arguments, results = self._law.arguments, self._law.results
        operations, delivered = self._delivered.before(told.speed)
        operations += [copy(arguments["wanted"], wanted), copy(arguments["rate"], told.state[RATE])]
        operations += [copy(arguments["delivered"], delivered), call(self._law)]
        operations += [
            copy(arguments["before"], results["filtered"]),
            copy(arguments["memory"], results["memory_next"]),
        ]
        return [*operations, *self._delivered.after(results["thrust"])], results["thrust"]


def with_indi(controller: Controller, config: INDIPart) -> INDI:
    """The controller inside an INDI loop.

    Raises UsageError where the rates do not fit, or an observer inside finds the torque that the loop removes too.
    """
    part_of: Controller = controller
    while isinstance(part_of, WrappedController):
        if getattr(part_of, "finds_torque", False):
            raise UsageError(
                f"inner={config.name}: it removes an unknown torque, which the observer inside finds too and the"
                " controller would take away a second time; set observer.torque_bandwidth=0"
            )
        part_of = part_of.inner
    return INDI(controller, part(INDIKeys, config), backend=config.backend)


@lru_cache(maxsize=16)
def _law(vehicle: Vehicle, keys: INDIKeys, backend: str) -> ca.Function:
    return realise(indi_function(vehicle, keys), backend)


@dataclass(frozen=True, kw_only=True)
class INDIPart(INDIKeys, Remedy):
    """An INDI rate loop."""

    backend: Backend = "auto"

    def around(self, controller: Any) -> INDI:
        """See Remedy."""
        return with_indi(controller, self)
