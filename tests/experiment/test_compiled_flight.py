"""The flight in C is the flight of the Python loop: every column and the record, to the last bit."""

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from quadexp.compile.compiler import compiler
from quadexp.control import compiled_loop
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment import rollout
from quadexp.experiment.build import build_controller, build_trajectory
from quadexp.experiment.compiled_flight import CompiledFlight, covers
from quadexp.experiment.evaluate import build_loop
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.models.residual import symbolic_residual
from quadexp.parts.compose import compose
from quadexp.plugins.identification.from_model import FromModelPlant
from quadexp.plugins.papers.lei_li.plant import BladeElementEffects, BladeElementPlant, PlantChange
from quadexp.plugins.worlds.battery import Battery
from quadexp.plugins.worlds.dryden import Dryden
from quadexp.plugins.worlds.slung_load import SlungLoad
from quadexp.reference.circle import Circle
from quadexp.reference.hover import Hover
from quadexp.reference.lemniscate import Lemniscate
from quadexp.reference.step import Step
from quadexp.world import PlantEffects, SimplifiedPlant
from quadexp.world.actuator import Actuator
from quadexp.world.constant_wind import ConstantWind
from quadexp.world.disturbance import Disturbance
from quadexp.world.ground import GroundEffect
from quadexp.world.link import Latency
from quadexp.world.rotor_loss import RotorLoss
from quadexp.world.sensors import Sensors
from quadexp.world.stated_estimate import StatedEstimate
from quadexp.world.streams import BLOCK
from quadexp.world.true_vehicle import TrueVehicle
from quadexp.world.world import World
from tests.models.residuals import BLADE, make_residual, with_rotors
from tests.properties.paths import Wander, near
from tests.slow import slow

Q = ("q_w", "q_x", "q_y", "q_z")
LEI_LI = Sensors(accelerometer_bias=(0.001, 0.001, -0.001), accelerometer_noise=(0.05, 0.05, 0.05))
compiled = pytest.mark.skipif(compiler() is None, reason="no C compiler")


@dataclass
class Both:
    """A flight in C and by the Python loop, where C left off, and what each leaves of the random numbers."""

    flight: object
    handed_over: list
    periods_in_c: int


def both(monkeypatch, plant, controller, path, *, seed=0, sensors=(), **options) -> Both:
    """Fly it twice and compare. sensors: around a plant that has no world."""
    plant = World(plant, sensors) if sensors and not isinstance(plant, World) else plant
    assert covers(plant, controller, np.random.default_rng())
    found, stops, flown = [], [], [0]

    def go_on(self, k, x, reading):
        result = original(self, k, x, reading)
        flown[0] += result[0] - k
        stops.append(result[:2])
        return result

    original = CompiledFlight.go_on
    monkeypatch.setattr(CompiledFlight, "go_on", go_on)
    for covering in (covers, lambda *_: False):
        monkeypatch.setattr(rollout, "covers", covering)
        reference, rng = SampledReference(path, controller), np.random.default_rng(seed)
        flight = fly(plant, controller, reference, rng, metadata={"name": "both"}, **options)
        found.append((flight, rng.bit_generator.state, plant.time, plant.inner.tobytes()))
    monkeypatch.undo()
    (one, *left), (two, *right) = found
    assert list(one.columns) == list(two.columns)
    for name in one.columns:
        assert one[name].dtype == two[name].dtype
        if name != "solve_time":
            assert one[name].tobytes() == two[name].tobytes(), name
    assert one.metadata == two.metadata and left == right
    assert np.all(one["solve_time"] > 0)
    return Both(one, stops, flown[0])


def draw(seed, vehicle):
    """A plant, a controller, a path and the rest of a flight, all at random but for what would be compiled anew."""
    rng = np.random.default_rng(seed)
    vehicle = with_rotors(vehicle)
    settings = MPCSettings(
        nodes=6,
        horizon=rng.uniform(0.5, 1.2),
        rate=float(rng.choice([20, 37, 50, 100])),
        first_node=float(rng.choice([0.0, 0.06])),
        position_weight=tuple(rng.uniform(5, 200, 3)),
        attitude_error=str(rng.choice(["plain", "body"])),
        distance_limit=float(rng.choice([0.3, 10.0])),
        feedforward=bool(rng.integers(2)),
    )
    residual = make_residual(str(rng.choice(["none", "linear_drag", "gp_per_axis"])), vehicle)
    believed = vehicle
    if rng.integers(2):  # bounds that are met, in the controller only: the plant is not compiled anew
        believed = replace(vehicle, thrust_max=vehicle.hover_thrust * rng.uniform(1.1, 1.6), thrust_min=1.0)
    controller = PredictiveController(ModelPredictiveController(believed, residual, settings, backend="compiled"))
    kind = rng.choice(["simplified", "blade_element", "from_model"])
    if kind == "simplified":
        effects = PlantEffects() if rng.integers(2) else PlantEffects(lift=rng.uniform(0, 0.02))
        plant = SimplifiedPlant(vehicle, effects, step=1e-3, backend="compiled")
    elif kind == "blade_element":
        changes = [PlantChange(float(t), payload=float(rng.uniform(0, 0.2))) for t in rng.uniform(0, 1.5, 2)]
        effects = BladeElementEffects(motor_lag=float(rng.choice([0.0, 0.02])))
        plant = BladeElementPlant(vehicle, BLADE, effects, step=2e-3, schedule=changes, backend="compiled")
    else:
        drag = linear_drag_residual(vehicle, (0.4, 0.3, 0.1))
        plant = FromModelPlant(vehicle, drag, step=1e-3, force_noise_density=0.02, backend="compiled")
    speed = rng.uniform(2, 6)
    paths = [
        Wander(rng, yaw=bool(rng.integers(2))),
        Circle(speed=speed, acceleration=speed / 2),
        Lemniscate(speed=speed, acceleration=speed / 2),
        Step(target=tuple(rng.normal(size=3)), step_time=0.3, duration=1.5),
    ]
    path = paths[rng.integers(len(paths))]
    options = {"seed": int(rng.integers(100)), "sensors": [LEI_LI] if rng.integers(2) else []}
    options["lost_distance"] = float(rng.choice([0.4, 10.0]))
    if rng.integers(2):
        options["start"] = near(np.r_[path.flat_output(np.zeros(1)).position[0, 0], 1, np.zeros(9)], rng, 0.1)
        options["start"][3:7] *= rng.choice([-1, 1])
    return plant, controller, path, options


# Of 24 draws those with nearly all pairs of plant, residual, path, sensor, bounds and settings; by default every second
# of them, with every plant, residual, path and setting.
FEW = (0, 1, 3, 4, 7, 12, 13, 15, 16, 17, 18, 20, 21, 23)


@compiled
@pytest.mark.parametrize("seed", [*FEW[::2], *slow(*FEW[1::2])])
def test_any_flight(monkeypatch, vehicle, seed):
    plant, controller, path, options = draw(seed, vehicle)
    both(monkeypatch, plant, controller, path, **options)


@compiled
@pytest.mark.slow
def test_any_flight_of_many(monkeypatch, vehicle):
    outcomes, active, in_c = set(), 0, 0
    for seed in (*set(range(24)).difference(FEW), *range(24, 174)):
        plant, controller, path, options = draw(seed, vehicle)
        found = both(monkeypatch, plant, controller, path, **options)
        outcomes.add(found.flight.outcome)
        active += int((found.flight["active"] > 0).sum())
        in_c += found.periods_in_c
    assert {"ok", "lost"} <= outcomes and active > 500 and in_c > 5_000


WORLD = [
    ConstantWind(velocity=(3.0, -1.0, 0.5)),
    Latency(latency=0.003, jitter=0.03, drop=0.1),
    StatedEstimate(position_noise=0.01, velocity_noise=0.03, attitude_noise=0.01, rate_noise=0.05, delay=0.006),
    Actuator(time_constant_up=0.01, time_constant_down=0.02, rotor_scale_std=0.02),
    Battery(capacity=0.1),
    RotorLoss(losses=({"rotor": 1, "t": 0.31, "factor": 0.95},)),
]


SEEDS, ALL = (9, 11, 15, 18), (0, 1, 2, 3, 4, 5)
EFFECTS = {"wind": (0,), "link": (1,), "estimate": (2,), "motors": (3, 4, 5)}
ONE_EACH = [*((seed, ALL) for seed in SEEDS), *zip(SEEDS, EFFECTS.values(), strict=True)]  # and all with every plant
MORE = [pair for pair in product(SEEDS, EFFECTS.values()) if pair not in ONE_EACH]


@compiled
@pytest.mark.parametrize(("seed", "effects"), [*ONE_EACH, *slow(*MORE)])
def test_any_flight_in_a_world(monkeypatch, vehicle, seed, effects):
    """The same with effects around the plant; the seeds bring the three plants."""
    plant, controller, path, options = draw(seed, vehicle)
    world = World(plant, [*(WORLD[i] for i in effects), *options["sensors"]])
    flight = both(monkeypatch, world, controller, path, **options).flight
    assert ("est_p_x" in flight.columns) == (2 in effects) and ("wind_x" in flight.columns) == (0 in effects)
    if 2 in effects:
        error = flight.stack(["est_p_x", "est_p_y", "est_p_z"]) - flight.stack(["p_x", "p_y", "p_z"])
        assert np.abs(error[0]).max() == 0 and 0.003 < np.abs(error[1:]).max() < 0.5
    if 0 in effects:
        assert np.array_equal(flight.stack(["wind_x", "wind_y", "wind_z"]), [[3.0, -1.0, 0.5]] * len(flight.t))


@compiled
@pytest.mark.parametrize("first_node", [0.0, 0.04])
def test_with_the_references_thrust_within_the_nodes(monkeypatch, vehicle, first_node):
    """The horizon's reference then has more rows than the prediction has nodes; bounds are met on the way."""
    controller = mpc(replace(vehicle, thrust_max=3.2), "linear_drag", first_node=first_node, input_hold="deviation")
    plant = SimplifiedPlant(vehicle, PlantEffects(), step=1e-3, backend="compiled")
    found = both(monkeypatch, plant, controller, Lemniscate(speed=5.0, acceleration=2.5))
    assert found.periods_in_c > 100 and (found.flight["active"] > 0).any()


@compiled
@pytest.mark.parametrize("seed", [9, 11, 15])
def test_any_flight_with_a_load_in_turbulence(monkeypatch, vehicle, seed):
    """And with weak rotors, a push and the ground."""
    plant, controller, path, options = draw(seed, vehicle)
    effects = [
        Dryden(velocity=(2.0, 1.0, 0.0), intensity=(1.0, 1.0, 0.5)),
        SlungLoad(mass=0.1, length=0.5, point=(0.02, 0.0, -0.05), stretch=0.02),
        TrueVehicle(thrust_coefficient=0.95, torque_coefficient=1.1),
        Disturbance(force=(0.5, 0.0, 0.2), torque=(0.0, 0.01, 0.0), onset=0.2, duration=0.3),
        GroundEffect(rotor_radius=0.12),
    ]
    flight = both(monkeypatch, World(plant, [*effects, *options["sensors"]]), controller, path, **options).flight
    assert {"wind_x", "load_z"} < flight.columns.keys()
    assert np.std(flight["wind_x"]) > 0.01


def mpc(vehicle, residual="none", **settings):
    settings = MPCSettings(nodes=6, **settings)
    air = make_residual(residual, vehicle) if isinstance(residual, str) else residual
    return PredictiveController(ModelPredictiveController(vehicle, air, settings, backend="compiled"))


@compiled
class TestWhereItHandsOver:
    def plant(self, vehicle, **effects):
        return SimplifiedPlant(vehicle, replace(PlantEffects.none(), **effects), step=1e-3, backend="compiled")

    def test_an_ordinary_flight_is_flown_in_one_piece(self, monkeypatch, vehicle):
        """All but the first control period, over several blocks of noise."""
        path = Circle(speed=4.0, acceleration=2.0)
        found = both(monkeypatch, SimplifiedPlant(vehicle, step=1e-3, backend="compiled"), mpc(vehicle), path)
        samples = len(found.flight.t)
        assert samples > BLOCK and found.handed_over == [(samples, False)]

    def test_bounds_are_met_in_c(self, monkeypatch, vehicle):
        """A jump of three metres at thrusts of at most 1.3 of hover."""
        weak = replace(vehicle, thrust_max=1.3 * vehicle.hover_thrust)
        path = Step(target=(2.0, 1.0, 2.0), duration=2.0, step_time=0.3)
        found = both(monkeypatch, self.plant(vehicle), mpc(weak), path)
        assert found.handed_over == [(len(found.flight.t), False)]
        assert (found.flight["active"] > 0).sum() > 10 and set(found.flight["status"]) <= {0, 1}

    def test_large_turns_are_shortened_in_c(self, monkeypatch, vehicle):
        """Upside down at the start: the guess turns further than its model holds for some steps."""
        start = np.r_[0, 0, 2.0, 0.05, 0.9987, 0, 0, np.zeros(6)]
        monkeypatch.setattr(compiled_loop, "MAX_TURN", turn := 0.02)
        monkeypatch.setattr("quadexp.control.mpc.mpc.MAX_TURN", turn)
        plant, controller = self.plant(vehicle), mpc(vehicle)
        reference = SampledReference(Hover(duration=1.0), controller)
        flights = []
        for covering in (covers, lambda *_: False):
            monkeypatch.setattr(rollout, "covers", covering)
            flights.append(fly(plant, controller, reference, np.random.default_rng(0), start=start))
        for name in flights[0].columns:
            assert name == "solve_time" or flights[0][name].tobytes() == flights[1][name].tobytes(), name

    @pytest.mark.parametrize("sign", [1, -1])
    def test_either_side_of_the_quaternions(self, monkeypatch, vehicle, sign):
        """q and -q are one attitude: the reference is turned to the vehicle's side at every step, or at none."""
        path = Wander(np.random.default_rng(3), size=2.0)
        path.amplitude[3], path.rate[3] = 2.0, 1.5
        flat = path.flat_output(np.zeros(1))
        half = flat.yaw[0, 0] / 2
        start = np.r_[flat.position[0, 0], sign * np.r_[np.cos(half), 0, 0, np.sin(half)], flat.position[0, 1], 0, 0, 0]
        found = both(monkeypatch, self.plant(vehicle), mpc(vehicle, "linear_drag"), path, start=start)
        assert found.flight.outcome == "ok" and found.handed_over[-1] == (len(found.flight.t), False)
        sides = (found.flight.stack(list(Q)) * found.flight.stack([f"ref_{q}" for q in Q])).sum(axis=1)
        assert (sign * sides > 0).mean() > 0.9

    def test_lost_in_flight(self, monkeypatch, vehicle):
        path = Step(target=(3.0, 0.0, 0.0), duration=2.0, step_time=0.5)
        found = both(monkeypatch, self.plant(vehicle), mpc(vehicle), path, lost_distance=2.0)
        assert found.flight.outcome == "lost"
        assert found.flight.metadata["cause"].endswith(" m from the reference at t=0.50 s")
        assert found.handed_over == [(25, False)]

    def test_beyond_the_reach_python_shifts_the_reference(self, monkeypatch, vehicle):
        path = Step(target=(3.0, 0.0, 0.0), duration=2.0, step_time=0.5)
        found = both(monkeypatch, self.plant(vehicle), mpc(vehicle, distance_limit=2.0), path)
        stops = [k for k, _ in found.handed_over]
        assert found.flight.outcome == "ok" and stops[:2] == [25, 26] and stops[-1] == len(found.flight.t)

    def test_a_step_that_fails(self, monkeypatch, vehicle):
        """A residual that is no number above 2 m/s."""
        z, theta = ca.SX.sym("z", 10), ca.SX.sym("theta", 0)
        outputs = ca.vertcat(ca.sqrt(2.0 - z[0]) - 1.2, 0, 0, 0, 0, 0)
        ends = symbolic_residual("ends", outputs, z, theta, np.empty(0))
        controller = mpc(vehicle, ends, feedforward=False)
        found = both(monkeypatch, self.plant(vehicle), controller, Circle(speed=6.0, acceleration=2.0))
        assert found.flight.outcome == "solver_failed" and found.flight["status"][-1] == 3
        assert found.handed_over == [(len(found.flight.t) - 1, False)] and len(found.flight.t) > 10

    def test_changes_of_the_plant_come_in_their_time(self, monkeypatch, lei_li, blade):
        changes = [PlantChange(0.5, payload=0.2), PlantChange(0.9, lift_scale=(1, 1, 1, 0.9))]
        plant = BladeElementPlant(lei_li, blade, step=1e-3, schedule=changes, backend="compiled")
        found = both(monkeypatch, plant, mpc(lei_li), Hover(duration=2.0))
        assert found.handed_over == [(25, True), (45, True), (len(found.flight.t), False)]

    @pytest.mark.parametrize(
        ("sink", "target", "weight", "outcome"), [(11.0, 10.0, 10.0, "ok"), (8.0, 30.0, 100.0, "lost")]
    )
    def test_a_plant_in_doubt(self, monkeypatch, lei_li, blade, sink, target, weight, outcome):
        """A fall through the rotors' own wake: the safe solver flies, or the model has no answer."""
        plant = BladeElementPlant(lei_li, blade, step=1e-3, backend="compiled")
        path = Step(start=(0, 0, 0), target=(0.0, 0.0, -target), duration=3.0, step_time=0.1)
        start = np.r_[0, 0, 0, 1, 0, 0, 0, 1.5, 0, -sink, 0, 0, 0]
        controller = mpc(lei_li, distance_limit=100.0, position_weight=(weight,) * 3)
        found = both(monkeypatch, plant, controller, path, lost_distance=200.0, start=start)
        assert found.flight.outcome == outcome and (5, True) in found.handed_over
        assert outcome == "ok" or "blade-element model, rotor" in found.flight.metadata["cause"]
        assert outcome == "lost" or found.periods_in_c > 50

    def test_a_reference_beyond_all_numbers_is_left_to_python(self, vehicle):
        controller, plant = mpc(vehicle), self.plant(vehicle)
        reference = SampledReference(Hover(duration=0.2), controller)
        with pytest.raises(Exception, match="the reference is not finite"):
            fly(plant, controller, Broken(reference), np.random.default_rng(0))


# Controllers with what is around them, and worlds in which their readings are late, noisy, or of rotor speeds too.
SPEEDS = ("vehicle.thrust_coefficient=1.2e-5", "actuator=speed_lag_30ms")
SCALES = (
    "observer=disturbance observer.scale_walk=0.005 observer.air_walk=0.01 observer.torque_bandwidth=0 rate_loop=indi"
)
REMEDIES = {
    "geometric": (),
    "geometric controller.force_adaptation=2": (),
    "pid": (),
    "dfbc": (),
    "dfbc observer=disturbance": SPEEDS,
    "geometric observer=disturbance rate_loop=indi rate_loop.rate=500 observer.torque_bandwidth=0": (),
    "perfect_mpc observer=wind": ("wind=gust",),
    "nominal_mpc observer=disturbance observer.scale_walk=0.1 horizon=stiff": ("wind=gust",),
    f"perfect_mpc {SCALES}": SPEEDS,
    "perfect_mpc remedies=auto": ("world=everything",),
    "nominal_mpc remedies=auto": (*SPEEDS, "sensor=high", "estimator=late"),
    "dfbc remedies=auto": ("world=only_late_estimate",),
    "perfect_mpc controller.dead_time=0.03 horizon=robust": ("link=latency", "link.latency=0.03"),
    "perfect_mpc controller.dead_time=0.02 controller.motor_lead=0.03 horizon=robust observer=wind": (
        "actuator=lag_30ms", "link=latency", "link.latency=0.02",
    ),
    "nominal_mpc controller.motor_lag=0.03": ("actuator=lag_30ms",),
    "perfect_mpc delay=strapdown delay.time=0.03": ("estimator=late", "estimator.delay=0.03"),
    "perfect_mpc delay=prediction delay.time=0.03 observer=disturbance": ("estimator=late", "estimator.delay=0.03"),
    "geometric adaptive=l1": ("truth.mass=1.2",),
    "perfect_mpc observer=wind horizon=firm": ("world=outdoor_breeze",),
    "geometric observer=disturbance": ("world=indoor_mocap",),
    "nominal_mpc observer=disturbance delay=strapdown rate_loop=indi observer.torque_bandwidth=0": (
        "world=race", "vehicle.thrust_coefficient=1.2e-5", "controller.rate=100",
    ),
    "nominal_mpc adaptive=l1 rate_loop=indi rate_loop.rate=300 controller.rate=100": ("truth.mass=1.2",),
    "perfect_mpc rate_loop=indi rate_loop.rate=300 controller.rate=100": ("sensor=lei_li",),
    "nominal_mpc rate_loop=indi observer=disturbance observer.torque_bandwidth=0 controller.rate=100": (
        *SPEEDS, "sensor=high", "sensor.rotor_speed_jitter=0.005", "sensor.rotor_speed_drop=0.1",
        "sensor.rotor_speed_rate=250", "sensor.accelerometer_vibration=[0.5,0.5,0.5]", "estimator.delay=0.003",
        "sensor.accelerometer_cutoff=80", "sensor.gyroscope_cutoff=80", "sensor.pose_rate=90",
    ),
}  # fmt: skip


@compiled
@pytest.mark.parametrize("flown", REMEDIES)
def test_any_controller_with_what_is_around_it(monkeypatch, flown):
    path = "trajectory=ellipse trajectory.speed=4 trajectory.acceleration=4 trajectory.duration=3"
    world = [*path.split(), *REMEDIES[flown]]
    if not any(word.startswith(("sensor=", "world=")) for word in world):
        world.append("sensor.accelerometer_noise=[0.05,0.05,0.05]")
    given = [f"controller={flown.split()[0]}", *flown.split()[1:], *world]
    loop = build_loop(compose([*given, *["controller.allow_unstable=true"] * ("mpc" in flown)]), None)
    path = build_trajectory(compose(world).trajectory, loop.vehicle)
    made = both(monkeypatch, loop.plant, loop.controller, path)
    # A decision of auto, every 0.1 s and so in one period of five, is Python's, and so are its looks as it begins.
    least = 0.7 if "auto" in flown else 0.9
    assert made.periods_in_c > least * len(made.flight)


class Broken:
    """A reference whose last instant is not finite."""

    def __init__(self, reference):
        state = reference.reference.state.copy()
        state[-1, 8] = np.nan
        reference.reference = replace(reference.reference, state=state)
        self.reference = reference

    def __getattr__(self, name):
        return getattr(self.reference, name)

    def __len__(self):
        return len(self.reference)


LAGGING: dict[str, Any] = {"step": 1e-3, "time_constant": 0.03, "drag": (0.3, 0.3, 0.1)}


class TestWhatItCovers:
    def test_compiled_parts_of_this_program(self, vehicle):
        rng, plant, controller = np.random.default_rng(0), SimplifiedPlant(vehicle, step=1e-3), mpc_of_any_kind(vehicle)
        assert covers(plant, controller, rng) == (compiler() is not None)
        assert not covers(SimplifiedPlant(vehicle, backend="interpreted"), controller, rng)
        assert not covers(plant, mpc_of_any_kind(vehicle, backend="interpreted"), rng)

    @compiled
    def test_nothing_that_it_does_not_know(self, vehicle):
        rng, plant, controller = np.random.default_rng(0), SimplifiedPlant(vehicle, step=1e-3), mpc(vehicle)

        class OwnPlant(SimplifiedPlant):
            def advance(self, x, u, duration, rng):
                return super().advance(x, 0.9 * u, duration, rng)

        class OwnController(PredictiveController):
            """As its parent."""

        class OwnStep(PredictiveController):
            def step(self, measurement, window):
                return super().step(measurement, window)

        assert covers(plant, controller, rng)
        assert not covers(OwnPlant(vehicle, step=1e-3), controller, rng)
        assert covers(plant, OwnController(controller.mpc), rng)
        assert not covers(plant, OwnStep(controller.mpc), rng)
        assert not covers(plant, controller, object())
        learning = ["controller=online_mpc", "controller.residual=[terms]"]
        assert not covers(plant, build_controller(compose(learning), vehicle, None, None), rng)

    @compiled
    def test_inner_states_that_are_no_columns_are_not_logged(self, vehicle, monkeypatch):
        """A plant from outside on the shared integrator, with inner states: the same flight, and no memory overrun."""
        monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
        from motor_lag import MotorLagPlant

        class Named(MotorLagPlant):
            @property
            def rotor_speed(self):
                return 100.0 + self.wrapped

        assert covers(MotorLagPlant(vehicle, **LAGGING), mpc(vehicle), np.random.default_rng(0))
        assert not covers(Named(vehicle, **LAGGING), mpc(vehicle), np.random.default_rng(0))
        flown = both(monkeypatch, MotorLagPlant(vehicle, **LAGGING), mpc(vehicle), Circle(speed=4.0))
        assert flown.periods_in_c > 100 and "rotor_speed_0" not in flown.flight.columns

    def test_parts_from_outside_fly_as_before(self, vehicle):
        """A plant that only looks like one, under a controller that only looks like one."""

        class Still:
            def __init__(self, vehicle):
                self.vehicle = vehicle

            def reset(self):
                pass

            def advance(self, x, u, duration, rng):
                return x + 1e-3 * rng.standard_normal(13), np.zeros(3)

            def residual(self):
                raise NotImplementedError

        controller = mpc_of_any_kind(vehicle)
        flight = fly(
            Still(vehicle), controller, SampledReference(Hover(duration=0.5), controller), np.random.default_rng(0)
        )
        rng, x = np.random.default_rng(0), flight.stack(["p_x", "p_y", "p_z"])[0]
        for row in flight.stack(["p_x", "p_y", "p_z"])[1:]:
            x = x + 1e-3 * rng.standard_normal(13)[:3]
            assert np.array_equal(row, x)


def mpc_of_any_kind(vehicle, backend="auto"):
    return PredictiveController(
        ModelPredictiveController(vehicle, make_residual("none", vehicle), MPCSettings(nodes=6), backend=backend)
    )
