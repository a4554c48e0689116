"""A search for settings in the Python API: qx.tune."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from quadexp.api import OverrideLike, Scratch, overrides, progress_of, request_of
from quadexp.errors import UsageError
from quadexp.frames import Frame
from quadexp.log.store import read_table
from quadexp.parts.options import Folders, Place
from quadexp.plugins.tune.settings import Tune


class Tuning(Frame):
    """A search for settings, a row a trial: error (m), lost flights, and the value of each setting that was varied."""

    kind = "tuning"

    @property
    def best(self) -> int:
        """Place in this table of the trial that was chosen, however it was sorted; UsageError where it is not there."""
        least = self.loc[self["value"] == self["value"].min(), "trial"].min()
        places = np.flatnonzero(self["trial"] == self.attrs.get("best", least))
        if not len(places):
            raise UsageError("the trial that was chosen is not among these rows")
        return int(places[0])

    @property
    def choice(self) -> str:
        """The overrides that choose what was found, as "controller=NAME_tuned"."""
        return str(self.attrs.get("choice", ""))

    @property
    def settings(self) -> dict[str, tuple[Any, Any]]:
        """Key -> its value before and after."""
        return dict(self.attrs.get("settings", {}))

    @property
    def folder(self) -> Path | None:
        """The configuration folder with the options: qx.simulate(*tuned.choice.split(), conf=tuned.folder)."""
        if self._folder is None:
            return None
        return Path(self._folder)

    def summary(self) -> list[str]:
        return list(self.attrs.get("lines", ())) or [f"tuning: {len(self)} trials"]


def tune(
    *settings: OverrideLike,
    out: Place | None = None,
    conf: Folders = None,
    force: bool = False,
    progress: bool = False,
    **keywords: Any,
) -> Tuning:
    """Choose settings of a controller by flights, as `quadexp tune`.

    settings, keywords: the cells of a trial, lists as in `sweep`; keywords that are keys of
    `quadexp.plugins.tune.settings.Tune`, such as vary="KEY=LOW..HIGH" or flights=200, are of the search. out: a
    folder, where a search goes on that was interrupted; else the options are kept for as long as the table.
    Returns a row a trial, the first one as it was; `choice` names what was found, `settings` what it changes.
    Raises UsageError where the budget does not pay two trials, or several controllers are asked for.
    """
    from quadexp.plugins.tune.call import HISTORY
    from quadexp.plugins.tune.call import tune as tuned_by

    folder = Scratch() if out is None else Path(out)
    asked = request_of(Tune, keywords)
    place: dict[str, Any] = {"out": Path(folder), "conf": conf, "force": force, "figure": out is not None}
    with progress_of("flights", progress) as shown:
        tuned = tuned_by(overrides(settings, keywords, lists=True), asked, **place, progress=shown)
    table = Tuning.of(*read_table(Path(folder) / HISTORY, "tuning"), folder)
    table.attrs["best"] = tuned.best
    table.attrs["choice"] = tuned.choice
    table.attrs["lines"] = list(tuned.lines)
    table.attrs["settings"] = dict(tuned.record["settings"])
    return table
