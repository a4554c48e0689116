"""A fitted model as the API hands it out."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from quadexp.errors import UsageError
from quadexp.messages import html
from quadexp.models.checkpoint import load_model, load_report


class Checkpoint:
    """A checkpoint folder; goes wherever a path does: qx.simulate("controller=gp_mpc", model=checkpoint).

    path: the folder. model: what was fitted (quadexp/models/base.py). report: what the fit says of flights that it has
    not seen.
    """

    def __init__(self, path: str | os.PathLike[str], folder: Any = None) -> None:
        self.path = Path(path)
        self.model, self.report = load_model(self.path), load_report(self.path)
        self._folder = folder  # a temporary one lives as long as this object

    def __fspath__(self) -> str:
        return str(self.path)

    def predict(self, data: pd.DataFrame) -> pd.DataFrame:
        """Mean and standard deviation of the residual at every row of `data`, which has the features as columns.

        Columns a_x .. (body, m/s^2), tau_x .. (body, N m), as far as the model has them, and a_x_std ..; of linear
        drag and networks the means alone. Raises DataError where a feature is missing, UsageError for an identified
        vehicle.
        """
        from quadexp.models.dataset import ResidualDataset

        rows = ResidualDataset({str(name): data[name].to_numpy() for name in data}, {})
        made: dict[str, np.ndarray] = {}
        try:
            predictions = self.model.predict(rows)
        except UsageError as error:
            raise UsageError(f"{self.path}: {error}") from None
        for output, found in predictions.items():
            made |= {output: found.mean} | ({} if found.variance is None else {f"{output}_std": found.std})
        return pd.DataFrame(made, index=data.index)

    def plot(self, data: pd.DataFrame) -> Any:
        """A matplotlib figure: the Gaussian processes over their features, with the rows of `data`."""
        from quadexp.models.dataset import ResidualDataset
        from quadexp.models.gaussian_process import GPModel
        from quadexp.report.model_figures import fit_figure

        if not isinstance(self.model, GPModel):
            raise UsageError(f"{self.path}: holds no Gaussian processes to draw")
        rows = ResidualDataset({str(name): data[name].to_numpy() for name in data}, {})
        return fit_figure(self.model, rows)

    def summary(self) -> list[str]:
        """Kind, vehicle, data, outputs and range of validity, in a few lines."""
        from quadexp.report.summary import summarise

        lines = list(summarise(self.path)["lines"])
        return lines if self._folder is None else [lines[0].replace(str(self.path), "not saved"), *lines[1:]]

    def __repr__(self) -> str:
        return "\n".join(self.summary())

    def _repr_html_(self) -> str:
        return f"<pre>{html(chr(10).join(self.summary()))}</pre>"
