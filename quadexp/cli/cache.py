"""`quadexp cache`: what is kept between runs. Only light modules are imported here; see cli/app.py."""

from __future__ import annotations

from typing import Annotated

from quadexp.cli.command import Answer, Ask, command


@command
def cache(clear: Annotated[bool, Ask("Remove all of it; it is made again when needed.")] = False) -> Answer:
    """Show, or clear, the folder of compiled functions and composed options.

    It is QUADEXP_CACHE, or else the user's cache folder. Compiled functions that were not used for longest go first.

    \b
    quadexp cache
    quadexp cache --clear
    """
    from quadexp.files import cache as kept

    folder = kept.cache_folder()
    if clear:
        kept.clear(folder)
    sizes = [about.st_size for about in kept.libraries(folder).values()]
    record = {"folder": folder.path, "libraries": len(sizes), "bytes": sum(sizes), "bound": kept.BOUND}
    full = f"{sum(sizes) / 1e6:.1f} of at most {kept.BOUND / 1e6:.0f} MB"
    return Answer(record, [record], [f"{len(sizes)} compiled functions, {full}", folder.path])
