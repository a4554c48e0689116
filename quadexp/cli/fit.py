"""Commands that fit a data set: `quadexp fit-gp`, `fit-drag` and `fit-nn`. Only light modules are imported here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from quadexp.cli.options import Conf, Force, Format, Json, Out, Overrides
from quadexp.cli.terminal import answered, format_of, guarded, print_lines

DataSet = Annotated[Path, typer.Argument(help="Data set of `quadexp collect`.")]
After = Annotated[
    Path | None,
    typer.Option("--after", help="Checkpoint that explains a part; the rest is fitted, for a sum of the two."),
]


@guarded
def fit_gp(
    dataset: DataSet,
    overrides: Overrides = None,
    out: Out = Path("models/gp"),
    figures: Annotated[bool, typer.Option("--figures/--no-figures", help="Draw the fit.")] = True,
    after: After = None,
    conf: Conf = None,
    force: Force = False,
    format: Format = None,
    json: Json = False,
) -> None:
    """Fit Gaussian processes to a data set and write the checkpoint.

    \b
    quadexp fit-gp data/residuals.parquet --out models/gp
    quadexp fit-gp data/residuals.parquet gp=per_axis gp.inducing=40 --out models/gp40
    """
    _fit("gp", dataset, overrides, out, conf, force, format_of(format, json), figures=figures, after=after)


@guarded
def fit_drag(
    dataset: DataSet,
    overrides: Overrides = None,
    out: Out = Path("models/drag"),
    conf: Conf = None,
    force: Force = False,
    format: Format = None,
    json: Json = False,
) -> None:
    """Fit linear rotor drag to a data set and write the checkpoint.

    \b
    quadexp fit-drag data/residuals.parquet --out models/drag
    """
    _fit("drag", dataset, overrides, out, conf, force, format_of(format, json))


@guarded
def fit_nn(
    dataset: DataSet,
    overrides: Overrides = None,
    out: Out = Path("models/nn"),
    after: After = None,
    conf: Conf = None,
    force: Force = False,
    format: Format = None,
    json: Json = False,
) -> None:
    """Fit a neural network to a data set and write the checkpoint.

    \b
    quadexp fit-nn data/residuals.parquet --out models/nn
    quadexp fit-nn data/residuals.parquet nn.hidden=[24,24] nn.spectral=8 --out models/nn24
    """
    _fit("nn", dataset, overrides, out, conf, force, format_of(format, json), after=after)


def _fit(
    kind: str,
    dataset: Path,
    overrides: list[str] | None,
    out: Path,
    conf: Path | None,
    force: bool,
    form: str,
    **options: Any,
) -> None:
    from quadexp.experiment.fit import fit_checkpoint
    from quadexp.files.writer import check_output
    from quadexp.parts.compose import compose
    from quadexp.progress import Progress

    config = compose(overrides or [], conf)
    path = check_output(out, force=force, folder=True)
    with Progress("fit") as progress:
        report = fit_checkpoint(kind, config, dataset, path, force=force, progress=progress, **options)
    if answered(form, report, lambda: report["rows"], f"fit-{kind}"):
        return
    print_lines([*report["lines"], path])
