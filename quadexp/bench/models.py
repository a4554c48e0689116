"""The checkpoints that controllers of a family may use: made by the protocol in calm air, once a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from quadexp.bench.protocol import Family, Protocol
from quadexp.config.compose import Composer
from quadexp.experiment.collect import collect_dataset
from quadexp.experiment.fit import fit_checkpoint
from quadexp.experiment.identity import digest
from quadexp.log.store import write_text
from quadexp.provenance import DECIDING, package_folder, source_hash

MODEL, MADE = "model.json", ".made"
MAKING = (*DECIDING, "learn", "experiment")  # sources that decide a checkpoint

Say = Callable[[str], None]


def make_model(
    protocol: Protocol, family: Family, composer: Composer, folder: Path, say: Say = lambda text: None
) -> Path:
    """The checkpoint of a family in `folder`/<family>: Gaussian processes, and linear drag fitted to the same rows.

    One that is there is used again if the same sources made it by the same protocol.
    """
    out, key = (
        folder / family.name,
        digest([family.models, family.name, source_hash(package_folder() / name for name in MAKING)]),
    )
    mark = out / MADE
    if (out / MODEL).is_file() and mark.is_file() and mark.read_text(encoding="utf-8").strip() == key:
        return out
    say(f"{family.name}: data and models, in still air")
    data = folder / f"{family.name}.parquet"
    data.parent.mkdir(parents=True, exist_ok=True)
    mark.unlink(missing_ok=True)
    collect_dataset(composer.compose(family.models["collect"]), data)
    fit_checkpoint("gp", composer.compose(family.models["fit"]), data, out, force=True, figures=False)
    write_text(mark, key + "\n")
    return out
