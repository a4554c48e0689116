"""Torque of flights whose equation is known: gain, damping, flapping; and logs that do not show it."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.plugins.identification import torque
from quadexp.plugins.identification.torque import TorqueData
from quadexp.plugins.identification.turning import Turning
from tests.models.recorded_flights import crazyflie

H = 0.01  # s
GAIN = np.array([60000.0, 50000.0, 30000.0])  # rad/s^2 per N m
OFFSET, DAMPING, FLAPPING = np.array([3.0, -2.0, 0.5]), 4.0, np.array([1.5, -1.2])


@cache
def turning(seed: int, *, noise: float = 0.2, works: float = 1.0, seconds: float = 10.0) -> Turning:
    """The equation of the module, stepped: a loop follows wished rates, whose commands have a dither. works: share of
    the commands that the vehicle obeys."""
    rng = np.random.default_rng(seed)
    n = round(seconds / H)
    t = H * np.arange(n)
    wish = np.column_stack([np.sin(2.1 * t + phase) + np.sin(7.3 * t + 2 * phase) for phase in rng.uniform(0, 6, 3)])
    velocity = np.column_stack([2 * np.sin(0.9 * t + phase) for phase in rng.uniform(0, 6, 3)])
    spin = 1 + 0.1 * np.sin(1.7 * t)
    rate, sent = np.zeros((n + 1, 3)), np.zeros((n, 3))
    for k in range(n):
        sent[k] = (60.0 * (wish[k] - rate[k]) + 20 * rng.standard_normal(3)) / GAIN
        change = works * GAIN * sent[k] + OFFSET - DAMPING * spin[k] * rate[k]
        change[:2] += FLAPPING * spin[k] * velocity[k, [1, 0]]
        rate[k + 1] = rate[k] + H * (change + noise * rng.standard_normal(3) / np.sqrt(H))
    attitude = [Rotation.identity()]
    for k in range(n):
        attitude.append(attitude[-1] * Rotation.from_rotvec(H * (rate[k] + rate[k + 1]) / 2))
    return Turning(rate, Rotation.concatenate(attitude), sent, spin, velocity, seed, H)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_gain_is_found_within_its_interval(axis):
    model, half = torque.equation_error([turning(seed) for seed in range(3)], axis, torque.LOW)
    assert model.theta[0] == pytest.approx(GAIN[axis], rel=0.05)
    assert abs(model.theta[0] - GAIN[axis]) < 2 * half + 0.02 * GAIN[axis]
    assert model.damping == pytest.approx(DAMPING, abs=1.5)
    whole, _ = torque.equation_error([turning(seed) for seed in range(3)], axis, 0.0)
    assert whole.theta[0] == pytest.approx(GAIN[axis], rel=0.05)
    if axis < 2:
        assert whole.theta[2] == pytest.approx(FLAPPING[axis], rel=0.3)


def test_output_error_of_exact_flights_gives_the_constants():
    """Without noise every rollout is exact, and the search ends at the truth."""
    data = [turning(seed, noise=0.0) for seed in range(2)]
    for axis in range(3):
        model = torque.output_error(data, axis, motors=True)
        assert model.damping == pytest.approx(DAMPING, abs=0.1)
        assert model.theta[0] == pytest.approx(GAIN[axis], rel=0.02)
        assert model.theta[1] == pytest.approx(OFFSET[axis], abs=0.1)


def test_rollouts_of_the_true_constants_are_exact():
    data = turning(0, noise=0.0)
    true = [
        torque.AxisModel(np.array([GAIN[axis], OFFSET[axis], *FLAPPING[axis : axis + 1]]), DAMPING, motors=True)
        for axis in range(3)
    ]
    assert torque.attitude_errors(data, true).max() < 1e-6
    assert torque.attitude_errors(data, None).mean(axis=1)[1] > 0.05


def test_flights_with_motors_show_it_and_without_do_not():
    vehicle = crazyflie()
    shown = torque.judged(TorqueData(None, [[turning(seed) for seed in range(2)]]), vehicle)
    assert shown["shown"]
    assert torque.DOES_NOT_SHOW not in " ".join(shown["lines"])
    for row in shown["axes"]:
        assert row["model_rms"] < 0.6 * row["held_rms"]
    hidden = torque.judged(TorqueData(None, [[turning(seed, works=0.0, noise=3.0) for seed in range(2)]]), vehicle)
    assert not hidden["shown"]
    assert torque.DOES_NOT_SHOW in hidden["lines"][-1]


def test_the_vehicle_file_is_right_about_a_simulated_flight(tmp_path):
    """Through the command's own request: commands in N, the file's arms and inertia, a ratio of 1 on every axis."""
    from quadexp import requests

    words = [
        "trajectory=random", "trajectory.speed=6", "controller=geometric", "plant.quadratic_drag=[0,0,0]",
        "plant.motor_loss=0", "plant.motor_noise_density=0", "plant.torque_noise_density=0",
    ]  # fmt: skip
    files = [tmp_path / f"{seed}.parquet" for seed in (1, 2)]
    for seed, file in enumerate(files):
        requests.simulate([*words, f"seed={seed}"], file)
    report = torque.identify_torque(files, None)
    for row in report["axes"]:
        assert row["gain"] == pytest.approx(row["vehicle_file"], rel=0.1), row
    assert sorted(tmp_path.iterdir()) == files  # nothing is stored that a controller or a plant could take
