"""`quadexp options`: what there is to choose and to set. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

from typing import Annotated

import typer

from quadexp.cli.options import Conf, Format, Json
from quadexp.cli.terminal import answered, format_of, guarded, print_lines


@guarded
def options(
    asked: Annotated[
        str, typer.Argument(metavar="[GROUP | GROUP=OPTION | WORD]", help="A group, an option, or a word to look for.")
    ] = "",
    conf: Conf = None,
    format: Format = None,
    json: Json = False,
) -> None:
    """What there is to choose: groups, options, and the keys of an option with value, range, unit and meaning.

    \b
    quadexp options
    quadexp options wind
    quadexp options wind=gust
    quadexp options delay
    """
    from quadexp.parts.listing import listed
    from quadexp.parts.plugins import import_from

    form = format_of(format, json)
    if conf is not None:
        import_from(conf.resolve())
    records = listed(asked, conf)
    if answered(form, {"asked": asked, "found": records}, lambda: records, "options"):
        return
    first = max((len(next(iter(one.values()))) for one in records), default=0)
    for one in records:
        name, *rest = one.values()
        if "key" in one:
            rest = [f"{one['value']:12s}", f"{one['allowed']:18s}", one["meaning"]]
        print_lines(["  ".join([f"{name:{min(first, 34)}s}", *rest]).rstrip()])
