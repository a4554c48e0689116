"""`quadexp options`: what there is to choose and to set. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

from typing import Annotated

import typer

from quadexp.cli.command import Answer, command
from quadexp.cli.options import Conf


@command
def options(
    asked: Annotated[
        str, typer.Argument(metavar="[GROUP | GROUP=OPTION | WORD]", help="A group, an option, or a word to look for.")
    ] = "",
    conf: Conf = None,
) -> Answer:
    """What there is to choose: groups, options, and the keys of an option with value, range, unit and meaning.

    \b
    quadexp options
    quadexp options wind
    quadexp options wind=gust
    quadexp options delay
    """
    from quadexp.parts.listing import listed
    from quadexp.parts.plugins import import_from

    if conf is not None:
        import_from(conf.resolve())
    records = listed(asked, conf)
    first = max((len(next(iter(one.values()))) for one in records), default=0)
    lines = []
    for one in records:
        name, *rest = one.values()
        if "key" in one:
            rest = [f"{one['value']:12s}", f"{one['allowed']:18s}", one["meaning"]]
        lines.append("  ".join([f"{name:{min(first, 34)}s}", *rest]).rstrip())
    return Answer({"asked": asked, "found": records}, records, lines)
