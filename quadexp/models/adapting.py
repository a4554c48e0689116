"""A model that is linear in some of its parameters: which adapt in flight, and their prior."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadexp.errors import UsageError
from quadexp.models.residual import Residual

TYPICAL_SPEED = 8.0  # m/s


@dataclass(frozen=True)
class Block:
    """Weights of one component of the acceleration.

    axis: 0, 1, 2. at: places of the weights in theta, (h,). mean: a_0, (h,). root: R, (h, h). signal_variance: prior
    variance of the function, s^2 (m^2/s^4), where its weights do not determine all of it (FITC); 0 where they do.
    """

    axis: int
    at: np.ndarray
    mean: np.ndarray
    root: np.ndarray
    signal_variance: float = 0.0

    @property
    def size(self) -> int:
        """Numbers of its belief, b and P."""
        return len(self.at) * (len(self.at) + 1)


@dataclass(frozen=True)
class Adapting:
    """residual: with the prior mean as theta. blocks: its weights, at most one block for each component."""

    residual: Residual
    blocks: tuple[Block, ...]

    def __post_init__(self) -> None:
        if not self.blocks:
            raise UsageError("a model that adapts in flight needs a_x, a_y or a_z among its outputs")
