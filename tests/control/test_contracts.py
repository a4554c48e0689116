"""What every law, and every layer around a controller, must keep: all that are registered, those of a folder of one's
own among them. A new one is found by itself."""

from pathlib import Path

import numpy as np
import pytest

from quadexp.compile.compiler import compiler
from quadexp.control.base import Measurement, Window
from quadexp.control.law import Law
from quadexp.control.laws.explicit import ExplicitController
from quadexp.control.layer import Layer, LayerPart
from quadexp.control.wrapped import layers
from quadexp.experiment.build import build_controller, build_trajectory, build_vehicle, build_world, unshared
from quadexp.experiment.compiled_flight import covers
from quadexp.experiment.evaluate import fly_one
from quadexp.experiment.rollout import SampledReference
from quadexp.parts.compose import compose
from quadexp.parts.options import OptionFiles
from quadexp.plugins.margins.linearised import UnknownLoopError
from quadexp.plugins.margins.loop_margins import loop_margins
from quadexp.plugins.remedies.l1 import L1
from tests.control.held import Held

OWN = Path(__file__).parents[2] / "examples"
FILES = OptionFiles()
LAWS = [f"controller={name}" for name, kind in FILES.parts("controller").items() if kind and issubclass(kind, Law)]
LAWS += ["controller=nominal_mpc", "controller=perfect_mpc", "controller=rls_mpc"]
LAYERS = [
    f"{group}={name}"
    for group in ("observer", "adaptive", "rate_loop", "delay")
    for name, kind in FILES.parts(group).items()
    if kind and issubclass(kind, LayerPart)
]
TOGETHER = [
    "controller=nominal_mpc observer=disturbance rate_loop=indi observer.torque_bandwidth=0",
    "controller=perfect_mpc observer=wind delay=strapdown",
    "controller=geometric observer=disturbance delay=prediction",
    "controller=nominal_mpc controller.dead_time=0.03 controller.motor_lead=0.03 adaptive=l1",
]
OF_ONE_S_OWN = ["own controller=geometric"]
OF_ONE_S_OWN += [f"own adaptive={file.stem}" for file in (OWN / "adaptive").glob("*.yaml")]
ELSEWHERE = {  # what a part needs beside the defaults
    "feedback": ("vehicle=lei_li", "plant=blade_element"),
    "rls_mpc": ("vehicle=lei_li", "plant=blade_element", "controller.reference_period=0"),
    "raptor": ("vehicle=crazyflie",),
    "observer=wind": ("controller.residual=plant",),
}
MOST = 1e-6  # m and N: C and Python over a second, rounding amplified by feedback


def composed(part: str, *more: str):
    """The configuration of a short flight with the part: laws by themselves, layers around a law that can be given a
    belief."""
    own, part = part.startswith("own "), part.removeprefix("own ")
    return compose([*settings(part), *more], OWN if own else None)


def settings(part: str) -> list[str]:
    inner = part.split() if part.startswith("controller=") else ["controller=geometric", part]
    if "rate_loop=indi" in part:
        inner.append("rate_loop.rate=400")
    more = [word for name, words in ELSEWHERE.items() if name in part for word in words]
    path = ["trajectory=ellipse", "trajectory.speed=2", "trajectory.duration=1.5", "controller.allow_unstable=true"]
    return [*inner, *more, *path, "seed=3"]


class Flown:
    """The part in a loop of its own, and a flight that can be gone on with."""

    def __init__(self, part: str, backend: str = "interpreted") -> None:
        config = composed(part, f"controller.backend={backend}", "plant.backend=interpreted")
        with unshared():
            vehicle = build_vehicle(config.vehicle)
            self.plant = build_world(config, vehicle)
            self.controller = build_controller(config, vehicle, self.plant, None)
        self.reference = SampledReference(build_trajectory(config.trajectory, vehicle), self.controller)
        self.x, self.k = self.reference.at(0)[0].copy(), 0
        self.noise = self.plant.begin(self.x, self.controller.control_period, 5.0, np.random.default_rng(0))
        self.reading = None
        self.controller.reset(self.x, self.reference.window(0))

    def inputs(self) -> Measurement:
        return Measurement(self.k * self.controller.control_period, self.x.copy(), self.reading, None)

    def go_on(self, periods: int) -> np.ndarray:
        """Commands, (k, n)."""
        commands = []
        for _ in range(periods):
            u, _ = self.controller.step(self.inputs(), self.reference.window(self.k))
            commands.append(u)
            self.x, self.reading = self.plant.advance(self.x, u, self.controller.control_period, self.noise)
            self.k += 1
        return np.array(commands)


@pytest.mark.parametrize("part", [*LAWS, *LAYERS, *TOGETHER, *OF_ONE_S_OWN])
class TestEach:
    def test_it_goes_on_from_a_memory_that_was_kept(self, part):
        """The same measurements again from the same memory: the same bits. Nothing is remembered elsewhere."""
        flown = Flown(part)
        flown.go_on(12)
        running = flown.controller.running
        kept = [memory.now.copy() for memory in running.control_step.memory]
        told = [(flown.inputs(), flown.reference.window(flown.k))]
        first = [flown.go_on(1)[0]]
        for _ in range(7):
            told.append((flown.inputs(), flown.reference.window(flown.k)))
            first.append(flown.go_on(1)[0])
        for memory, values in zip(running.control_step.memory, kept, strict=True):
            memory.restore(values)
        running.k -= len(told)
        again = [flown.controller.step(*one)[0] for one in told]
        np.testing.assert_array_equal(again, first)

    def test_what_it_remembers_has_names(self, part):
        flown = Flown(part)
        flown.go_on(3)
        for memory in flown.controller.running.control_step.memory:
            assert memory.owner and all(memory.sizes) and sum(memory.sizes.values()) == memory.now.size
            for now, after in memory.pairs:
                np.testing.assert_array_equal(now, after)  # an instant has been committed

    def test_its_second_flight_is_its_first(self, part):
        one, other = Flown(part), Flown(part)
        first = one.go_on(10)
        other.go_on(25)
        other.x, other.k, other.reading = other.reference.at(0)[0].copy(), 0, None
        other.noise = other.plant.begin(other.x, other.controller.control_period, 5.0, np.random.default_rng(0))
        other.controller.reset(other.x, other.reference.window(0))
        np.testing.assert_array_equal(other.go_on(10), first)

    @pytest.mark.skipif(compiler() is None, reason="needs a C compiler")
    def test_it_flies_in_c_as_in_python(self, part):
        flights = []
        for backend in ("compiled", "interpreted"):
            flown = Flown(part, backend)
            config = composed(part, f"controller.backend={backend}")
            flights.append(fly_one(config))
            if backend == "compiled" and flown.controller.backend == "compiled" and "ahead" not in part:
                plant = build_world(config, flown.controller.vehicle)
                assert covers(plant, flown.controller, np.random.default_rng(0))
        names = ["p_x", "p_y", "p_z", "u_0", "u_1", "u_2", "u_3"]
        one, other = (flight.stack(names) for flight in flights)
        assert one.shape == other.shape and np.abs(one - other).max() < MOST

    def test_its_columns_are_in_the_flight(self, part):
        config = composed(part)
        controller = Flown(part).controller
        owners = [layer.part.logged for layer in layers(controller) if isinstance(layer, Layer)]
        columns = fly_one(config).columns
        for logged in owners:
            assert all(name in columns for names in logged.values() for name in names)
        inside = layers(controller)[-1].wrapped if layers(controller) else controller
        if isinstance(inside, ExplicitController):
            assert inside.log().keys() <= columns.keys()

    def test_the_delay_that_its_loop_stands_is_known(self, part):
        flown = Flown(part)
        try:
            margins = loop_margins(flown.controller, flown.plant)
        except UnknownLoopError as error:
            pytest.fail(str(error))
        assert np.isfinite(margins["growth"])


def test_all_kinds_are_there():
    assert len(LAWS) >= 6 and len(LAYERS) >= 6 and "own adaptive=height_integral" in OF_ONE_S_OWN


def test_an_instant_that_is_broken_off_leaves_the_memory(vehicle):
    """By Ctrl-C in a controller of one's own, say: who goes on has lost nothing and remembers nothing of it."""

    def thrusts():
        yield from [np.full(4, vehicle.hover_thrust)] * 2
        raise KeyboardInterrupt

    controller = L1().around(Held(vehicle, thrusts(), 0.01))
    x = np.eye(13)[3].copy()
    window = Window(x[None].repeat(2, axis=0), np.full((1, 4), vehicle.hover_thrust), np.zeros((5, 3)), np.zeros(3))
    controller.reset(x, window)
    for k in range(2):
        controller.step(Measurement(0.01 * k, x, None, None), window)
    kept = controller.memory.now.copy()
    x[7:10] = 1.0
    with pytest.raises(KeyboardInterrupt):
        controller.step(Measurement(0.02, x, None, None), window)
    for now, after in controller.memory.pairs:
        np.testing.assert_array_equal(now, kept)
        np.testing.assert_array_equal(after, kept)
