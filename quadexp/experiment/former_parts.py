"""Parts of users in their former form: a class or function and its arguments, for one release.

    defaults: [/schema/trajectory/custom@_here_, _self_]
    _target_: my_package.helix.Helix
    options: {radius: 3.0, pitch: 0.5}

Today `_target_` names a subclass of TrajectoryPart, PlantPart or ControllerPart, whose fields are its keys; see
docs/guide.md.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from typing import Any, Literal

from quadexp.control.mpc.part import PredictivePart
from quadexp.control.part import RESIDUAL, ControllerPart
from quadexp.errors import QuadexpError, UsageError
from quadexp.parts.part import Given, imported
from quadexp.parts.settings import REQUIRED, Settings, key
from quadexp.reference.base import SPEED, TrajectoryPart
from quadexp.world.base import PlantPart


@dataclass(frozen=True, kw_only=True)
class FormerKeys(Settings):
    """What is called, and with what."""

    _target_: str = key(REQUIRED, "MODULE.NAME of your class or function, called with the arguments above")
    options: dict[str, Any] = key({}, "its keyword arguments")

    def called(self, group: str, *arguments: Any, **given: Any) -> Any:
        """What the class or function returns; UsageError where the name, its options or what it makes are wrong."""
        key = f"{group}._target_={self._target_}"
        target = imported(group, self._target_, own="")
        if not callable(target):
            module, _, name = self._target_.rpartition(".")
            raise UsageError(f"{key}: module {module} has no class or function {name!r}")
        try:
            inspect.signature(target).bind(*arguments, **given, **self.options)
        except TypeError as error:
            passed = ", ".join([*(["vehicle"] if arguments else []), *given, *self.options])
            raise UsageError(f"{key}: cannot be called with {passed or 'nothing'} ({error})") from None
        except ValueError:  # no signature can be had
            pass
        try:
            return target(*arguments, **given, **self.options)
        except QuadexpError:
            raise
        except Exception as error:
            raise UsageError(f"{key}: raised {type(error).__name__}: {error}") from error


@dataclass(frozen=True, kw_only=True)
class FormerPlant(FormerKeys, PlantPart):
    """Your plant: _target_(vehicle, step=..., **options) -> Plant; step: s, of its integration."""

    former_kind = "custom"

    def build(self, given: Given) -> Any:
        """See PlantPart."""
        return self.called("plant", given.vehicle, step=self.step)


@dataclass(frozen=True, kw_only=True)
class FormerTrajectory(FormerKeys, TrajectoryPart):
    """Your trajectory: _target_(**options) -> Trajectory; called with speed too, where it is set."""

    former_kind = "custom"
    speed: float | None = key(None, SPEED)

    def build(self, vehicle: Any) -> Any:
        """See TrajectoryPart."""
        return self.called("trajectory", **({} if self.speed is None else {"speed": self.speed}))


@dataclass(frozen=True, kw_only=True)
class FormerController(FormerKeys, ControllerPart):
    """Your controller: _target_(vehicle, **options) -> Controller."""

    former_kind = "custom"

    def build(self, given: Given) -> Any:
        """See ControllerPart."""
        return self.called("controller", given.vehicle)


@dataclass(frozen=True, kw_only=True)
class FormerResidualMPC(FormerKeys, PredictivePart):
    """The MPC with your residual: _target_(vehicle, **options) -> Residual."""

    former_kind = "custom"
    residual: Literal["custom"] = key("custom", RESIDUAL)

    def model(self, given: Given) -> Any:
        """See PredictivePart."""
        return self.called("controller", given.vehicle)
