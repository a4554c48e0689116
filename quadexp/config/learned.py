"""Settings of controllers with learned models: a network, sums of models, weights that adapt in flight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from quadexp.config.flight import PredictiveConfig
from quadexp.config.settings import Setting, Settings
from quadexp.errors import UsageError

LEARNED = ("linear_drag", "gaussian_process", "neural")  # models from checkpoints
FEATURES = (*LEARNED, "terms")  # models that are linear in some of their parameters
PARTS = Setting("models that are added to the rigid body in the prediction, and summed")


@dataclass(frozen=True, kw_only=True)
class SumMPCConfig(PredictiveConfig):
    """MPC with a sum of models; `models` holds one checkpoint folder for each of them."""

    kind: str = "sum_mpc"
    residual: Annotated[tuple[str, ...], PARTS]

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_parts("controller.residual", self.residual, LEARNED)


@dataclass(frozen=True)
class AdaptKeys(Settings):
    """How weights adapt in flight; see quadexp/air/online.py."""

    prefix: ClassVar[str] = "controller.adapt."

    law: Annotated[
        Literal["bayes", "rls", "composite"],
        Setting(
            "bayes: Kalman filter with a pull to the prior; rls: recursive least squares with forgetting; composite:"
            " bayes with the tracking error, Neural-Fly's law"
        ),
    ] = "bayes"
    memory: Annotated[
        float,
        Setting("time constant of forgetting; for rls of the forgetting factor exp(-dt / memory)", "(0, 1e9]", "s"),
    ] = 10.0
    noise: Annotated[
        float, Setting("standard deviation of a sample of the residual acceleration", "(0, 100]", "m/s^2")
    ] = 0.1
    deviation: Annotated[
        float,
        Setting("prior standard deviation of the acceleration that the weights can add, roughly", "(0, 100]", "m/s^2"),
    ] = 0.8
    fit_prior: Annotated[
        bool, Setting("of a Gaussian process: take the signal variance of its fit in place of deviation")
    ] = False
    start: Annotated[
        Literal["model", "zero"],
        Setting("first weights, to which they return without data: those of the checkpoint, or zero"),
    ] = "model"
    fitc: Annotated[
        bool,
        Setting("of a Gaussian process: count what the inducing points do not know as noise (FITC), not variational"),
    ] = False
    every: Annotated[
        int, Setting("control periods between two samples that are used; more than 1 where their noise is coloured",
                     "[1, 1000]", "periods")
    ] = 1  # fmt: skip
    tracking: Annotated[
        float, Setting("of law=composite: weight of the tracking error in the adaptation", "[0, 1e6]", "s^2 m^-2")
    ] = 10.0
    tracking_rate: Annotated[
        float, Setting("of law=composite: Lambda of the tracking error (v - v_r) + Lambda (p - p_r)", "[0, 100]", "1/s")
    ] = 1.0


@dataclass(frozen=True, kw_only=True)
class OnlineMPCConfig(PredictiveConfig):
    """MPC whose model adapts in flight; see quadexp/control/mpc/online_mpc.py.

    residual: summed models, of which the last one adapts. models: one folder for each that comes from a checkpoint.
    """

    kind: str = "online_mpc"
    residual: Annotated[tuple[str, ...], Setting("summed models; the weights of the last one adapt")]
    reference_period: Annotated[
        float, Setting("time between new references from the adapted model; 0: never", "[0, 3600]", "s")
    ] = 1.0
    adapt: Annotated[AdaptKeys, Setting("how the weights adapt")]

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_parts("controller.residual", self.residual, FEATURES)
        if "terms" in self.residual[:-1]:
            raise UsageError(
                "controller.residual: terms have no fitted values, so they can only be the last, adapting one"
            )


def _check_parts(key: str, parts: tuple[str, ...], allowed: tuple[str, ...]) -> None:
    for one in parts:
        if one not in allowed:
            raise UsageError(f"{key}: unknown model {one!r}; allowed are {', '.join(allowed)}")
    if not parts:
        raise UsageError(f"{key}=[]: at least one of {', '.join(allowed)}")
