"""The command `quadexp reproduce`. Only light modules are imported at the top."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from quadexp.cli.command import Answer, Ask, Force, OptionalOut, command
from quadexp.errors import UsageError
from quadexp.names import without
from quadexp.plugin import brought, places

HEADING = "Learn"


@command
def reproduce(
    name: Annotated[str, Ask("Name of a public benchmark: nanodrone.", "NAME")],
    data: Annotated[Path | None, Ask("Folder of its data, which you have to fetch.", "DIR")] = None,
    out: OptionalOut = None,
    force: Force = False,
) -> Answer:
    """Predict a public benchmark's flights by its own protocol, beside the published figures.

    nanodrone: Busetto et al. 2026, 50 steps ahead from every sample. Two models of this program, one of them blind to
    the motors, are fitted to its training flights. With --out the submission is written, which says which data were
    looked at. The folder has the benchmark's train/ and test/ (docs/nanodrone.md says where they are).

    \b
    quadexp reproduce nanodrone --data nanodrone --out results/nanodrone
    """
    run = brought("benchmarks", name)
    if run is None:
        raise UsageError(f"reproduce: {name!r} is no benchmark, there is {', '.join(places('benchmarks'))}")
    report = run(data, out, force=force)
    lines = report["lines"]
    if out:
        lines = [*lines, out]
    return Answer(without(report, ("lines",)), report["rows"], lines)
