"""Random states for property-like tests."""

from __future__ import annotations

import numpy as np


def random_state(rng: np.random.Generator, *, speed: float = 6.0, rate: float = 3.0) -> np.ndarray:
    """Any state: random attitude, velocity and rate."""
    q = rng.normal(size=4)
    return np.concatenate(
        [rng.normal(size=3), q / np.linalg.norm(q), speed * rng.normal(size=3), rate * rng.normal(size=3)]
    )
