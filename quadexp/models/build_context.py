"""What a part is built with: the parts that are made before it, and where its models of the air come from."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from quadexp.errors import UsageError
from quadexp.parts.sensor_spec import SensorSpec

if TYPE_CHECKING:
    from pathlib import Path

    from quadexp.models.residual import Residual
    from quadexp.physics.vehicle import Vehicle


class FlownPlant(Protocol):
    """What a controller's part may know of the plant; one with coefficients of its own has them too."""

    vehicle: Vehicle

    def residual(self) -> Residual: ...


class AroundController(Protocol):
    """What a part that is built may know of one around it; see control.part."""

    believes: ClassVar[bool]
    prefix: ClassVar[str]

    def scales_air(self, context: BuildContext) -> bool: ...

    def suited(self, settings: Any) -> Any: ...


def _without(*_: Any) -> Any:
    raise UsageError("this part is built without a model of the air")


@dataclass(frozen=True, kw_only=True)
class BuildContext:
    """What a part that is built is handed, as far as it is made before.

    vehicle: that the part is for: the flown one for a plant, the assumed one for a controller. assumed_vehicle: that
    which controllers assume, where it is another. plant: that is flown, for a controller. sensor_spec: what is stated
    of its sensors. remedies: parts around a controller, the nearest first.
    residual(kind, ..): the model of the air of that kind, or the sum of several kinds. residuals(kinds): each by
    itself, of kinds with checkpoints. checkpoint(i): the i-th fitted model, None without one. folder: that `model`
    names, "" for none. plant_model(path, kind): a checkpoint that is taken as the truth.
    """

    vehicle: Vehicle
    assumed_vehicle: Vehicle | None = None
    plant: FlownPlant | None = None
    sensor_spec: SensorSpec = SensorSpec()
    remedies: tuple[AroundController, ...] = ()
    residual: Callable[..., Residual] = _without
    residuals: Callable[[Iterable[str]], list[Residual]] = _without
    checkpoint: Callable[[int], Any] = _without
    folder: str = ""
    plant_model: Callable[[str | Path, str], Residual] = _without

    @property
    def assumed(self) -> Vehicle:
        """The vehicle that controllers assume (kg, kg m^2, m)."""
        return self.vehicle if self.assumed_vehicle is None else self.assumed_vehicle

    @property
    def sheet(self) -> SensorSpec:
        """`sensor_spec`, as it is called for one release more."""
        return self.sensor_spec

    @property
    def believed(self) -> Vehicle:
        """`assumed`, as it is called for one release more."""
        return self.assumed
