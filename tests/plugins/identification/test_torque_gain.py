"""The gain of the torque where disturbances move the commands, and a plant that turns by it."""

import numpy as np
import pytest

from quadexp import requests
from quadexp.plugins.identification import torque
from quadexp.plugins.identification.recorded import read_recorded
from quadexp.plugins.identification.torque_gain import TorqueGain, prediction_error
from quadexp.plugins.logs.samples import gather_to_fit
from tests.models.logged_flights import logged_flight
from tests.models.recorded_flights import crazyflie
from tests.plugins.identification.test_torque import GAIN, turning
from tests.slow import slow

IDEAL = ["plant.motor_loss=0"]  # so that the vehicle file is the truth
MOTORS = "plant.motor_noise_density=0.00224"  # five times the usual
RANDOM = ["trajectory=random", "trajectory.speed=4", "controller=geometric"]
WORLDS = {
    "motors": ["trajectory=circle", "trajectory.radius=3", "trajectory.speed=3", "controller=geometric", MOTORS],
    "torque": [*RANDOM, "plant.torque_noise_density=0.00112"],  # ten times
    "mpc": ["trajectory=lemniscate", "trajectory.speed=3", "controller=nominal_mpc", MOTORS],
    "lag": [*RANDOM, MOTORS, "actuator=first_order"],
}


@pytest.mark.parametrize("axis", [0, 2, *slow(1)])
def test_strong_disturbances_do_not_bias_it(axis):
    """Ten times the noise of test_torque.py, three groups of flights: the band is off where this is not."""
    ratios = []
    for first in (0, 10, 20):
        data = [turning(first + seed, noise=2.0) for seed in range(3)]
        gain, half, _ = prediction_error(data, axis)
        assert abs(gain - GAIN[axis]) < 2 * half
        ratios.append(gain / GAIN[axis])
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.05)


def gain_of(folder, words, seeds) -> TorqueGain:
    files = [folder / f"{seed}.parquet" for seed in seeds]
    for seed, file in zip(seeds, files, strict=True):
        requests.simulate([*words, *IDEAL, f"seed={seed}"], file)
    flights = [read_recorded(file) for file in files]
    vehicle = torque.own_vehicle(flights[0], None)
    names = [file.stem for file in files]
    return torque.torque_gain(torque.torque_data(flights, names, vehicle, gather_to_fit(flights, None, names)), vehicle)


@pytest.mark.parametrize("world", WORLDS)
def test_the_truth_is_in_the_interval(tmp_path, world):
    gain = gain_of(tmp_path, WORLDS[world], [301, 302])
    assert np.all((gain.low < 1) & (gain.high > 1)), gain


@pytest.mark.slow
def test_the_truth_is_in_the_interval_in_twenty_repetitions(tmp_path):
    """Four kinds of disturbed flights, five pairs of seeds each; 60 intervals of 95 %."""
    inside = []
    for number, words in enumerate(WORLDS.values()):
        for pair in range(5):
            folder = tmp_path / f"{number}_{pair}"
            folder.mkdir()
            first = 1000 + 100 * number + 2 * pair
            gain = gain_of(folder, words, [first, first + 1])
            inside += ((gain.low < 1) & (gain.high > 1)).tolist()
    assert np.mean(inside) >= 0.9


def test_a_plant_turns_by_it_where_it_is_known():
    """Roll 20 % more, pitch 10 % less, yaw not known: the file's."""
    from msgspec.structs import replace

    from quadexp.plugins.identification.vehicle_model import fit_vehicle_model

    vehicle = crazyflie()
    known = TorqueGain(np.array([1.2, 0.9, 1.5]), np.array([1.1, 0.8, 0.4]), np.array([1.3, 1.0, 2.6]))
    assert known.used == [1.2, 0.9, None]
    model = replace(fit_vehicle_model([logged_flight(seed) for seed in range(2)]), torque=known)
    residual, u = model.residual(vehicle, part="linear"), np.array([0.05, 0.06, 0.08, 0.07])
    by_file = vehicle.allocation[1:] @ u
    assert residual(np.r_[np.zeros(6), u])[0, 3:] == pytest.approx([0.2 * by_file[0], -0.1 * by_file[1], 0.0])


def test_the_yaw_of_motor_commands_is_not_taken():
    """However narrow its interval: the rotors' own inertia turns the vehicle too."""
    numbers = np.array([1.2, 0.9, 0.08]), np.array([1.1, 0.8, 0.079]), np.array([1.3, 1.0, 0.081])
    assert TorqueGain(*numbers).used == [1.2, 0.9, 0.08]
    of_commands = TorqueGain(*numbers, of_commands=True)
    assert of_commands.used == [1.2, 0.9, None]
    assert "yaw 0.08 [0.079, 0.081] (motor commands do not tell it: the file's is used)" in str(of_commands)


@pytest.mark.parametrize("factor", [0.8, 1.5, *slow(1.25)])
def test_another_inertia_is_found_and_flown(tmp_path, factor):
    """The vehicle file's inertia is wrong by this factor: gain 1 / factor, in the model that identify stores."""
    words = ["trajectory=random", "trajectory.speed=6", "controller=geometric", *IDEAL]
    words += [f"truth.inertia=[{factor},{factor},{factor}]"]
    files = [tmp_path / f"{seed}.parquet" for seed in (1, 2)]
    for seed, file in zip((41, 42), files, strict=True):
        requests.simulate([*words, f"seed={seed}"], file)
    from quadexp.models.checkpoint import load_model
    from quadexp.plugins.identification import requests as learn

    report = learn.identify(files, tmp_path / "model", method="regression", settings={}, figures=False)
    assert [row["axis"] for row in report["torque"]] == ["roll", "pitch", "yaw"]
    for row in report["torque"]:
        assert row["low"] < 1 / factor < row["high"], row
        assert row["ratio"] == pytest.approx(1 / factor, rel=0.1)
    model = load_model(tmp_path / "model")
    assert model.torque.used == pytest.approx([1 / factor] * 3, rel=0.1)
    assert any(line.startswith("torque      over that of the vehicle file") for line in report["main"])
