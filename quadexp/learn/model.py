"""A fitted Gaussian process: settings, posterior of each output, and the model of all outputs.

Posterior of one output at features z, in physical units, with e_j = exp(-1/2 sum_i ((z_i - Z_ji) / l_i)^2):

    mean(z)     = sum_j alpha_j e_j + prior mean(z)
    variance(z) = sigma_f^2 - ||F e||^2             of the function; add sigma_n^2 for a new measurement

Kernel: Torrente et al. 2021, eq. 8; posterior: Titsias 2009, eqs 6 and 10. numpy only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.learn.linear_drag import LinearDrag
from quadexp.learn.term_mean import TermMean
from quadexp.physics.correction import OUTPUTS

if TYPE_CHECKING:
    from quadexp.air.terms import TermStructure

METHODS = ("sgpr", "subset", "exact")
MEANS = ("zero", "constant", "linear_drag", "quadratic", "blade_element")
SPLITS = ("flight", "sample")
INDUCING_RANGE = (2, 1000)
DEFAULT_FEATURES = {"a_x": ("v_x",), "a_y": ("v_y",), "a_z": ("v_z", "thrust")}


@dataclass(frozen=True)
class GPSettings:
    """How the Gaussian processes are fitted; the keys of the `gp` configuration group.

    features: output -> feature names (B_z); an output that is absent, or has none, is not corrected (B_d).
    inducing: inducing points per output. method: "sgpr" (variational bound, all rows), "subset" (exact GP on `inducing`
        chosen rows), "exact" (exact GP on every row, up to max_exact_rows). mean: prior mean of the accelerations.
    max_rows: use at most that many rows, drawn by the seed. holdout: share of the flights held out for the report.
    refit: whether the final model is fitted to the held-out flights too, after the report on them.
    max_iterations: L-BFGS iterations of the last stage. jitter: added to K_ZZ, relative to sigma_f^2.
    split: what the report holds out: "flight", or "sample" (for comparison; underestimates the error).
    """

    features: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: dict(DEFAULT_FEATURES))
    inducing: int = 20
    method: str = "sgpr"
    mean: str = "zero"
    seed: int = 0
    max_rows: int | None = None
    max_exact_rows: int = 1000
    holdout: float = 0.2
    refit: bool = True
    max_iterations: int = 100
    jitter: float = 1e-8
    split: str = "flight"

    def __post_init__(self) -> None:
        chosen = {output: tuple(names) for output, names in self.features.items() if names}
        object.__setattr__(self, "features", chosen)
        if not chosen:
            raise UsageError("gp.features: no output has a feature; name some, e.g. gp.features.a_x=[v_x]")
        for output, names in chosen.items():
            if output not in OUTPUTS:
                raise UsageError(f"gp.features.{output}: no such output; allowed are {', '.join(OUTPUTS)}")
            if len(set(names)) < len(names):
                raise UsageError(f"gp.features.{output}: {', '.join(names)} names a feature twice")
        for key, allowed in (("method", METHODS), ("mean", MEANS), ("split", SPLITS)):
            if getattr(self, key) not in allowed:
                raise UsageError(f"gp.{key}: '{getattr(self, key)}' is none of {', '.join(allowed)}")
        low, high = INDUCING_RANGE
        if not low <= self.inducing <= high:
            raise UsageError(f"gp.inducing: {self.inducing} is outside {low}..{high} (5..100 suits a control step)")
        if not 0 <= self.holdout < 1:
            raise UsageError(
                f"gp.holdout: {self.holdout:g} is outside [0, 1), the share of flights held out of the fit"
            )
        if self.max_rows is not None and self.max_rows < 10:
            raise UsageError(f"gp.max_rows: {self.max_rows} is below 10")
        if not 0 < self.jitter <= 1e-6:
            raise UsageError(f"gp.jitter: {self.jitter:g} is outside (0, 1e-6]")

    def as_dict(self) -> dict[str, Any]:
        record = asdict(self) | {"features": {output: list(names) for output, names in self.features.items()}}
        if self.split == "flight":
            del record["split"]
        return record


@dataclass(frozen=True)
class OutputPosterior:
    """Posterior of one output (equations: see the module); has the fields of quadexp.air.gaussian_process.GPOutput.

    output: a name in OUTPUTS, its unit is m/s^2 or N m. features: d names.
    inducing: (M, d), lengthscale: (d,), in the features' units. alpha: (M,), in the output's unit.
    signal_variance, noise_variance: in the output's unit squared.
    variance_factor: F, (M, M), upper triangular, in the output's unit (F'F would lose half the digits).
    bound: log marginal likelihood, or its variational lower bound, per row, in the output's unit.
    """

    output: str
    features: tuple[str, ...]
    inducing: np.ndarray
    alpha: np.ndarray
    lengthscale: np.ndarray
    signal_variance: float
    noise_variance: float
    variance_factor: np.ndarray
    bound: float
    rows: int


@dataclass(frozen=True)
class GPModel:
    """Gaussian processes of one or more outputs, and linear drag fitted to the same rows.

    mean: prior mean of the accelerations (terms, or LinearDrag, without drag for a constant), or None for zero; torque
        outputs have prior mean zero.
    linear_drag: the RDRv baseline, fitted to the same rows. vehicle: {name, fingerprint}. dataset: hash, rows, flights.
    feature_range: of the rows, see quadexp.learn.support. versions: library -> version.
    """

    outputs: tuple[OutputPosterior, ...]
    mean: LinearDrag | TermMean | None
    linear_drag: LinearDrag
    vehicle: dict[str, Any]
    dataset: dict[str, Any]
    settings: dict[str, Any]
    feature_range: dict[str, list[float]]
    versions: dict[str, str] = field(default_factory=dict)

    @property
    def mean_parameters(self) -> np.ndarray | None:
        """Prior mean for quadexp.air.gaussian_process.gaussian_process_residual: (p,) or None."""
        return None if self.mean is None else self.mean.parameters

    @property
    def mean_terms(self) -> TermStructure | None:
        """Terms of the prior mean, None where it is linear drag or zero."""
        return getattr(self.mean, "structure", None)
