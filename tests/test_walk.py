"""A newcomer's walk: one number followed from the state of the plant to the table of results, down to each equation.

For every station the program is run under a tracer, from the function that is called to the one where the equation is
evaluated (the landmark). The modules on that chain of calls are what has to be read; what checks, describes or hashes
on the way is not on it, nor what composed the configuration before. The walk is short where few modules stand between
what is called and what computes.
"""

import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from quadexp.cli.app import app
from quadexp.experiment.build import build_controller, build_trajectory, build_vehicle, unshared
from quadexp.experiment.evaluate import describe, result_row
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.log.store import read_flight, write_flight
from quadexp.models.checkpoint import load_model, save_model
from quadexp.models.dataset import residual_dataset
from quadexp.parts.compose import compose
from quadexp.plugins.gaussian_process.gaussian_process import GPConfig, fit_gp
from quadexp.plugins.gaussian_process.posterior import gaussian_process_residual
from quadexp.report.tables import error_table
from quadexp.world.simplified import PlantEffects, SimplifiedPlant
from tests.composing import _from_nothing  # noqa: F401 - whose composer knows options that others composed
from tests.house import PACKAGE

SETTINGS = (
    "trajectory=step",
    "trajectory.duration=2",
    "controller=gp_mpc",
    "controller.backend=interpreted",
    "plant.backend=interpreted",
)
# Station -> the functions where its work is done.
LANDMARKS = {
    "configuration": (
        "parts.override.plain_override",
        "parts.options.option",
        "parts.settings.made",
        "world.integrator.advance",
    ),
    "plant": ("physics.rigid_body.state_derivative", "world.integrator.advance"),
    "flight": ("world.integrator.advance", "control.mpc.mpc.command"),
    "store": ("log.store.write_table",),
    "read": ("log.store.read_table",),
    "data set": ("physics.rigid_body.state_derivative",),
    "fit": ("plugins.gaussian_process.sgpr.loss",),
    "checkpoint": ("models.checkpoint.plain", "models.checkpoint.record_of"),
    "air": ("plugins.gaussian_process.posterior.gaussian_process_residual",),
    "step": ("control.mpc.mpc.stages_of", "control.mpc.node.linearise_function"),
    "row": ("report.metrics.flight_metrics",),
    "table": ("report.inference.mean_interval",),
}
CONFIGURING = 10  # modules from the words of the command line to the first period
ENTERED = 63  # modules in which a line runs, of all, without imports; two are plug-ins' (margins, notes on commands)
MOST = 22  # one of them the integrator that all plants share


class Walk:
    """Which modules lie on the chains of calls to the landmarks, and which are entered at all."""

    def __init__(self) -> None:
        self.read: dict[str, list[str]] = {}
        self.entered: set[str] = set()

    def station(self, name: str, function: Callable[[], Any]) -> Any:
        """What the function returns; raises AssertionError where it does not pass its landmarks."""
        chains: dict[str, list[str]] = {}

        def trace(frame: FrameType, event: str, argument: Any) -> None:
            module = self._module(frame)
            if event != "call" or not module:
                return
            if module not in self.entered and not _is_importing(frame):
                self.entered.add(module)
            landmark = f"{module}.{frame.f_code.co_name}"
            if landmark in LANDMARKS[name]:
                chain: list[str] = []
                at: FrameType | None = frame
                while at is not None:
                    if (module := self._module(at)) and module not in chain:
                        chain.append(module)
                    at = at.f_back
                if landmark not in chains or len(chain) < len(chains[landmark]):
                    chains[landmark] = chain

        sys.setprofile(trace)
        try:
            made = function()
        finally:
            sys.setprofile(None)
        assert sorted(chains) == sorted(LANDMARKS[name]), f"{name}: its landmarks are elsewhere: name them in LANDMARKS"
        self.read[name] = sorted({module for chain in chains.values() for module in chain})
        return made

    @staticmethod
    def _module(frame: FrameType) -> str:
        return _module_of(frame.f_code.co_filename)


def _is_importing(frame: FrameType) -> bool:
    """Whether it runs during an import, which happens once in a process."""
    at: FrameType | None = frame
    while at is not None:
        if at.f_code.co_filename == "<frozen importlib._bootstrap>":
            return True
        at = at.f_back
    return False


@cache
def _module_of(file: str) -> str:
    """Below quadexp; "" for others."""
    path = Path(file)
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts) if path.is_relative_to(PACKAGE) else ""


def walked(folder: Path) -> Walk:
    """From the state to the table."""
    found = Walk()
    config = compose(SETTINGS)
    vehicle = build_vehicle(config.vehicle)
    trajectory = build_trajectory(config.trajectory, vehicle)
    with unshared():
        nominal = build_controller(compose([*SETTINGS, "controller=nominal_mpc"]), vehicle, None, None)
        rng = np.random.default_rng(0)
        reference = SampledReference(trajectory, nominal)
        state, thrusts = reference.at(0)

        def simulate() -> Any:
            plant = SimplifiedPlant(vehicle, PlantEffects(linear_drag=(0.3, 0.3, 0.1)), backend="interpreted")
            plant.advance(state, thrusts, 0.02, rng)
            return plant

        plant = found.station("plant", simulate)
    record = describe(config, vehicle, None)
    flight = found.station("flight", lambda: fly(plant, nominal, reference, rng, metadata=record))
    path = folder / "flight.parquet"
    found.station("store", lambda: write_flight(path, flight))
    flight = found.station("read", lambda: read_flight(path))
    data = found.station("data set", lambda: residual_dataset([flight] * 3, vehicle, names=["a", "b", "c"]))
    settings = GPConfig(features={"a_x": ("v_x",)}, inducing=5, max_iterations=2, max_rows=50)
    fitted = found.station("fit", lambda: fit_gp(data, settings))

    def store() -> Any:
        return load_model(save_model(folder / "model", fitted), vehicle=vehicle)

    model = found.station("checkpoint", store)
    residual = found.station("air", lambda: gaussian_process_residual(vehicle, model.outputs, None))
    found.station("step", lambda: _step(vehicle, residual, nominal.settings, reference))
    row = found.station("row", lambda: result_row(config, flight))
    found.station("table", lambda: error_table([row, {**row, "seed": 1}]))
    return found


def _step(vehicle: Any, residual: Any, settings: Any, reference: SampledReference) -> Any:
    from quadexp.control.base import Measurement
    from quadexp.control.mpc.controller import PredictiveController
    from quadexp.control.mpc.mpc import ModelPredictiveController

    controller = PredictiveController(ModelPredictiveController(vehicle, residual, settings, backend="interpreted"))
    state, window = reference.at(0)[0], reference.window(0)
    controller.reset(state, window)
    return controller.step(Measurement(0.0, state, None, None), window)


def test_a_newcomer_reads_few_modules_and_passes_every_room_of_the_data_flow(tmp_path):
    """Few modules are entered at all, also counting those in which a single line runs, be it a check or a name."""
    walk = walked(tmp_path)
    read = sorted({module for modules in walk.read.values() for module in modules})
    assert len(read) <= MOST, f"{len(read)} modules: {', '.join(read)}"
    assert {"world", "physics", "log", "models", "control", "experiment", "report"} <= {
        m.partition(".")[0] for m in read
    }
    assert len(walk.entered) <= ENTERED, sorted(walk.entered)


def test_from_the_words_of_the_command_line_to_the_first_period(tmp_path):
    walk, words = Walk(), ["trajectory=hover", "trajectory.duration=0.4", *SETTINGS[3:], "--out", str(tmp_path / "f")]
    walk.station("configuration", lambda: app(["simulate", *words], standalone_mode=False))
    read = walk.read["configuration"]
    assert len(read) <= CONFIGURING, ", ".join(read)
