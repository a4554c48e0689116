"""Results of a sweep for experiment trackers: a run a flight, written to disk, nothing sent.

Params (the config of W&B) are settings, metrics (its summary) numbers in SI units; tags say how the flight ended and
what flew it. `mlflow ui --backend-store-uri DIR` shows a folder of MLflow; `wandb sync DIR/wandb/offline-run-*`
uploads offline runs of Weights & Biases, and nothing else does.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

from quadexp.errors import UsageError, missing_package
from quadexp.files.writer import check_output
from quadexp.log.store import example_in
from quadexp.messages import tracker_name, tracker_text
from quadexp.report.frame import SweepFrame, is_metric, is_number
from quadexp.report.result_rows import ROW_COLUMNS

TAGS = ("outcome", "cause", "backend", "program", "sources", "libraries", "key")
PACKAGES = {"mlflow": "mlflow-skinny", "wandb": "wandb"}
QUIET = {  # set before the packages are imported: nothing is sent
    "mlflow": {
        "MLFLOW_DISABLE_TELEMETRY": "true", "DO_NOT_TRACK": "true", "GIT_PYTHON_REFRESH": "quiet",
        "MLFLOW_ALLOW_FILE_STORE": "true",
    },
    "wandb": {
        "WANDB_MODE": "offline", "WANDB_SILENT": "true", "WANDB_ERROR_REPORTING": "false", "WANDB_CONSOLE": "off",
    },
}  # fmt: skip


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
    if form not in WRITERS:
        there = f"no such format for results; there are {', '.join(WRITERS)} (others take a flight)"
        raise UsageError(f"--to {form}: {there}{example_in(source)}")
    frame = SweepFrame.read(source)
    target = Path(out) if out is not None else source.with_name(f"{source.resolve().name}_{form}")
    check_output(target, force=force, folder=True)
    os.environ.update(QUIET[form])
    if find_spec(form) is None:
        raise missing_package(f"--to {form}", PACKAGES[form], form)
    target.mkdir(parents=True, exist_ok=True)
    return {form: WRITERS[form](frame, target, tracker_name(source.resolve().name))}


class Run(NamedTuple):
    """settings: key -> value, of what was asked for. numbers: metric -> value, without those that are missing. tags:
    texts."""

    name: str
    settings: dict[str, Any]
    numbers: dict[str, float]
    tags: dict[str, str]
    ended: bool


def runs(frame: SweepFrame) -> Iterator[Run]:
    """A run for every flight, in the order of the sweep."""
    names = [name for name in ROW_COLUMNS if not is_metric(name) and name not in (*TAGS, "variant", "speed")]
    keys = list(dict.fromkeys([*names, "trajectory.speed", *frame.swept]))
    columns = {key: frame.column(key) for key in keys}
    for i, row in enumerate(frame.rows):
        given = {key: column[i] for key, column in columns.items() if column[i] is not None}
        settings = {key: tracker_text(value) if isinstance(value, str) else value for key, value in given.items()}
        numbers = {
            name: float(row[name])
            for name in ROW_COLUMNS
            if is_metric(name) and is_number(row.get(name)) and math.isfinite(row[name])
        }
        tags = {name: tracker_text(row[name]) for name in TAGS if row.get(name)}
        parts = [row["controller"], row["trajectory"], row["variant"] or "", f"seed {row['seed']}"]
        yield Run(tracker_name(" ".join(filter(None, parts))), settings, numbers, tags, row["outcome"] == "ok")


def _mlflow(frame: SweepFrame, folder: Path, name: str) -> Path:
    """The runs in the tracking folder, in an experiment with the name of the results."""
    from mlflow.entities import Metric, Param, RunTag
    from mlflow.tracking import MlflowClient

    client = MlflowClient(tracking_uri=folder.resolve().as_uri())
    known = client.get_experiment_by_name(name)
    experiment = client.create_experiment(name) if known is None else known.experiment_id
    for one in runs(frame):
        run = client.create_run(experiment, run_name=one.name)
        start = run.info.start_time
        client.log_batch(
            run.info.run_id,
            metrics=[Metric(key, value, start, 0) for key, value in one.numbers.items()],
            params=[Param(key, str(value)) for key, value in one.settings.items()],
            tags=[RunTag(key, value) for key, value in one.tags.items()],
        )
        client.set_terminated(run.info.run_id, "FINISHED" if one.ended else "FAILED")
    return folder


def _wandb(frame: SweepFrame, folder: Path, name: str) -> Path:
    """The runs in <folder>/wandb, in a group with the name of the results."""
    import wandb

    settings = wandb.Settings(silent=True, console="off", disable_git=True, save_code=False, x_disable_stats=True)
    for one in runs(frame):
        run = wandb.init(
            project=name, group=name, name=one.name, dir=str(folder), mode="offline", config=one.settings,
            tags=[one.tags.get("outcome", "")[:64]], settings=settings, reinit="finish_previous",
        )  # fmt: skip
        run.summary.update({**one.numbers, **one.tags})
        run.finish(exit_code=0 if one.ended else 1)
    return folder / "wandb"


WRITERS: dict[str, Callable[[SweepFrame, Path, str], Path]] = {"mlflow": _mlflow, "wandb": _wandb}
