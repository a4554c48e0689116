"""Settings of the fits: Gaussian processes, neural network, linear drag. Nothing heavy is imported here."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from quadexp.errors import UsageError
from quadexp.parts.part import Part
from quadexp.parts.settings import SEEDS, Setting, Settings, declared

_FEATURE = re.compile(r"[vw]_[xyz]|u_\d+|thrust")
# Models that a controller flies with, and the command that makes their checkpoint; `residual` names them.
MAKERS = {
    "linear_drag": "quadexp fit-drag DATASET --out models/drag",
    "gaussian_process": "quadexp fit-gp DATASET --out models/gp",
    "neural": "quadexp fit-nn DATASET --out models/nn",
}
HOLDOUT = Setting("share of the flights held out of the fit, on which it is reported", "[0, 0.9]", "of the flights")


def _features(output: str) -> Setting:
    return Setting(f"features of the GP of {output}; []: no correction")


@dataclass(frozen=True, kw_only=True)
class GPFeatures(Settings):
    """For every output the features of its GP; an empty list leaves the output uncorrected."""

    prefix: ClassVar[str] = "gp.features."

    a_x: Annotated[tuple[str, ...], _features("a_x")] = ()
    a_y: Annotated[tuple[str, ...], _features("a_y")] = ()
    a_z: Annotated[tuple[str, ...], _features("a_z")] = ()
    tau_x: Annotated[tuple[str, ...], _features("tau_x")] = ()
    tau_y: Annotated[tuple[str, ...], _features("tau_y")] = ()
    tau_z: Annotated[tuple[str, ...], _features("tau_z")] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        for output in declared(type(self)):
            for feature in getattr(self, output):
                _check_feature(f"{self.prefix}{output}", feature)


def _check_feature(key: str, feature: str) -> None:
    if not _FEATURE.fullmatch(feature):
        raise UsageError(f"{key}: unknown feature {feature!r}; allowed are v_x v_y v_z w_x w_y w_z thrust u_0 u_1 ...")


@dataclass(frozen=True, kw_only=True)
class GPKeys(Settings):
    """How the Gaussian processes are fitted; see quadexp/models/gaussian_process.py."""

    prefix: ClassVar[str] = "gp."

    inducing: Annotated[int, Setting("inducing points of an output", "[2, 1000]", "points")] = 20
    method: Annotated[
        Literal["sgpr", "subset", "exact"],
        Setting("variational bound of Titsias 2009, exact GP on a subset as in the paper, or exact GP on all rows"),
    ] = "sgpr"
    mean: Annotated[
        Literal["zero", "constant", "linear_drag", "quadratic", "blade_element"],
        Setting("mean function under the GP"),
    ] = "zero"
    seed: Annotated[int, Setting("seed of the choice of held-out flights and initial inducing points", SEEDS)] = 0
    max_rows: Annotated[
        int | None,
        Setting("largest number of rows, drawn at random; null: all rows", "[10, 10000000]", "rows"),
    ] = None
    max_exact_rows: Annotated[int, Setting("largest number of rows for gp.method=exact", "[10, 100000]", "rows")] = 1000
    holdout: Annotated[float, HOLDOUT] = 0.2
    refit: Annotated[bool, Setting("after the report, fit again to all flights")] = True
    alternatives: Annotated[bool, Setting("where a fit is no better than drag, report what other features give")] = True
    max_iterations: Annotated[int, Setting("largest number of L-BFGS iterations", "[1, 10000]")] = 60
    jitter: Annotated[float, Setting("added to K_ZZ, relative to the signal variance", "(0, 1e-6]")] = 1e-8


@dataclass(frozen=True, kw_only=True)
class GPConfig(GPKeys, Part):
    """How the Gaussian processes are fitted; see quadexp/models/gaussian_process.py."""

    features: Annotated[GPFeatures, Setting("features of every output")] = field(default_factory=GPFeatures)


@dataclass(frozen=True, kw_only=True)
class NNKeys(Settings):
    """How the neural network is made and trained; see quadexp/models/neural.py."""

    prefix: ClassVar[str] = "nn."

    features: Annotated[tuple[str, ...], Setting("features of all outputs")] = (
        "v_x",
        "v_y",
        "v_z",
        "thrust",
    )
    outputs: Annotated[tuple[str, ...], Setting("outputs; the others are not corrected")] = ("a_x", "a_y", "a_z")
    hidden: Annotated[tuple[int, ...], Setting("units of every hidden layer", "[1, 1000]", "units")] = (16, 16)
    spectral: Annotated[
        float | None,
        Setting(
            "largest slope of the scaled network, kept by spectral normalisation of every layer; null: no limit",
            "(0, 1000]",
        ),
    ] = None
    max_iterations: Annotated[int, Setting("largest number of L-BFGS iterations", "[1, 100000]")] = 400
    penalty: Annotated[
        float, Setting("penalty on every layer's mean square weight, relative to the outputs' mean square", "[0, 1]")
    ] = 1e-6
    seed: Annotated[int, Setting("seed of held-out flights, first weights", SEEDS)] = 0
    device: Annotated[
        Literal["auto", "cpu", "cuda"], Setting("where torch trains; auto: a CUDA device where there is one")
    ] = "cpu"
    holdout: Annotated[float, HOLDOUT] = 0.2
    refit: Annotated[bool, Setting("after the report, fit again to all flights")] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        for feature in self.features:
            _check_feature("nn.features", feature)


@dataclass(frozen=True, kw_only=True)
class NNConfig(NNKeys, Part):
    """How the neural network is made and trained; see quadexp/models/neural.py."""


@dataclass(frozen=True, kw_only=True)
class DragConfig(Part):
    """How linear drag is fitted; see quadexp/models/linear_drag.py."""

    prefix: ClassVar[str] = "drag."

    intercept: Annotated[bool, Setting("fit a constant acceleration in addition to the drag")] = True
    thrust: Annotated[bool, Setting("fit an error of the collective thrust, as a share, on the z axis")] = True
    loss: Annotated[
        Literal["huber", "squares"],
        Setting("Huber's, which the few fastest rows do not bend, or least squares as published"),
    ] = "huber"
    holdout: Annotated[float, HOLDOUT] = 0.2
    seed: Annotated[int, Setting("draws the held-out flights", SEEDS)] = 0
