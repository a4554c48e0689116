"""The checkpoints that controllers of a family may use: made by the protocol in still air, once a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from quadexp.bench.protocol import Family
from quadexp.experiment.collect import collect_dataset
from quadexp.experiment.fit import fit_checkpoint
from quadexp.experiment.identity import digest
from quadexp.files.writer import write_text
from quadexp.parts.compose import Composer
from quadexp.provenance import DECIDING, package_folder, source_hash

MODEL = "model.json"
MAKING = (*DECIDING, "models", "experiment")  # sources that decide a checkpoint

NETWORK = "_network"  # behind the name of a family's folder

Say = Callable[[str], None]


def make_model(family: Family, composer: Composer, folder: Path, say: Say = lambda text: None) -> Path:
    """The checkpoint of a family in `folder`/<family>: Gaussian processes, and linear drag fitted to the same rows.

    One that is there is used again if the same sources made it by the same protocol.
    """
    return _made("gp", family, "fit", family.name, composer, folder, say)


def make_network(family: Family, composer: Composer, folder: Path, say: Say = lambda text: None) -> Path | None:
    """The network of a family in `folder`/<family>_network, fitted to the same rows; None without a rule for one."""
    if "network" not in family.models:
        return None
    return _made("nn", family, "network", f"{family.name}{NETWORK}", composer, folder, say)


def _made(kind: str, family: Family, rule: str, name: str, composer: Composer, folder: Path, say: Say) -> Path:
    out, data = folder / name, folder / f"{family.name}.parquet"
    hashed = source_hash(package_folder() / part for part in MAKING)
    rules = {part: family.models[part] for part in ("collect", rule)}
    if _is_made(out / MODEL, key := digest([rules, name, hashed])):
        return out
    say(f"{family.name}: {'a network' if kind == 'nn' else 'models'} of the air, from flights in still air")
    data.parent.mkdir(parents=True, exist_ok=True)
    if not _is_made(data, rows := digest([family.models["collect"], family.name, hashed])):
        _mark(data).unlink(missing_ok=True)
        collect_dataset(composer.compose(family.models["collect"]), data)
        write_text(_mark(data), rows + "\n")
    _mark(out / MODEL).unlink(missing_ok=True)
    fit_checkpoint(kind, composer.compose(family.models[rule]), data, out, force=True, figures=False)
    write_text(_mark(out / MODEL), key + "\n")
    return out


def _mark(path: Path) -> Path:
    return path.with_name(f".{path.name}.made")


def _is_made(path: Path, key: str) -> bool:
    mark = _mark(path)
    return path.is_file() and mark.is_file() and mark.read_text(encoding="utf-8").strip() == key
