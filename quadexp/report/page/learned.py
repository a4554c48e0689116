"""What was learned: the residual models of the checkpoints that flew, drawn with the data they were fitted to."""

from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path

from quadexp.errors import DataError, QuadexpError, UsageError
from quadexp.log.outcome import UNFLOWN
from quadexp.models.checkpoint import MODEL_FILE, load_model, load_report
from quadexp.models.dataset import ResidualDataset, read_dataset
from quadexp.models.gaussian_process import GPModel
from quadexp.report.model_figures import fit_figure
from quadexp.report.page.sheet import Sheet, sheet_name
from quadexp.report.page.source import Comparison
from quadexp.report.summary import held_out_rows, held_out_table


def fit_sheets(comparison: Comparison) -> list[Sheet]:
    """One for each checkpoint that flew."""
    flown: dict[str, str] = {}
    for row in comparison.rows:
        if row["model"] and row["model"] not in flown and row["outcome"] not in UNFLOWN:
            flown[row["model"]] = (comparison.flight_record(row) or {}).get("model_sha256", "")
    return [fit_sheet(path, sha256) for path, sha256 in flown.items()]


def fit_sheet(path: str, sha256: str) -> Sheet:
    """The checkpoint, if its file is still the one that flew: its curves, if its data are there, and its scores."""
    name, title = sheet_name("residuals", path), f"Residuals in {path.rstrip('/')}"
    try:
        if hashlib.sha256((Path(path) / MODEL_FILE).read_bytes()).hexdigest() != sha256:
            return Sheet(name, title, {}, text="Not drawn: another model lies there now, not the one that flew.")
        model = load_model(path)
    except (OSError, UsageError, DataError):
        return Sheet(name, title, {}, text="Not drawn: it is not there any more.")
    scores = held_out_table(held_out_rows(path))
    if not isinstance(model, GPModel):
        return Sheet(name, title, {}, text=f"Not drawn: its kind is {model.kind}.", scores=scores)
    outputs = "; ".join(f"{o.output} from {', '.join(o.features)}, {len(o.alpha)} points" for o in model.outputs)
    text = f"Acceleration that the rigid body does not explain: {outputs}."
    if (data := _data(path, model)) is None:
        return Sheet(name, title, {}, text=f"{text} Not drawn: the data it was fitted to are not there.", scores=scores)
    text += f" Fitted to {data.n_rows} samples of {model.dataset.get('flights')} flights."
    return Sheet(name, title, {}, text=text, scores=scores, whole=partial(fit_figure, model, data))


def _data(path: str, model: GPModel) -> ResidualDataset | None:
    """The samples that the model was fitted to, if the file is unchanged."""
    try:
        data = read_dataset(load_report(path)["dataset"])
    except (KeyError, TypeError, QuadexpError):
        return None
    return data if data.sha256 == model.dataset.get("sha256") else None
