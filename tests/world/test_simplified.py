"""The simplified plant: noise as a density, drag's sign, motor loss, accelerometer, both back ends."""

import numpy as np
import pytest

from quadexp.physics.state import RATE, VELOCITY
from quadexp.world import PlantEffects, SimplifiedPlant

HOVER = np.r_[np.zeros(3), 1, np.zeros(9)]
QUIET = {"motor_noise_density": 0.0, "force_noise_density": 0.0, "torque_noise_density": 0.0}


def test_ideal_plant_hovers_for_ever(vehicle, rng):
    plant = SimplifiedPlant(vehicle, PlantEffects.none(), backend="interpreted")
    x, reading = plant.advance(HOVER, np.full(4, vehicle.hover_thrust), 1.0, rng)
    assert np.allclose(x, HOVER, atol=1e-14)
    assert np.allclose(reading, [0, 0, 9.81])


def test_ideal_plant_thrown_flies_a_parabola(vehicle, rng):
    """No effects: x(t) = v t - g t^2 / 2, an accelerometer at zero, thrusts that arrive in full, no noise."""
    plant = SimplifiedPlant(vehicle, PlantEffects.none(), backend="interpreted")
    x = HOVER.copy()
    x[VELOCITY] = v = np.array([3.0, -2.0, 4.0])
    after, reading = plant.advance(x, np.zeros(4), 0.1, rng)
    assert after[VELOCITY] == pytest.approx(v - [0, 0, 0.981], rel=1e-12)
    assert after[:3] == pytest.approx(0.1 * v - [0, 0, 9.81 * 0.005], rel=1e-12)
    assert reading == pytest.approx(np.zeros(3), abs=1e-14) and np.all(after[RATE] == 0)
    assert plant.advance(HOVER, np.full(4, 5.0), 0.1, rng)[1] == pytest.approx([0, 0, 20.0 / vehicle.mass], rel=1e-12)


def test_terminal_velocity(vehicle, rng):
    """Falling level with the rotors off, drag 0.08 v^2 balances gravity at v = sqrt(g / 0.08)."""
    plant = SimplifiedPlant(vehicle, PlantEffects(**QUIET), backend="interpreted")
    x, reading = plant.advance(HOVER, np.zeros(4), 12.0, rng)
    assert x[9] == pytest.approx(-np.sqrt(9.81 / 0.08), rel=1e-6)
    assert reading == pytest.approx([0, 0, 9.81], abs=1e-5)


def test_motor_loss_sinks_the_hover(vehicle, rng):
    plant = SimplifiedPlant(vehicle, PlantEffects((0,) * 3, (0,) * 3, **QUIET), backend="interpreted")
    x, _ = plant.advance(HOVER, np.full(4, vehicle.hover_thrust), 0.5, rng)
    loss = 4 * 20 * 0.1 * (vehicle.hover_thrust / 20 / 1.3) ** 2  # N, and m/s^2 at 1 kg
    assert x[9] == pytest.approx(-loss * 0.5, rel=1e-9)


@pytest.mark.parametrize("step", [5e-4, pytest.param(1e-4, marks=pytest.mark.slow), 2e-3])
def test_noise_does_not_depend_on_the_step(vehicle, step):
    """After a time T white acceleration of density s leaves a velocity with standard deviation s sqrt(T) / m."""
    effects = PlantEffects((0,) * 3, (0,) * 3, 0, 0, force_noise_density=0.02, torque_noise_density=0.001)
    plant, rng = SimplifiedPlant(vehicle, effects, step=step, backend="interpreted"), np.random.default_rng(1)
    u = np.full(4, vehicle.hover_thrust)
    x = np.array([plant.advance(HOVER, u, 0.04, rng)[0] for _ in range(1500)])
    assert x[:, VELOCITY].std(0) == pytest.approx(np.full(3, 0.02 * np.sqrt(0.04)), rel=0.07)
    assert x[:, RATE].std(0) == pytest.approx(0.001 * np.sqrt(0.04) / np.array([0.03, 0.03, 0.06]), rel=0.07)


def test_published_noise_amplitudes(vehicle):
    """At their 0.5 ms step the densities give the published 0.005 N, and 0.02 sqrt(u) of the normalised thrust."""
    effects = PlantEffects()
    assert effects.force_noise_density / np.sqrt(5e-4) == pytest.approx(0.005)
    assert effects.torque_noise_density / np.sqrt(5e-4) == pytest.approx(0.005)
    assert effects.motor_noise_density / np.sqrt(5e-4) == pytest.approx(0.02)
    plant = SimplifiedPlant(
        vehicle, PlantEffects((0,) * 3, (0,) * 3, 0.0, force_noise_density=0), backend="interpreted"
    )
    rng, u = np.random.default_rng(2), 5.0
    speed = np.array([plant.advance(HOVER, np.full(4, u), 5e-4, rng)[0][9] for _ in range(3000)])
    amplitude = np.sqrt(4) * 20 * 0.02 * np.sqrt(u / 20)  # N, four independent rotors
    assert speed.std() / 5e-4 == pytest.approx(amplitude, rel=0.05)
