"""Commands that fly: `quadexp simulate`, `evaluate`. Only light modules are imported at the top."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from quadexp.cli.command import Answer, Ask, Conf, Force, OptionalOut, Overrides, command
from quadexp.cli.terminal import say
from quadexp.errors import UsageError
from quadexp.progress import Progress

HEADING = "Fly"


@command
def simulate(overrides: Overrides = (), out: OptionalOut = None, conf: Conf = (), force: Force = False) -> Answer:
    """Fly one configuration and write the flight.

    \b
    quadexp simulate controller=nominal_mpc trajectory=circle trajectory.speed=8 seed=0 --out runs/a.parquet
    """
    from quadexp import requests
    from quadexp.report.summary import flight_lines

    flight, path, notes = requests.simulate(overrides, out, conf, force=force, keep=True)
    about = flight.metadata
    record = {"path": path, **about["row"], "residual": about["residual"]}
    return Answer(record, [{**about["row"], "path": path}], [*flight_lines(about), path], notes)


Sweep = Annotated[bool, Ask("Fly every combination of the values given.", flag="--sweep --multirun -m")]
Figures = Annotated[bool | None, Ask("Draw figures (default: only for a sweep).", flag="--figures/--no-figures")]
Refly = Annotated[bool, Ask("Fly cells of other sources again.")]
KeepOld = Annotated[bool, Ask("Keep cells of other sources in the table.")]


@command
def evaluate(
    overrides: Overrides = (),
    sweep: Sweep = False,
    out: OptionalOut = None,
    figures: Figures = None,
    conf: Conf = (),
    refly: Refly = False,
    keep_old: KeepOld = False,
    force: Force = False,
) -> Answer:
    """Fly one cell, or every cell of a sweep, and write the table of results.

    An interrupted sweep continues where it stopped; a finished one only prints its table. If cells were flown by
    another version of the program's sources, the command stops and asks for --keep-old or --refly.

    \b
    quadexp evaluate --sweep trajectory=circle,lemniscate trajectory.speed=4,8,12 \\
        controller=nominal_mpc,linear_drag_mpc,perfect_mpc seed='range(3)' --out results/table1
    quadexp evaluate --sweep controller='nominal_mpc,perfect_mpc horizon=firm' trajectory=circle
    """
    return evaluated(overrides, sweep, out, figures, conf, refly, keep_old, force)


def evaluated(
    overrides: Sequence[str], sweep: bool, out: Path | None, figures: bool | None, conf: Sequence[Path], refly: bool,
    keep_old: bool, force: bool, watch: Callable[[Path, str], Any] | None = None,
) -> Answer:  # fmt: skip
    """What `quadexp evaluate` answers. watch: see requests.Evaluation."""
    from quadexp import requests

    if refly and keep_old:
        raise UsageError("--refly and --keep-old: give one of them")
    old: Literal["ask", "refly"] = "refly" if refly else "ask"
    asked = requests.Evaluation(
        overrides=overrides, out=out, conf=conf, sweep=sweep, figures=figures, old="keep" if keep_old else old,
        force=force, watch=watch,
    )  # fmt: skip
    swept = requests.evaluate(asked, lambda below: Progress("flights", below), say)
    result = swept.result
    metric = swept.metric
    record = {
        "out": swept.out,
        "files": swept.files,
        "flown": result.flown,
        "notes": result.notes,
        "not_flown": len(result.not_flown),
        "rows": list(result.rows),
        "statistics": result.statistics.record(metric),
    }

    def csv() -> str:
        from quadexp.report.statistics import statistics_csv

        return statistics_csv(result.statistics.of(metric))

    texts = {"csv": csv, "markdown": result.table.markdown, "latex": result.table.latex}
    invalid = (
        [f"{swept.invalid}; all of them: quadexp results {shlex.quote(str(swept.out))} --failures"]
        if swept.invalid
        else []
    )
    shown = swept.lines or [result.table]
    return Answer(record, [], [*shown, swept.out], [*swept.notes, *invalid], swept.failed, texts)
