"""Settings of the fits: Gaussian processes, neural network, linear drag. Nothing heavy is imported here."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import ClassVar, Literal

from quadexp.errors import UsageError
from quadexp.parts.part import Part
from quadexp.parts.settings import SEEDS, Setting, Settings, declared, key

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

    a_x: tuple[str, ...] = key((), _features("a_x"))
    a_y: tuple[str, ...] = key((), _features("a_y"))
    a_z: tuple[str, ...] = key((), _features("a_z"))
    tau_x: tuple[str, ...] = key((), _features("tau_x"))
    tau_y: tuple[str, ...] = key((), _features("tau_y"))
    tau_z: tuple[str, ...] = key((), _features("tau_z"))

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

    inducing: int = key(20, "inducing points of an output", "[2, 1000]", "points")
    method: Literal["sgpr", "subset", "exact"] = key(
        "sgpr", "variational bound of Titsias 2009, exact GP on a subset as in the paper, or exact GP on all rows"
    )
    mean: Literal["zero", "constant", "linear_drag", "quadratic", "blade_element"] = key(
        "zero", "mean function under the GP"
    )
    seed: int = key(0, "seed of the choice of held-out flights and initial inducing points", SEEDS)
    max_rows: int | None = key(
        None, "largest number of rows, drawn at random; null: all rows", "[10, 10000000]", "rows"
    )
    max_exact_rows: int = key(1000, "largest number of rows for gp.method=exact", "[10, 100000]", "rows")
    holdout: float = key(0.2, HOLDOUT)
    refit: bool = key(True, "after the report, fit again to all flights")
    alternatives: bool = key(True, "where a fit is no better than drag, report what other features give")
    max_iterations: int = key(60, "largest number of L-BFGS iterations", "[1, 10000]")
    jitter: float = key(1e-8, "added to K_ZZ, relative to the signal variance", "(0, 1e-6]")


@dataclass(frozen=True, kw_only=True)
class GPConfig(GPKeys, Part):
    """How the Gaussian processes are fitted; see quadexp/models/gaussian_process.py."""

    features: GPFeatures = key(GPFeatures(), "features of every output")


@dataclass(frozen=True, kw_only=True)
class NNKeys(Settings):
    """How the neural network is made and trained; see quadexp/models/neural.py."""

    prefix: ClassVar[str] = "nn."

    features: tuple[str, ...] = key(("v_x", "v_y", "v_z", "thrust"), "features of all outputs")
    outputs: tuple[str, ...] = key(("a_x", "a_y", "a_z"), "outputs; the others are not corrected")
    hidden: tuple[int, ...] = key((16, 16), "units of every hidden layer", "[1, 1000]", "units")
    spectral: float | None = key(
        None, "largest slope of the scaled network, by spectral normalisation; null: no limit", "(0, 1000]"
    )
    max_iterations: int = key(400, "largest number of L-BFGS iterations", "[1, 100000]")
    penalty: float = key(
        1e-6, "penalty on every layer's mean square weight, relative to the outputs' mean square", "[0, 1]"
    )
    seed: int = key(0, "seed of held-out flights, first weights", SEEDS)
    device: Literal["auto", "cpu", "cuda"] = key("cpu", "where torch trains; auto: a CUDA device where there is one")
    holdout: float = key(0.2, HOLDOUT)
    refit: bool = key(True, "after the report, fit again to all flights")

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

    intercept: bool = key(True, "fit a constant acceleration in addition to the drag")
    thrust: bool = key(True, "fit an error of the collective thrust, as a share, on the z axis")
    loss: Literal["huber", "squares"] = key(
        "huber", "Huber's, which the few fastest rows do not bend, or least squares as published"
    )
    holdout: float = key(0.2, HOLDOUT)
    seed: int = key(0, "draws the held-out flights", SEEDS)
