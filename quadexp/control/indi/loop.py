"""The INDI rate loop around a controller, see law.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, resolve
from quadexp.control.base import Controller, Window
from quadexp.control.built import built
from quadexp.control.delivered import DeliveredThrust
from quadexp.control.indi.law import INDIKeys, indi_function, settled_memory
from quadexp.control.instant import Instant, Told, call, copy, instant_of
from quadexp.control.part import Remedy
from quadexp.control.wrapped import WrappedController, thrust_at_start
from quadexp.errors import UsageError
from quadexp.parts.settings import Backend, part
from quadexp.physics.state import RATE

WHOLE = 1e-6  # how far a ratio of rates may be from a whole number


class INDI(WrappedController):
    """A Controller at inner.rate: every n-th instant the inner one, whose thrusts an INDI loop gives to the rotors.

    Raises UsageError for settings that contradict each other, and where the rate is no whole multiple of the
    controller's.
    """

    def __init__(self, inner: Controller, keys: INDIKeys, *, backend: str = "auto") -> None:
        super().__init__(inner)
        ratio = keys.rate * inner.control_period
        self._every = round(ratio)
        if self._every < 1 or abs(ratio - self._every) > WHOLE * ratio:
            raise UsageError(
                f"inner.rate={keys.rate:g}: must be a whole multiple of the controller's rate of"
                f" {1 / inner.control_period:g} Hz"
            )
        self.control_period = inner.control_period / self._every
        self._keys, vehicle = keys, inner.vehicle
        self._law = BufferedFunction(built(backend, indi_function, vehicle, keys))
        told = keys.dead_time, keys.motor_lag
        self._delivered = DeliveredThrust(vehicle, self.control_period, *told, backend=resolve(backend))

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset. The filters start as if rates and thrusts of the start had always been there."""
        super().reset(x, window)
        thrust = thrust_at_start(window, self.vehicle)
        self._delivered.reset(thrust)
        arguments, values = self._law.arguments, np.concatenate([x[RATE], np.sqrt(thrust)])
        arguments["before"][:], arguments["memory"][:] = values, settled_memory(self._keys, values)

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant; the record is that of the controller's last step."""
        inner = instant_of(self.inner, told, state)
        arguments, results, delivered = self._law.arguments, self._law.results, self._delivered
        wanted = copy(arguments["wanted"], inner.command)
        operations = [o._replace(every=o.every * self._every) for o in (*inner.operations, wanted)]
        operations += [*delivered.before(told), copy(arguments["rate"], state[RATE])]
        operations += [copy(arguments["delivered"], delivered.thrust), call(self._law)]
        operations.append(copy(arguments["before"], results["filtered"]))
        operations.append(copy(arguments["memory"], results["memory_next"]))
        operations += delivered.after(results["thrust"])
        return inner._replace(operations=operations, command=results["thrust"])


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


@dataclass(frozen=True, kw_only=True)
class INDIPart(INDIKeys, Remedy):
    """An INDI rate loop."""

    backend: Backend = "auto"

    def around(self, controller: Any) -> INDI:
        """See Remedy."""
        return with_indi(controller, self)
