"""What options of controllers and of remedies have in common; a controller's part stands with its law.

A compensation is put around a controller against errors of its model, delays and disturbances; see control/wrapped.py.
"""

from __future__ import annotations

from typing import Any, ClassVar

from quadexp.models.build_context import BuildContext
from quadexp.parts.former import names_of
from quadexp.parts.models import is_shipped
from quadexp.parts.part import Part
from quadexp.parts.settings import Setting, key, keyed
from quadexp.parts.user_modules import own_folders

GIVEN = ("none", "plant")  # models of the air that are not learned from flights
RESIDUAL = Setting("model that is added to the rigid body in the prediction", options="model", also=GIVEN)


@keyed
class ControllerPart(Part):
    """What every controller has, as an option of the configuration."""

    prefix = "controller."
    added: ClassVar[tuple[str, ...]] = ("allow_unstable",)
    given: ClassVar[tuple[str, ...]] = GIVEN  # its models of the air that come from no checkpoint

    models: tuple[str, ...] = key((), "checkpoint folders that are tried, in this order, when `model` is not given")
    allow_unstable: bool = key(False, "fly although the loop is not stable at hover")

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of its models of the air, which are summed."""
        kinds: str | tuple[str, ...] = getattr(self, "residual", "none")
        return (kinds,) if isinstance(kinds, str) else kinds

    @property
    def learned(self) -> tuple[str, ...]:
        """Those of them that come from a checkpoint."""
        return tuple(kind for kind in self.kinds if kind not in self.given)

    @property
    def folders(self) -> tuple[str, ...]:
        """See Part; also those of a user's own model of the air."""
        return super().folders if all(map(is_shipped, self.learned)) else own_folders()

    @property
    def knows_plant(self) -> bool:
        """Whether it is given the plant's own equations or coefficients."""
        return "plant" in self.kinds

    def build(self, context: BuildContext) -> Any:
        """The Controller of context.vehicle. Raises UsageError where it lacks what it needs."""
        raise NotImplementedError


@keyed
class Compensation(Part):
    """A compensation. believes: whether it tells the controller of disturbances, see control/base.py. alone: whether it
    finds delays itself, and refuses other compensations and delays that are given."""

    believes: ClassVar[bool] = False
    alone: ClassVar[bool] = False

    def scales_air(self, context: BuildContext) -> bool:
        """Whether it finds a scale of the controller's model of the air."""
        return False

    def suited(self, settings: Any) -> Any:
        """The MPCSettings that the MPC inside is made with, from those that are asked for."""
        return settings

    def around(self, controller: Any) -> Any:
        """The controller inside the compensation. Raises UsageError where it cannot be put around this controller."""
        raise NotImplementedError

    def put_around(self, controller: Any, context: BuildContext) -> Any:
        """`around`, for a compensation that has to know more than the controller, such as context.sheet."""
        return self.around(controller)

    def check(self, vehicle: Any, plant: Any, controller: ControllerPart, others: tuple[Compensation, ...]) -> None:
        """Raise UsageError where it needs what neither vehicle nor world measure, nor the other parts know."""


__getattr__ = names_of(__name__)
