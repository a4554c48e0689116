"""The nanodrone benchmark: its files, its errors and what is published of it (Busetto et al. 2026, arXiv 2512.14450).

A run has four rotor speeds u (rad/s) and 13 states y at 100 Hz:

    y = x y z (m, world)  vx vy vz (m/s, world)  qx qy qz qw (body to world, scalar last)  wx wy wz (rad/s, body)

From y_t and u_t .. u_{t+49} a model predicts y_{t+1} .. y_{t+50}, from every sample of a run that has 50 later ones. An
error at step h is the mean Euclidean distance at y_{t+h}; that of the attitude is 2 atan2(|v|, w) of conj(q) q^, which
depends on the signs of both quaternions. Two ways of averaging are in use:

    runs    each run by itself, then the mean of the runs (the toolbox nonlinear_benchmarks)
    paper   the rows of all runs laid end to end, and only then shifted by h - 1: the last rows of a run are compared
            with the beginning of the next one. The published table is computed so

The toolbox compares row i of a prediction with row i + h - 1 of the truth, so its truth begins with y_1.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.names import sha256_of
from quadexp.plugins.logs.importers.table import open_table

PERIOD = 0.01  # s, of the benchmark
STEPS = 50  # of a prediction, of the benchmark
REPORTED = (1, 10, 50)  # steps, of the published table
STATES = ("x", "y", "z", "vx", "vy", "vz", "qx", "qy", "qz", "qw", "wx", "wy", "wz")
SPEEDS = ("m1_rads", "m2_rads", "m3_rads", "m4_rads")
PARTS = {"p": slice(0, 3), "v": slice(3, 6), "R": slice(6, 10), "w": slice(10, 13)}
UNITS = {"p": "m", "v": "m/s", "R": "rad", "w": "rad/s"}
TEST = "melon"  # the trajectory that nothing may be fitted to
SOURCE = "data.zip of the release v1.0 of github.com/idsia-robotics/nanodrone-sysid-benchmark, unpacked"

# Table of Busetto et al. 2026: at 1, 10 and 50 steps, and the sum over 1 .. 50; averaged as `paper`.
PUBLISHED: dict[str, dict[str, tuple[float, float, float, float]]] = {
    "naive": {
        "p": (0.0143, 0.1430, 0.6797, 17.7878), "v": (0.0329, 0.3182, 1.4749, 38.9241),
        "R": (0.0071, 0.0692, 0.3041, 8.2138), "w": (0.0796, 0.3596, 0.8837, 29.0866),
    },
    "physics": {
        "p": (0.0013, 0.0126, 0.1269, 2.3223), "v": (0.0080, 0.0570, 0.5781, 10.6232),
        "R": (0.0011, 0.0205, 0.2544, 5.1013), "w": (0.0796, 0.3596, 0.8837, 29.0866),
    },
    "MLP": {
        "p": (0.0032, 0.0305, 0.1712, 4.0519), "v": (0.0116, 0.0890, 0.5720, 12.5809),
        "R": (0.0022, 0.0331, 0.2268, 6.0591), "w": (0.1138, 0.5949, 0.9005, 35.5735),
    },
    "hybrid": {
        "p": (0.0016, 0.0166, 0.1119, 2.3625), "v": (0.0092, 0.0613, 0.5556, 10.4033),
        "R": (0.0027, 0.0376, 0.2306, 6.1534), "w": (0.0912, 0.4880, 0.5979, 28.9873),
    },
    "LSTM": {
        "p": (0.0079, 0.0390, 0.2572, 5.9711), "v": (0.0247, 0.1175, 0.7407, 16.7207),
        "R": (0.0066, 0.0372, 0.2325, 5.6525), "w": (0.1021, 0.4292, 1.2407, 35.8353),
    },
}  # fmt: skip


class Run(NamedTuple):
    """A flight. y: (k, 13). u: (k, 4), rad/s. digest: SHA-256 of its file."""

    name: str
    y: np.ndarray
    u: np.ndarray
    digest: str

    @property
    def starts(self) -> np.ndarray:
        """Samples with STEPS later ones."""
        return np.arange(len(self.y) - STEPS)


class Runs(NamedTuple):
    train: list[Run]
    test: list[Run]


def read(folder: Path | None) -> Runs:
    """The runs of a folder with train/ and test/, or with data/ that has them.

    Raises UsageError where there are none, DataError for a file that is no run, and for a test flight in train/."""
    if folder is None:
        raise UsageError(f"reproduce nanodrone: its data are not shipped; name their folder: --data DIR ({SOURCE})")
    for root in (folder, folder / "data", folder / "NanoDrone"):
        if (root / "train").is_dir() and (root / "test").is_dir():
            break
    else:
        raise UsageError(f"{folder}: has no train/ and test/ of the benchmark ({SOURCE})")
    runs = Runs(_runs(root / "train"), _runs(root / "test"))
    if not (runs.train and runs.test):
        raise UsageError(f"{root}: no CSV files in train/ or in test/ ({SOURCE})")
    tested = {run.digest for run in runs.test}
    for run in runs.train:
        if run.name.startswith(TEST) or run.digest in tested:
            raise DataError(f"{root / 'train'}: {run.name} is a flight of the test set, to which nothing may be fitted")
    return runs


def _runs(folder: Path) -> list[Run]:
    return [_run(path) for path in sorted(folder.glob("*.csv"))]


def _run(path: Path) -> Run:
    columns = open_table(path).read((*STATES, *SPEEDS), [])
    values = np.column_stack(list(columns.values()))
    if len(values) <= STEPS or not np.isfinite(values).all():
        raise DataError(f"{path}: {len(values)} rows, or values that are not finite; a run has more than {STEPS} rows")
    y, u = np.split(values, [len(STATES)], axis=1)
    return Run(path.stem, y, u, sha256_of(path.read_bytes()))


def errors(runs: Sequence[Run], predictions: Sequence[np.ndarray], *, as_paper: bool = False) -> dict[str, np.ndarray]:
    """Mean error of each part of the state at steps 1 .. STEPS, (STEPS,).

    predictions: of each run, (starts, STEPS, 13). as_paper: over all runs laid end to end; see the module."""
    if as_paper:
        rows = np.concatenate([run.y[1 : len(run.starts) + 1] for run in runs])
        return _errors(rows, np.concatenate(list(predictions)))
    each = [_errors(run.y[1:], predicted) for run, predicted in zip(runs, predictions, strict=True)]
    mean = {}
    for part in PARTS:
        of_runs = [error[part] for error in each]
        mean[part] = np.mean(of_runs, axis=0)
    return mean


def _errors(rows: np.ndarray, predicted: np.ndarray) -> dict[str, np.ndarray]:
    """rows: truth, of which row i is compared with step 1 of prediction i. predicted: (n, STEPS, 13)."""
    errors = {part: np.empty(STEPS) for part in PARTS}
    for step in range(STEPS):
        truth = rows[step:]
        least = min(len(truth), len(predicted))
        truth = truth[:least]
        guess = predicted[:least, step]
        for part, columns in PARTS.items():
            if part == "R":
                distances = rotation_error(truth[:, columns], guess[:, columns])
            else:
                distances = np.linalg.norm(truth[:, columns] - guess[:, columns], axis=1)
            errors[part][step] = distances.mean()
    return errors


def rotation_error(truth: np.ndarray, guess: np.ndarray) -> np.ndarray:
    """2 atan2(|v|, w) of conj(q) q^, (n,), of quaternions with the scalar last, (n, 4)."""
    scalar = np.sum(truth * guess, axis=1)
    v = truth[:, :3]
    guess_v = guess[:, :3]
    vector = truth[:, 3:] * guess_v - guess[:, 3:] * v - np.cross(v, guess_v)
    size = np.linalg.norm(vector, axis=1)
    return 2 * np.arctan2(size, scalar)


def by_toolbox(runs: Sequence[Run], predictions: Sequence[np.ndarray]) -> dict[str, np.ndarray] | None:
    """`errors` by nonlinear_benchmarks itself; None where a version of it with this benchmark is not installed."""
    try:
        from nonlinear_benchmarks.nanodrone_error_metrics import compute_errors
    except ImportError:
        return None
    import pandas

    names = {"p": "pos", "v": "vel", "R": "rot", "w": "omega"}
    each: dict[str, list[Any]] = {part: [] for part in names}
    for run, predicted in zip(runs, predictions, strict=True):
        truth = run.y[1 : len(predicted) + STEPS]
        columns = dict(zip(STATES, truth.T, strict=True))
        padded = np.full((len(truth), STEPS, len(STATES)), np.nan)
        padded[: len(predicted)] = predicted
        for step in range(STEPS):
            columns |= {f"{name}_pred_h{step + 1}": padded[:, step, i] for i, name in enumerate(STATES)}
        computed = compute_errors(pandas.DataFrame(columns), STEPS)
        for part, name in names.items():
            each[part].append([computed[name][step] for step in range(1, STEPS + 1)])
    return {part: np.mean(of_runs, axis=0) for part, of_runs in each.items()}
