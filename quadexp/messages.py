"""One line from a mistake: what may have been meant, and the telling part of a library's error."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence

# What OmegaConf says of a value of the wrong type.
_CONVERSION = re.compile(r"Value '(.*)' of type '[^']*' could not be converted to (\w+)$")
_KINDS = {"Float": "a number", "Integer": "a whole number", "Boolean": "true or false"}


def suggestion(found: str, known: Sequence[str], listed: Sequence[str] | None = None) -> str:
    """What may have been meant, or what there is."""
    near = _ending_in(found, known) or difflib.get_close_matches(found, known, n=1, cutoff=0.6)
    if near:
        return f"; did you mean {' or '.join(near)}?"
    names = sorted((set(known) if listed is None else set(listed)) - {"sweep"})
    return f"; there are: {', '.join(names[:16])}{', ...' if len(names) > 16 else ''}" if names else ""


def _ending_in(found: str, known: Sequence[str]) -> list[str]:
    """At most three dotted names whose last part is the one that was found: speed stands for trajectory.speed."""
    return [name for name in known if "." in name and name.rpartition(".")[2] == found][:3]


def one_line(error: BaseException) -> str:
    """One line from an error of Hydra or OmegaConf and its cause, the most telling part first."""
    parts = []
    for part in (error.__cause__, error):
        if part is None:
            continue
        lines = str(getattr(part, "msg", None) or part).strip().splitlines()
        wrong = _CONVERSION.match(lines[0]) if lines else None
        if wrong:
            kind = _KINDS.get(wrong[2], wrong[2])
            return f"{getattr(part, 'full_key', None) or 'value'}={wrong[1]}: must be {kind}"
        if lines and lines[0] != "None":
            key = getattr(part, "full_key", None)
            rest = f" {lines[1].strip()}" if lines[0].endswith(":") and len(lines) > 1 else ""
            parts.append((f"{key}: " if key else "") + lines[0].strip() + rest)
    return " - ".join(dict.fromkeys(parts)) or type(error).__name__
