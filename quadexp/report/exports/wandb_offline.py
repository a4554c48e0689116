"""Results as offline runs of Weights & Biases: `wandb sync DIR/wandb/offline-run-*` uploads them, nothing else does.

One run a flight, in a group with the name of the results: its config are the settings, its summary the numbers in SI
units and how the flight ended.
"""

from __future__ import annotations

import os
from importlib.util import find_spec
from pathlib import Path

from quadexp.log.extras import missing_package
from quadexp.report.axes.frame import SweepFrame
from quadexp.report.exports.runs import runs


def check_installed() -> None:
    """UsageError where the package is missing."""
    os.environ["WANDB_MODE"] = "offline"  # before it is imported: nothing is sent
    os.environ.update({"WANDB_SILENT": "true", "WANDB_ERROR_REPORTING": "false", "WANDB_CONSOLE": "off"})
    if find_spec("wandb") is None:
        raise missing_package("--to wandb", "wandb", "wandb")


def write(frame: SweepFrame, folder: Path, name: str) -> dict[str, Path]:
    """Write the runs into <folder>/wandb."""
    import wandb

    settings = wandb.Settings(silent=True, console="off", disable_git=True, save_code=False, x_disable_stats=True)
    for one in runs(frame):
        run = wandb.init(
            project=name, group=name, name=one.name, dir=str(folder), mode="offline", config=one.settings,
            tags=[one.tags.get("outcome", "")[:64]], settings=settings, reinit="finish_previous",
        )  # fmt: skip
        run.summary.update({**one.numbers, **one.tags})
        run.finish(exit_code=0 if one.ended else 1)
    return {"wandb": folder / "wandb"}
