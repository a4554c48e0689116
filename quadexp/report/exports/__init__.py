"""Results of a sweep for experiment trackers, one module a format: a run a flight, written to disk, nothing sent."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from quadexp.errors import UsageError
from quadexp.files.writer import check_output
from quadexp.log.store import example_in
from quadexp.messages import tracker_name
from quadexp.report.axes.frame import SweepFrame

FORMATS = {  # name -> module, in which `write(frame, folder, name) -> files` stands
    "mlflow": "mlflow_store",
    "wandb": "wandb_offline",
}


def export_results(
    results: str | Path, form: str, out: str | Path | None = None, *, force: bool = False
) -> dict[str, Path]:
    """Write results for a tracker; returns what -> folder or file.

    out: folder, <results>_<format> unless given; it is empty or not there, or `force` adds to it.
    Raises UsageError for an unknown format, or an extra that is not installed.
    """
    source = Path(results)
    if source.is_dir() and not (source / "results.parquet").is_file():
        raise UsageError(f"{results}: holds no results (made by `quadexp evaluate`); of single flights give the file")
    if form not in FORMATS:
        there = f"no such format for results; there are {', '.join(FORMATS)} (others take a flight)"
        raise UsageError(f"--to {form}: {there}{example_in(source)}")
    frame = SweepFrame.read(source)
    target = Path(out) if out is not None else source.with_name(f"{source.resolve().name}_{form}")
    check_output(target, force=force, folder=True)
    module = import_module(f"{__name__}.{FORMATS[form]}")
    write: Callable[[SweepFrame, Path, str], dict[str, Path]] = module.write
    module.check_installed()
    target.mkdir(parents=True, exist_ok=True)
    return write(frame, target, tracker_name(source.resolve().name))
