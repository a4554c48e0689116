"""Commands that learn from flights: `quadexp collect`, `fit`. Only light modules are imported at the top."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from quadexp.cli.command import Answer, Ask, Command, Conf, Force, Out, Overrides, command, single_values
from quadexp.names import SPELLINGS
from quadexp.progress import Progress

HEADING = "Learn"


# ----------------------------------------------------------------------------------------------------------------- fits
@command
def collect(
    overrides: Overrides = (),
    out: Out = Path("data/residuals.parquet"),
    flight: Annotated[tuple[Path, ...], Ask("Use this flight, not new ones; repeatable.", "PATH", "--flight")] = (),
    save_flights: Annotated[Path | None, Ask("Write the flights too.", "DIR")] = None,
    sweep: Annotated[bool, Ask("Fly in every combination of the worlds given, one after another.")] = False,
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Fly random paths, or take recorded flights, and write the residual: what the rigid body does not explain.

    \b
    quadexp collect plant=simplified collect.duration=300 --out data/residuals.parquet
    quadexp collect --flight runs/a.parquet --flight runs/b.parquet --out data/mine.parquet
    quadexp collect --sweep wind=constant wind.velocity=[0,0,0],[4,0,0] truth.mass=1,1.2 --out data/worlds.parquet
    """
    from quadexp import requests

    with Progress("seconds of flight") as progress:
        report = requests.collect(
            overrides, out, conf, flights=flight, save_flights=save_flights, sweep=sweep, force=force, progress=progress
        )
    return Answer(report, [single_values(report)], [*report["lines"], out])


DataSet = Annotated[Path, Ask("Data set of `quadexp collect`.", "DATASET")]
After = Annotated[Path | None, Ask("Fit what this checkpoint leaves, for a sum of the two.")]


def _models(context: typer.Context, incomplete: str) -> list[str]:
    from quadexp.parts.options import groups

    options = groups(context.params.get("conf"))["model"]
    return [option for option in options if option.startswith(incomplete)]


FitFigures = Annotated[bool, Ask("Draw the fit.", flag="--figures/--no-figures")]
FIT_OUT = Ask("Where to write; models/MODEL unless given.", "PATH", "--out -o")


@command
def fit(
    model: Annotated[str, Ask("An option of the group `model`.", "MODEL", complete=_models)],
    dataset: DataSet,
    overrides: Overrides = (),
    out: Annotated[Path | None, FIT_OUT] = None,
    figures: FitFigures = True,
    after: After = None,
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Fit a model of the air to a data set and write the checkpoint.

    \b
    quadexp fit linear_drag data/residuals.parquet --out models/drag
    quadexp fit linear_drag data/residuals.parquet model.loss=squares model.thrust=false --out models/published
    """
    return _fit(model, dataset, overrides, out, figures, after, conf, force)


def _fit(
    model: str, dataset: Path, overrides: Sequence[str], out: Path | None, figures: bool, after: Path | None,
    conf: Sequence[Path], force: bool,
) -> Answer:  # fmt: skip
    from quadexp import requests

    place = out or Path("models") / model
    with Progress("fit") as progress:
        report = requests.fit(
            model, dataset, overrides, place, conf, force=force, progress=progress, figures=figures, after=after
        )
    return Answer(report, report["rows"], [*report["lines"], place])


def fit_spelling(word: str) -> Command:
    """`quadexp fit-WORD`, another spelling of `quadexp fit`."""

    def fit_word(
        dataset: DataSet,
        overrides: Overrides = (),
        out: Annotated[Path | None, FIT_OUT] = None,
        figures: FitFigures = True,
        after: After = None,
        conf: Conf = (),
        force: Force = False,
    ) -> Answer:
        return _fit(word, dataset, overrides, out, figures, after, conf, force)

    fit_word.__name__ = f"fit_{word}"
    fit_word.__doc__ = (
        f"Fit {SPELLINGS[word]}: `quadexp fit {SPELLINGS[word]}`.\n\n"
        f"\b\nquadexp fit-{word} data/residuals.parquet --out models/{word}"
    )
    return command(fit_word)


fit_drag = fit_spelling("drag")
