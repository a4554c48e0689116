"""A cell whose error is a known function of the weights, and a controller whose best setting is known."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import describe, result_row
from quadexp.log.store import write_flight
from quadexp.parts.compose import session
from quadexp.plugins.tune.search import Request, Search, with_seeds
from quadexp.plugins.tune.space import read_axes
from tests.log.flights import straight_flight

BEST = 40.0  # position weight
HOVER = ["trajectory=hover", "trajectory.duration=0.5"]

OPEN_LOOP = '''
from dataclasses import dataclass

import numpy as np
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import StepRecord
from quadexp.control.part import ControllerPart
from quadexp.parts.settings import key


@dataclass(frozen=True, kw_only=True)
class OpenLoopPart(ControllerPart):
    share: float = key(1.0, "of the weight", "[0, 10]")

    def build(self, given):
        return OpenLoop(given.vehicle, share=self.share)


class OpenLoop:
    """Thrusts of `share` times the weight of the vehicle that is assumed, whatever is measured."""

    residual, reference_period, backend, name, source = None, 0.0, "interpreted", "none", ""
    control_period, node_times = 0.02, np.zeros(1)

    def __init__(self, vehicle, *, share):
        self.vehicle, self.share = vehicle, share

    def forget(self): ...

    def reset(self, x, window): ...

    def step(self, measurement, window):
        weight = self.vehicle.mass * self.vehicle.gravity
        return np.full(4, self.share * weight / 4), StepRecord(0.0, Status.RICCATI, 0, 0, 0.0)

    def log(self):
        return {}
'''
OPEN_LOOP_OPTION = "_target_: open_loop_part.OpenLoopPart\n"


def open_loop(folder: Path) -> Path:
    """A configuration folder with that controller."""
    (folder / "controller").mkdir(parents=True)
    (folder / "open_loop_part.py").write_text(OPEN_LOOP)
    (folder / "controller" / "open_loop.yaml").write_text(OPEN_LOOP_OPTION)
    return folder


@dataclass
class WeightCell:
    """A flight without flying: error 10 mm e^((ln(w / BEST))^2), w the position weight, and lost above `lost`.
    stop: cells after which it raises KeyboardInterrupt."""

    lost: float = math.inf
    stop: int = 1_000_000
    flown: int = 0

    def __call__(self, config, model, path, key):
        self.flown += 1
        if self.flown > self.stop:
            raise KeyboardInterrupt
        weight = config.controller.position_weight[0]
        flight = straight_flight(5, (0.01 * math.exp(math.log(weight / BEST) ** 2), 0.0, 0.0))
        flight.metadata.update(describe(config, build_vehicle(config.vehicle), model))
        if weight > self.lost:
            flight.metadata["outcome"] = "lost"
        flight.metadata["row"] = result_row(config, flight) | {"key": key}
        write_flight(Path(path), flight, key=key)
        return flight.metadata["row"]


def search(out, trials, function, vary=("controller.position_weight=1..1000:log",), given=HOVER, **options):
    """The trials of a search without flights."""
    with session() as composer:
        texts = with_seeds(given, 1)
        axes = tuple(read_axes(vary, composer.expand(texts)[0].config))
        made = Search(composer, Request(tuple(texts), axes, **options), out, function=function, isolate=False)
        return made.run(trials)


def same(one, other):
    """Whether two lists of trials are the same."""
    numbers = [np.array([[*t.numbers, t.worth.value, t.worth.lost] for t in trials]) for trials in (one, other)]
    return len(one) == len(other) and np.array_equal(*numbers)
