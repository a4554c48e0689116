"""The commands as functions. What each takes, and the same results to the last bit, is that of its command.

Settings are given as on the command line ("trajectory.speed=8"), as dictionaries ({"trajectory.speed": 8}, or nested
{"trajectory": {"speed": 8}}), or as keywords; see `overrides`. Nothing is written unless `out` is given.
conf: a configuration folder of your own, or several, as --conf. force: replace what is at `out`. progress: show it
on the error stream. Errors are QuadexpError and its kinds (quadexp/errors.py) with a one-line message.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, get_origin

import pandas as pd

from quadexp import requests
from quadexp.errors import UsageError
from quadexp.frames import Checkpoint, Dataset, Flight, Frame, Results
from quadexp.log.store import read_flight, read_metadata, read_table, write_table
from quadexp.names import SPELLINGS
from quadexp.parts.former import GROUPS as FORMER_GROUPS
from quadexp.parts.options import Folders, Place, given_folders
from quadexp.parts.override import GROUPS, MOST_CELLS, in_grammar
from quadexp.parts.schema import Config
from quadexp.parts.settings import S, declared
from quadexp.plugin import brought
from quadexp.progress import Progress
from quadexp.requests import RESULTS

OverrideLike = str | Mapping[str, Any]
SINGLE = (str, os.PathLike, pd.DataFrame)  # what stands for a list of itself, where several are taken
MODEL = "model.json"
TOP = {
    *GROUPS,
    *declared(Config),
    *SPELLINGS,
    *FORMER_GROUPS,
}  # keys of the command line that stand in no group, and the groups


def simulate(
    *settings: OverrideLike, out: Place | None = None, conf: Folders = None, force: bool = False, **keywords: Any
) -> Flight:
    """Fly one configuration, as `quadexp simulate`.

    A keyword that is no key of the configuration is one of the trajectory: speed=8 is trajectory.speed=8 (m/s).
    Returns the flight, a row a control instant; how it went is its `outcome`, no error.
    Raises UsageError for wrong settings, a missing model, or a path that the vehicle cannot fly.
    """
    flight = requests.simulate(overrides(settings, keywords), _path(out), conf, force=force).flight
    return Flight.of(flight.columns, flight.metadata)


def collect(
    *settings: OverrideLike,
    flights: Place | Flight | Iterable[Place | Flight] = (),
    out: Place | None = None,
    conf: Folders = None,
    force: bool = False,
    progress: bool = False,
    **keywords: Any,
) -> Dataset:
    """Fly for data, or take `flights` (one or several), and return what the rigid body leaves, as `quadexp collect`.

    A keyword that is no key of the configuration is one of `collect`: duration=60 is collect.duration=60 (s).
    """
    scratch = Scratch()
    path = _path(out) or scratch / "residuals.parquet"
    several = [flights] if isinstance(flights, SINGLE) else flights
    recorded = [_file(flight, scratch, f"flight_{i:03d}") for i, flight in enumerate(several)]
    with progress_of("seconds of flight", progress) as shown:
        texts = overrides(settings, keywords, "collect")
        requests.collect(texts, path, conf, flights=recorded, force=force, progress=shown)
    return Dataset.of(*read_table(path, "residuals"))


def fit(
    model: str,
    data: Place | Dataset,
    *settings: OverrideLike,
    out: Place | None = None,
    conf: Folders = None,
    force: bool = False,
    progress: bool = False,
    **keywords: Any,
) -> Checkpoint:
    """Fit a model of the air, as `quadexp fit`.

    model: an option of the group `model`, "linear_drag" or one of your own. data: a data set, or its file. A
    keyword that is no key of the configuration is one of the model: inducing=40. out: a folder.
    Raises DataError where the data are of another vehicle than the configuration.
    """
    scratch = Scratch()
    path = _path(out) or scratch / model
    with progress_of("fit", progress) as shown:
        file = _file(data, scratch, "residuals")
        texts = overrides(settings, keywords, "model")
        requests.fit(model, file, texts, path, conf, force=force, figures=False, progress=shown)
    return Checkpoint(path, scratch if out is None else None)


def fit_drag(data: Place | Dataset, *settings: OverrideLike, **keywords: Any) -> Checkpoint:
    """Fit linear rotor drag: fit("linear_drag", data, ...)."""
    return fit("drag", data, *settings, **keywords)


def sweep(
    *settings: OverrideLike,
    out: Place | None = None,
    conf: Folders = None,
    force: bool = False,
    old: Literal["ask", "refly", "keep"] = "ask",
    progress: bool = False,
    **keywords: Any,
) -> Results:
    """Fly every combination of the values given, on all cores, as `quadexp evaluate --sweep`.

    A list is several values, controller=["nominal_mpc", "perfect_mpc"] or seed=range(3); a value that is itself a list
    stands in a list. out: a folder of results, where a sweep goes on that was interrupted; else the flights are kept
    for as long as the table. old: cells at `out` flown by other sources than these: refuse, fly again, or keep.
    Returns a row a flight; of one that could not be flown `outcome` and `cause` say why.
    """
    folder = Scratch() if out is None else Path(out)
    texts = overrides(settings, keywords, lists=True)
    asked = requests.Evaluation(overrides=texts, out=Path(folder), conf=conf, figures=False, old=old, force=force)
    swept = requests.evaluate(asked, lambda below: progress_of("flights", progress))
    results = _results(folder)
    results.attrs["notes"] = swept.result.notes
    return results


def request_of(kind: type[S], keywords: dict[str, Any]) -> S:
    """The record of a request, whose keys are taken from the keywords; one value stands for a list of one."""
    stated = {name: keywords.pop(name) for name in declared(kind) if name in keywords}
    for name, value in stated.items():
        if get_origin(declared(kind)[name].type) is tuple and isinstance(value, SINGLE):
            stated[name] = (value,)
    return kind(**stated)


def load(path: Place, conf: Folders = None) -> Flight | Dataset | Results | Checkpoint | Frame:
    """Read what a command wrote: a flight, a data set, the folder of a checkpoint or of results.

    conf: of the checkpoint of a model of one's own, which predicts by its class.
    Raises UsageError where there is nothing of that kind, DataError where it is damaged.
    """
    path = Path(path)
    given_folders(conf)
    if path.is_dir():
        if (path / RESULTS).is_file():
            return _results(path)
        if (path / MODEL).is_file():
            return Checkpoint(path)
        raise UsageError(f"{path}: neither a checkpoint ({MODEL}) nor results ({RESULTS}) in this folder")
    if path.name == MODEL:
        return Checkpoint(path.parent)
    kind = read_metadata(path)["kind"]
    if kind == "results":
        return _results(path.parent)
    if kind == "flight":
        flight = read_flight(path)
        return Flight.of(flight.columns, flight.metadata)
    table = brought("tables", kind) or (Dataset if kind == "residuals" else Frame)
    return table.of(*read_table(path, kind))


# ---------------------------------------------------------------------------------------------------------------- files
class Scratch:
    """A folder that is removed when nothing refers to it any more, at the latest when Python ends."""

    def __init__(self) -> None:
        self._folder = tempfile.mkdtemp(prefix="quadexp-")
        weakref.finalize(self, _remove, self._folder, os.getpid())

    def __fspath__(self) -> str:
        return self._folder

    def __truediv__(self, name: str) -> Path:
        return Path(self._folder) / name

    def __reduce__(self) -> tuple[type[Path], tuple[str]]:
        return Path, (self._folder,)  # a copy in another process does not own the folder


def _remove(folder: str, owner: int) -> None:
    if os.getpid() == owner:  # and not a process that was forked from it
        shutil.rmtree(folder, ignore_errors=True)


def _results(folder: Path | Scratch) -> Results:
    return Results.of(*read_table(folder / RESULTS, "results"), folder)


def _path(place: Place | None) -> Path | None:
    return None if place is None else Path(place)


def _file(source: Place | pd.DataFrame, scratch: Scratch, name: str) -> Path:
    """The file of what is given as one, or as a table."""
    if not isinstance(source, pd.DataFrame):
        return Path(source)
    if not isinstance(source, Frame):
        raise UsageError("a table without its record: give what quadexp returned, or the path of a file")
    return write_table(scratch / f"{name}.parquet", source.columns_as_arrays(), source.record, source.kind)


def progress_of(label: str, wanted: bool) -> Any:
    """Progress where it is asked for, as a context."""
    return Progress(label) if wanted else contextlib.nullcontext(requests.quiet)


# ------------------------------------------------------------------------------------------------------------- settings
def overrides(
    settings: Sequence[OverrideLike], keywords: Mapping[str, Any], group: str = "trajectory", *, lists: bool = False
) -> list[str]:
    """Every setting as KEY=VALUE, in order.

    settings: texts KEY=VALUE as on the command line, and dictionaries {key: value}, where a key may be dotted and a
    value a dictionary of its own. keywords: the same; a name that is no key of the configuration belongs to `group`:
    speed=8 is trajectory.speed=8. lists: a list is several values of a sweep, and a list inside it one value.
    Raises UsageError for what is neither.
    """
    texts: list[str] = []
    for setting in settings:
        if isinstance(setting, str):
            texts.append(setting)
        elif isinstance(setting, Mapping):
            texts += _pairs(setting, "", lists)
        else:
            raise UsageError(f"{setting!r}: settings are text KEY=VALUE, dictionaries or keywords")
    full = {name if name.partition(".")[0] in TOP else f"{group}.{name}": value for name, value in keywords.items()}
    return [*texts, *_pairs(full, "", lists)]


def _pairs(values: Mapping[str, Any], prefix: str, lists: bool) -> Iterator[str]:
    for name, value in values.items():
        if not isinstance(name, str):
            raise UsageError(f"{name!r}: keys are text, such as 'trajectory.speed'")
        key = f"{prefix}{name}"
        value = value.tolist() if hasattr(value, "tolist") else value
        if isinstance(value, Mapping):
            yield from _pairs(value, f"{key}.", lists)
        elif lists and isinstance(value, (list, tuple, range)):
            if not value:
                raise UsageError(f"{key}: an empty list leaves nothing to fly")
            if len(value) > MOST_CELLS:
                raise UsageError(f"{key}: {len(value)} values; a sweep has at most {MOST_CELLS} cells")
            yield f"{key}={','.join(in_grammar(key, item) for item in value)}"
        else:
            yield f"{key}={in_grammar(key, value)}"
