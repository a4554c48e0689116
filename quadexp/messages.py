"""One line from a mistake: what may have been meant, and the telling part of a library's error."""

from __future__ import annotations

import difflib
from collections.abc import Sequence


def suggestion(found: str, known: Sequence[str], listed: Sequence[str] | None = None) -> str:
    """What may have been meant, or what there is."""
    near = difflib.get_close_matches(found, known, n=1, cutoff=0.6)
    if near:
        return f"; did you mean {near[0]}?"
    names = sorted((set(known) if listed is None else set(listed)) - {"sweep"})
    return f"; there are: {', '.join(names[:16])}{', ...' if len(names) > 16 else ''}" if names else ""


def one_line(error: BaseException) -> str:
    """One line from an error of Hydra or OmegaConf and its cause, the most telling part first."""
    parts = []
    for part in (error.__cause__, error):
        if part is None:
            continue
        lines = str(getattr(part, "msg", None) or part).strip().splitlines()
        if lines and lines[0] != "None":
            key = getattr(part, "full_key", None)
            rest = f" {lines[1].strip()}" if lines[0].endswith(":") and len(lines) > 1 else ""
            parts.append((f"{key}: " if key else "") + lines[0].strip() + rest)
    return " - ".join(dict.fromkeys(parts)) or type(error).__name__
