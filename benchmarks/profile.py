"""Where the processor time of a flight, a fit and a sweep goes, by function of quadexp.

    python -m benchmarks.profile [flight] [fit] [sweep] [--case gp20] [--top 12] [--json]

A processor-time timer interrupts the work every few milliseconds; each sample counts for the innermost function of the
project on the stack, so that a CasADi function counts for its caller. The overhead is negligible, so small functions
are not overestimated, and other load on the machine has little effect. Everything has been run once before, so that
compiled and cached functions exist.

flight  12 s on a circle at 8 m/s with 100 control steps a second, simplified plant: references, flight, log
fit     the command fit-gp on 60 s of collected flight
sweep   eight cells of a sweep, two controllers, two speeds, two seeds, one by one in this process, with their files
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from benchmarks.machine import machine
from benchmarks.step import CASES, make_plant, make_residual
from quadexp.cli.app import app
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import evaluate_cell
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.parts.compose import compose, expand
from quadexp.reference.circle import Circle

INTERVAL = 1e-3  # s of processor time
ROOT = Path(__file__).parent.parent
RATE = 100.0  # Hz

Work = Callable[[], None]


class Samples:
    """Processor seconds by function at work."""

    def __init__(self) -> None:
        self.seconds: collections.Counter[str] = collections.Counter()
        self._last = 0.0

    def take(self, _signal: int, frame: FrameType | None) -> None:
        """What passed since the last sample counts for the innermost frame of the project.

        A library's call is interrupted only when it returns, so samples weigh what they stand for.
        """
        now = time.process_time()
        passed, self._last = now - self._last, now
        while frame is not None:
            path = Path(frame.f_code.co_filename)
            if path.is_relative_to(ROOT) and path.parent != ROOT:
                name = f"{path.relative_to(ROOT)}: {frame.f_code.co_qualname}"
                self.seconds[name] += passed
                return
            frame = frame.f_back
        self.seconds["(elsewhere)"] += passed

    @contextlib.contextmanager
    def watch(self) -> Iterator[None]:
        """Sample what runs inside."""
        before = signal.signal(signal.SIGPROF, self.take)
        self._last = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, INTERVAL, INTERVAL)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            signal.signal(signal.SIGPROF, before)


def flight(case: str, folder: Path) -> Work:
    """A 12 s flight: its reference, the flight itself, the columns of its log."""
    vehicle = build_vehicle(compose([]).vehicle)
    residual, _ = make_residual(case, vehicle)
    controller = ModelPredictiveController(vehicle, residual, MPCSettings(rate=RATE))
    plant = make_plant(case, vehicle)

    def work() -> None:
        reference = SampledReference(Circle(speed=8.0, acceleration=2.0), controller)
        fly(plant, controller, reference, np.random.default_rng(0))

    return work


def fit(case: str, folder: Path) -> Work:
    """The command fit-gp on the data of a collection."""
    data = str(folder / "data.parquet")
    command(["collect", "collect.duration=60", "--out", data, "--force"])
    return lambda: command(["fit-gp", data, "--out", str(folder / "gp"), "--force"])


def sweep(case: str, folder: Path) -> Work:
    """Cells of a sweep, in this process."""
    cells = expand(["trajectory=circle", "trajectory.speed=4,8", "controller=nominal_mpc,perfect_mpc", "seed=range(2)"])

    def work() -> None:
        for i, cell in enumerate(cells):
            evaluate_cell(cell.config, None, str(folder / f"{i}.parquet"), str(i))

    return work


def command(words: list[str]) -> None:
    """A command of quadexp in this process, without what it prints."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        app(words, standalone_mode=False)


WORK = {"flight": (flight, 10), "fit": (fit, 1), "sweep": (sweep, 2)}  # and how often


def profile(name: str, case: str) -> dict[str, Any]:
    """Seconds of the work once it is warm, and the functions that took them."""
    prepare, repeats = WORK[name]
    with tempfile.TemporaryDirectory(prefix="quadexp-profile-") as folder:
        work = prepare(case, Path(folder))
        work()
        samples, wall, processor = Samples(), [], []
        for _ in range(repeats):
            began, spent = time.perf_counter(), time.process_time()
            with samples.watch():
                work()
            wall.append(time.perf_counter() - began)
            processor.append(time.process_time() - spent)
    total = sum(samples.seconds.values())
    return {
        "work": name,
        "wall_s": float(np.median(wall)),
        "processor_s": float(np.median(processor)),
        "shares": {place: seconds / total for place, seconds in samples.seconds.most_common()},
    }


def table(found: dict[str, Any], top: int) -> str:
    """One profile as Markdown."""
    head = f"{found['work']}: {found['wall_s']:.3f} s, {found['processor_s']:.3f} s of processor time (medians)"
    lines = [head, "", "| share | function |", "| ----: | -------- |"]
    lines += [f"| {100 * share:3.0f} % | {place} |" for place, share in list(found["shares"].items())[:top]]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", nargs="*", metavar="WORK", help=f"{', '.join(WORK)}; all of them unless given")
    parser.add_argument("--case", default="gp20", choices=CASES, help="correction of the flight's controller")
    parser.add_argument("--top", type=int, default=12, help="lines of a table")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of the tables")
    arguments = parser.parse_args()
    if unknown := set(arguments.work) - set(WORK):
        parser.error(f"{', '.join(sorted(unknown))}: allowed are {', '.join(WORK)}")
    found = [profile(name, arguments.case) for name in arguments.work or WORK]
    if arguments.json:
        print(json.dumps({"machine": machine(), "profiles": found}))
    else:
        print("\n\n".join([machine(), *(table(one, arguments.top) for one in found)]))


if __name__ == "__main__":
    main()
