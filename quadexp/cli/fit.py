"""Commands that fit a data set: `quadexp fit-gp`, `fit-drag` and `fit-nn`. Only light modules are imported here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp.cli.command import Answer, Ask, command
from quadexp.cli.options import Conf, Force, Out, Overrides

DataSet = Annotated[Path, typer.Argument(help="Data set of `quadexp collect`.")]
After = Annotated[Path | None, Ask("Checkpoint that explains a part; the rest is fitted, for a sum of the two.")]
Figures = Annotated[bool, Ask("Draw the fit.", flag="--figures/--no-figures")]


@command
def fit_gp(
    dataset: DataSet,
    overrides: Overrides = None,
    out: Out = Path("models/gp"),
    figures: Figures = True,
    after: After = None,
    conf: Conf = None,
    force: Force = False,
) -> Answer:
    """Fit Gaussian processes to a data set and write the checkpoint.

    \b
    quadexp fit-gp data/residuals.parquet --out models/gp
    quadexp fit-gp data/residuals.parquet gp=per_axis gp.inducing=40 --out models/gp40
    """
    return _fit("gp", dataset, overrides, out, conf, force, figures=figures, after=after)


@command
def fit_drag(
    dataset: DataSet,
    overrides: Overrides = None,
    out: Out = Path("models/drag"),
    conf: Conf = None,
    force: Force = False,
) -> Answer:
    """Fit linear rotor drag to a data set and write the checkpoint.

    \b
    quadexp fit-drag data/residuals.parquet --out models/drag
    """
    return _fit("drag", dataset, overrides, out, conf, force)


@command
def fit_nn(
    dataset: DataSet,
    overrides: Overrides = None,
    out: Out = Path("models/nn"),
    after: After = None,
    conf: Conf = None,
    force: Force = False,
) -> Answer:
    """Fit a neural network to a data set and write the checkpoint.

    \b
    quadexp fit-nn data/residuals.parquet --out models/nn
    quadexp fit-nn data/residuals.parquet nn.hidden=[24,24] nn.spectral=8 --out models/nn24
    """
    return _fit("nn", dataset, overrides, out, conf, force, after=after)


def _fit(
    kind: str, dataset: Path, overrides: list[str] | None, out: Path, conf: Path | None, force: bool, **options: Any
) -> Answer:
    from quadexp.experiment.fit import fit_checkpoint
    from quadexp.files.writer import check_output
    from quadexp.parts.compose import compose
    from quadexp.progress import Progress

    config = compose(overrides or [], conf)
    path = check_output(out, force=force, folder=True)
    with Progress("fit") as progress:
        report = fit_checkpoint(kind, config, dataset, path, force=force, progress=progress, **options)
    return Answer(report, report["rows"], [*report["lines"], path])
