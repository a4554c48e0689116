"""Results as an MLflow tracking folder, which `mlflow ui --backend-store-uri DIR` shows.

One run a flight, in an experiment with the name of the results. Params are settings, metrics are numbers in SI units,
tags say how the flight ended and what flew it.
"""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

from quadexp.log.extras import missing_package
from quadexp.report.axes.frame import SweepFrame
from quadexp.report.exports.runs import runs

QUIET = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "GIT_PYTHON_REFRESH": "quiet",
    "MLFLOW_ALLOW_FILE_STORE": "true",
}


def check_installed() -> None:
    """UsageError where the package is missing."""
    os.environ.update(QUIET)  # before it is imported: nothing is sent
    if find_spec("mlflow") is None:
        raise missing_package("--to mlflow", "mlflow-skinny", "mlflow")


def write(frame: SweepFrame, folder: Path, name: str) -> dict[str, Path]:
    """Write the runs into the tracking folder."""
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
    return {"mlflow": folder}
