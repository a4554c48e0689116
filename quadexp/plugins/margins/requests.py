"""What `quadexp show --margins` asks for."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from quadexp.errors import UsageError
from quadexp.experiment.identity import find_model
from quadexp.log.store import read_metadata
from quadexp.parts.compose import session
from quadexp.parts.options import Folders
from quadexp.plugins.margins.loop_margins import path_margins
from quadexp.plugins.margins.recorded import recorded_words


def margins(words: Sequence[str], conf: Folders = None) -> list[dict[str, Any]]:
    """What a loop tolerates at points along its path, see `path_margins`. words: overrides, and in front of them the
    file of a flight, whose recorded settings they change."""
    with session(conf) as composer:
        of_flight = bool(words) and ("=" not in words[0] or Path(words[0]).is_file())
        composer.only("show --margins", words[of_flight:])
        if of_flight:
            about = read_metadata(words[0], "flight")
            if "config" not in about:
                raise UsageError(f"{words[0]}: a flight without a record of its settings (a recorded one?): give these")
            words = recorded_words(composer, about["config"], words[1:], about.get("classes") or {})
        config = composer.compose(words)
    return path_margins(config, find_model(config))
