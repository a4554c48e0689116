"""The command `quadexp archive`. Only light modules are imported at the top."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from quadexp.cli.command import Answer, Ask, Force, Out, command

HEADING = "Look"


@command
def archive(
    results: Annotated[Path, Ask("A folder of `quadexp evaluate --sweep`.", "DIR")],
    out: Out = Path("archive.zip"),
    force: Force = False,
) -> Answer:
    """Pack a sweep to fly it again elsewhere: settings, your parts, models, versions, hashes, tables and figures.

    The README inside has the commands that check the files, fly the sweep again and compare the numbers.

    \b
    quadexp archive results/table1 --out table1.zip
    """
    from quadexp.plugins.archive.archive import write_archive

    archived = write_archive(results, out, force=force)
    rows = [{"file": name, "bytes": size} for name, size in archived.items()]
    return Answer({"path": out, "files": archived}, rows, [f"{len(archived)} files", out])
