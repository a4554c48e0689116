"""`quadexp archive`, `show --cite` and `results --verify`. Only light modules are imported at the top."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from quadexp.cli.command import Answer, Ask, Conf, Force, Out, command
from quadexp.progress import Progress

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


def cite(
    path: Annotated[Path, Ask("A flight, or results.")],
    cite: Annotated[bool, Ask("BibTeX of the methods that flew, and of this program.")] = False,
    conf: Conf = (),
) -> Answer:
    """\b
    quadexp show --cite results/table1
    """
    from quadexp.plugins.archive.cite import bibtex

    text = bibtex(path, conf)
    return Answer({"bibtex": text}, [{"bibtex": text}], text.splitlines())


def verify(
    folder: Annotated[Path, Ask("A folder of `quadexp evaluate`.", "DIR")],
    verify: Annotated[bool, Ask("Read every file and list those that were changed since they were written.")] = False,
) -> Answer:
    """--verify compares every flight and table with its hashes, rows with their flights, and texts with their rows;
    exit code 1 if something is wrong. The next run of the sweep flies such cells again and writes such tables again.

    \b
    quadexp results results/table1 --verify
    """
    from quadexp.plugins.archive.verify import verify_results

    with Progress("files") as progress:
        checked = verify_results(folder, progress)
    count = len(checked.wrong)
    rows = [{"file": path, "what": what} for path, what in checked.wrong.items()]
    lines = [f"{path}: {what}" for path, what in checked.wrong.items()]
    lines += [f"{path}: is not there, and was not compared" for path in checked.missing]
    return Answer(
        {"files": checked.files, "wrong": checked.wrong, "missing": checked.missing},
        rows or [{"files": checked.files, "wrong": 0}],
        [*lines, f"{checked.files} files, {count} wrong"],
        failed=[f"{folder}: {count} files have changed since they were written"] if count else [],
    )
