"""What this plug-in adds to the Python API."""

from __future__ import annotations

from typing import Any

from quadexp.api import OverrideLike, fit
from quadexp.frames import Checkpoint, Dataset
from quadexp.parts.options import Place


def fit_nn(data: Place | Dataset, *settings: OverrideLike, **keywords: Any) -> Checkpoint:
    """Fit a neural network: fit("neural", data, ...)."""
    return fit("nn", data, *settings, **keywords)
