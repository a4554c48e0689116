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

from quadexp.config.learning import GPKeys
from quadexp.errors import UsageError
from quadexp.learn.linear_drag import LinearDrag
from quadexp.learn.term_mean import TermMean
from quadexp.physics.correction import OUTPUTS

if TYPE_CHECKING:
    from quadexp.air.terms import TermStructure

DEFAULT_FEATURES = {"a_x": ("v_x",), "a_y": ("v_y",), "a_z": ("v_z", "thrust")}


@dataclass(frozen=True)
class GPSettings(GPKeys):
    """How the Gaussian processes are fitted (see GPKeys for the keys of the `gp` configuration group).

    features: output -> feature names (B_z); an output that is absent, or has none, is not corrected (B_d).
    """

    features: Mapping[str, tuple[str, ...]] = field(default_factory=lambda: dict(DEFAULT_FEATURES))

    def __post_init__(self) -> None:
        super().__post_init__()
        chosen = {output: tuple(names) for output, names in self.features.items() if names}
        object.__setattr__(self, "features", chosen)
        if not chosen:
            raise UsageError("gp.features: no output has a feature; name some, e.g. gp.features.a_x=[v_x]")
        for output, names in chosen.items():
            if output not in OUTPUTS:
                raise UsageError(f"gp.features.{output}: no such output; allowed are {', '.join(OUTPUTS)}")
            if len(set(names)) < len(names):
                raise UsageError(f"gp.features.{output}: {', '.join(names)} names a feature twice")

    def as_dict(self) -> dict[str, Any]:
        record = {"features": {output: list(names) for output, names in self.features.items()}}
        record = record | {name: value for name, value in asdict(self).items() if name not in record}
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
