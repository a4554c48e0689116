"""`quadexp validate`: models against flights that they were not fitted to. Only light modules are imported here."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from quadexp.cli.command import Answer, Ask, command
from quadexp.cli.options import Conf, Force
from quadexp.errors import UsageError


@command
def validate(
    arguments: Annotated[
        list[str], Ask("Folders of `quadexp identify`, `fit-gp` or `fit-drag`.", "MODEL... [KEY=VALUE...]")
    ],
    flights: Annotated[list[Path] | None, Ask("Flights to predict; several may follow.", "FLIGHT...")] = None,
    horizons: Annotated[str, Ask("Horizons of the open-loop predictions (s).", "S,S,...")] = "0.1,0.5,1",
    leave_one_out: Annotated[bool, Ask("Predict each flight by models refitted to all the others.")] = False,
    out: Annotated[Path | None, Ask("Write report and figures there.", "DIR", "--out -o")] = None,
    figures: Annotated[bool, Ask("Draw figures (with --out).", flag="--figures/--no-figures")] = True,
    conf: Conf = None,
    force: Force = False,
) -> Answer:
    """Compare what models predict with what flights did: sample by sample, and open loop from many start points.

    The vehicle is the flights' own unless vehicle=NAME is given.

    \b
    quadexp validate models/crazyflie models/gp --flights flights/c.parquet --out results/validation
    quadexp validate models/crazyflie --flights flights/a.parquet flights/b.parquet flights/c.parquet --leave-one-out
    """
    from quadexp.experiment.validate import validate as compare
    from quadexp.experiment.vehicle_of import config_for
    from quadexp.progress import Progress

    overrides = [text for text in arguments if "=" in text]
    paths = [Path(text) for text in arguments if "=" not in text]
    tested = [*(flights or []), *(path for path in paths if path.suffix == ".parquet")]
    models = [path for path in paths if path.suffix != ".parquet"]
    if not tested:
        raise UsageError("validate: no flight given; add --flights FLIGHT...")
    try:
        seconds = [float(text) for text in horizons.split(",")]
    except ValueError:
        raise UsageError(f"--horizons: '{horizons}' must be numbers of seconds with commas between") from None
    config = config_for(tested, overrides, conf)
    with Progress("validate") as progress:
        report = compare(
            models, tested, config, horizons=seconds, leave_one_out=leave_one_out, out=out, figures=figures,
            force=force, progress=progress,
        )  # fmt: skip
    record = {key: value for key, value in report.items() if key != "lines"}
    return Answer(record, report["rows"], [*report["lines"], *([out] if out else [])])
