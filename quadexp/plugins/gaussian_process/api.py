"""What this plug-in adds to the Python API."""

from __future__ import annotations

from typing import Any

from quadexp.api import OverrideLike, fit
from quadexp.frames import Checkpoint, Dataset
from quadexp.parts.options import Place


def fit_gp(data: Place | Dataset, *settings: OverrideLike, **keywords: Any) -> Checkpoint:
    """Fit Gaussian processes, and linear drag to the same rows: fit("gaussian_process", data, ...)."""
    return fit("gp", data, *settings, **keywords)
