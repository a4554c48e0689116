"""Flights on the filter's estimate instead of the truth: every airframe, every controller, every set of sensors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.errors import UsageError
from quadexp.experiment.evaluate import fly_one
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.log.schema import describe
from quadexp.parts.compose import compose
from quadexp.plugins.worlds.eskf import N_COVARIANCE, N_NOMINAL, Navigation
from quadexp.plugins.worlds.gnss import ImuGnss
from quadexp.plugins.worlds.motion_capture import ImuMocap
from quadexp.reference.circle import Circle
from quadexp.reference.hover import Hover
from quadexp.world import PlantEffects, SimplifiedPlant
from quadexp.world.constant_wind import ConstantWind
from quadexp.world.world import World
from tests.experiment.test_compiled_flight import both, compiled, draw
from tests.models.residuals import make_residual, with_rotors
from tests.plugins.worlds.aided_flights import errors, full
from tests.world.airframes import AIRFRAMES, airframe

SENSORS = {"imu_mocap": ImuMocap(), "imu_gnss": ImuGnss()}
PATHS = {"hover": Hover(duration=1.5), "circle": Circle(speed=3.0, acceleration=1.5, radius=2.0)}
each_sensor = pytest.mark.parametrize("sensors", SENSORS)


def one_and_slow(*combinations, first=2):
    """Each compiles a world of its own: the first ones by default."""
    rest = [pytest.param(one, marks=pytest.mark.slow) for one in combinations[first:]]
    return pytest.mark.parametrize(
        "combination", [*combinations[:first], *rest], ids=lambda one: "-".join(map(str, one))
    )


def flown(plant, vehicle, path, residual="none", seed=0, **settings):
    model = plant.residual() if residual == "plant" else make_residual(residual, vehicle)
    settings = MPCSettings(nodes=6, **settings)
    controller = PredictiveController(ModelPredictiveController(vehicle, model, settings, backend="interpreted"))
    return fly(plant, controller, SampledReference(path, controller), np.random.default_rng(seed))


def stack(flight, *kinds, prefix=""):
    return flight.stack([f"{prefix}{kind}_{axis}" for kind in kinds for axis in "xyz"])


@each_sensor
@pytest.mark.parametrize("kind", AIRFRAMES)
@pytest.mark.parametrize("path", PATHS)
def test_every_airframe_flies_on_the_estimate(vehicle, sensors, kind, path):
    """The errors given are those that the filter states; it is given a little later, which costs a little."""
    vehicle = with_rotors(vehicle)
    world = World(airframe(kind, vehicle), [SENSORS[sensors], Navigation()])
    flight = flown(world, vehicle, PATHS[path])
    assert flight.outcome == "ok"
    error = stack(flight, "p", "v", "bias_a", "bias_g") - stack(flight, "p", "v", "bias_a", "bias_g", prefix="est_")
    stated = stack(flight, "p", "v", "bias_a", "bias_g", prefix="est_var_")
    normal = np.mean(error[10:] ** 2 / stated[10:], axis=0)
    assert 0.3 < normal.mean() < 3 and normal.max() < 12
    rates = stack(flight, "w") - stack(flight, "w", prefix="est_")
    assert 0 < np.sqrt(np.mean(rates[10:] ** 2)) < 0.1
    assert all(describe(name).description for name in flight.columns)


@each_sensor
@pytest.mark.parametrize("residual", ["linear_drag", "gp_per_axis", "plant"])
def test_every_controller_flies_on_the_estimate(vehicle, sensors, residual):
    plant = SimplifiedPlant(vehicle, step=1e-3, backend="interpreted")
    flight = flown(World(plant, [SENSORS[sensors], Navigation()]), vehicle, PATHS["circle"], residual)
    assert flight.outcome == "ok"
    assert np.linalg.norm(stack(flight, "p") - stack(flight, "p", prefix="est_"), axis=1)[10:].mean() < 0.04


def test_without_errors_of_sensors_the_flight_is_nearly_the_one_on_the_truth(vehicle):
    none = {name: 0.0 for name in vars(ImuMocap()) if name.endswith(("density", "std", "walk", "delay", "dropout"))}
    exact = ImuMocap(**none, pose_position_noise=1e-8, pose_attitude_noise=1e-8, imu_rate=500.0)
    found = []
    for effects in ([], [exact, Navigation()]):
        plant = SimplifiedPlant(vehicle, step=1e-3, backend="interpreted")
        found.append(flown(World(plant, effects) if effects else plant, vehicle, PATHS["circle"]))
    truth, told = found
    assert np.abs(stack(truth, "p") - stack(told, "p")).max() < 2e-3
    assert np.abs(stack(told, "p", "v") - stack(told, "p", "v", prefix="est_")).max() < 1e-4


def test_controllers_are_given_the_imus_reading(vehicle):
    """In hover: gravity and the bias of the flight, with the noise of a reading, density / sqrt(interval)."""
    plant = SimplifiedPlant(vehicle, PlantEffects.none(), step=1e-3, backend="interpreted")
    flight = flown(World(plant, [ImuMocap(accelerometer_bias_std=0.5)]), vehicle, Hover(duration=4.0))
    reading = (stack(flight, "acc") - stack(flight, "bias_a"))[1:]
    assert np.abs(stack(flight, "bias_a")).max() > 0.1
    assert np.allclose(reading.mean(0), [0, 0, vehicle.gravity], atol=0.05)
    assert np.isclose(np.std(np.diff(reading[:, 2])) / np.sqrt(2), 2e-3 * np.sqrt(200), rtol=0.15)
    assert np.array_equal(stack(flight, "p", "v"), stack(flight, "p", "v", prefix="est_"))  # no estimator: the truth


def test_the_filter_moves_with_the_wind_and_does_not_know_of_it(vehicle):
    """An IMU feels whatever acts: in a wind of 4 m/s the estimate is as good as in still air."""
    found = []
    for effects in ([], [ConstantWind(velocity=(4.0, -2.0, 0.0))]):
        plant = SimplifiedPlant(vehicle, step=1e-3, backend="interpreted")
        flight = flown(World(plant, [*effects, ImuMocap(), Navigation()]), vehicle, PATHS["circle"])
        found.append(stack(flight, "p", "v") - stack(flight, "p", "v", prefix="est_"))
    still, windy = (np.sqrt(np.mean(error[10:] ** 2, axis=0)) for error in found)
    assert np.allclose(still, windy, rtol=0.1)


@compiled
@one_and_slow(*((sensors, kind) for kind in AIRFRAMES for sensors in ("imu_gnss", "imu_mocap")), first=1)
def test_errors_in_flight_are_those_that_the_filter_believes(vehicle, combination):
    """NEES of 50 flights of a second under thrusts around hover, within its 95 % band; noise of the plant and all."""
    sensors, kind = combination
    prompt = {name: 0.0 for name in vars(SENSORS[sensors]) if name.endswith("delay")}
    plant = airframe(kind, with_rotors(vehicle))
    plant.backend = "compiled"
    world, found = World(plant, [replace(SENSORS[sensors], **prompt), Navigation()]), []
    for seed in range(50):
        x = np.r_[0, 0, 1, 1, np.zeros(9)]
        rng = np.random.default_rng(seed)
        streams = world.begin(x, 0.02, 1.0, rng)
        thrusts = vehicle.hover_thrust * (1 + 0.05 * rng.spawn(1)[0].standard_normal((50, vehicle.n_rotors)))
        for u in thrusts:
            x, _ = world.advance(x, u, 0.02, streams)
        columns = world.columns(0.02)
        bias = world.inner[[columns[f"bias_{kind}_{axis}"] for kind in "ag" for axis in "xyz"]]
        first = columns["est_bias_a_x"] - 10
        known = world.inner[first : first + N_NOMINAL + N_COVARIANCE]
        e = errors(known[None, :N_NOMINAL], x[None], bias[None])[0]
        found.append(e @ np.linalg.solve(full(known[None, N_NOMINAL:])[0], e))
    low, high = chi2.interval(0.95, 15 * 50)
    assert low < sum(found) < high


@compiled
@one_and_slow(
    ("imu_mocap", 9), ("imu_gnss", 15), ("imu_gnss", 9), ("imu_mocap", 11), ("imu_gnss", 11), ("imu_mocap", 15)
)
def test_the_flight_in_c_is_the_flight_in_python(monkeypatch, vehicle, combination):
    sensors, seed = combination
    plant, controller, path, options = draw(seed, vehicle)
    both(monkeypatch, World(plant, [SENSORS[sensors], Navigation()]), controller, path, **options | {"sensors": ()})


def test_options_compose_and_what_cannot_be_is_refused():
    settings = ["trajectory=hover", "trajectory.duration=0.2", "controller.backend=interpreted"]
    settings += ["plant.backend=interpreted", "estimator=eskf"]
    flight = fly_one(compose([*settings, "sensor=imu_gnss", "sensor.gnss_rate=7.3", "estimator.process_factor=2"]))
    assert flight.outcome == "ok" and np.abs(stack(flight, "p") - stack(flight, "p", prefix="est_")).max() > 0
    with pytest.raises(UsageError, match="estimator=eskf: needs inertial sensors: sensor=imu_mocap or sensor=imu_gnss"):
        fly_one(compose(settings))
    with pytest.raises(UsageError, match=r"sensor.imu_rate=4000: the plant makes 2000 integration steps a second"):
        fly_one(compose([*settings, "sensor=imu_mocap", "sensor.imu_rate=4000"]))
    with pytest.raises(UsageError, match=r"sensor.pose_rate=250: must be at most sensor.imu_rate=200 Hz"):
        fly_one(compose([*settings, "sensor=imu_mocap", "sensor.pose_rate=250"]))
