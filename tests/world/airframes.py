"""Three airframes without a world, and open-loop flights of any plant."""

from dataclasses import replace

import numpy as np

from quadexp.models.linear_drag import linear_drag_residual
from quadexp.physics.state import ATTITUDE
from quadexp.plugins.identification.from_model import FromModelPlant
from quadexp.plugins.papers.lei_li.plant import BladeElementEffects, BladeElementPlant
from quadexp.world import PlantEffects, SimplifiedPlant
from quadexp.world.streams import Sampled
from tests.models.residuals import BLADE, with_rotors

REST = np.r_[np.zeros(3), 1, np.zeros(9)]
PERIOD, STEP = 0.02, 1e-3
AIRFRAMES = ("simplified", "blade_element", "from_model")


def airframe(kind, vehicle, *, noise=True):
    vehicle = with_rotors(vehicle)
    if kind == "simplified":
        effects = PlantEffects() if noise else replace(PlantEffects(), motor_noise_density=0.0, force_noise_density=0.0)
        return SimplifiedPlant(vehicle, effects, step=STEP, backend="interpreted")
    if kind == "blade_element":
        lagging = BladeElementEffects(motor_lag=0.02)
        return BladeElementPlant(vehicle, BLADE, lagging, step=STEP, method="rk4", backend="interpreted")
    drag = linear_drag_residual(vehicle, (0.4, 0.3, 0.1))
    return FromModelPlant(vehicle, drag, step=STEP, force_noise_density=0.02, backend="interpreted")


def ideal(vehicle, step=1e-3):
    """The nominal rigid body."""
    return SimplifiedPlant(vehicle, PlantEffects.none(), step=step, backend="interpreted")


def commands(vehicle, periods, seed=0):
    """Thrusts around hover, (periods, n)."""
    return vehicle.hover_thrust * (1 + 0.05 * np.random.default_rng(seed).standard_normal((periods, vehicle.n_rotors)))


def start(seed=0):
    x = np.random.default_rng(seed).normal(size=13)
    x[ATTITUDE] = [0.98, 0.1, -0.1, 0.15]
    x[ATTITUDE] /= np.linalg.norm(x[ATTITUDE])
    x[10:] *= 0.2
    return x


def fly(plant, x, thrusts, seed=1):
    """States (k + 1, 13), readings (k, 3), measured (k + 1, 13) under open-loop commands (k, n)."""
    rng = plant.begin(x, PERIOD, PERIOD * len(thrusts), np.random.default_rng(seed))
    states, readings, told = [x], [], [x]
    for u in thrusts:
        x, reading = plant.advance(x, u, PERIOD, rng)
        states.append(x)
        readings.append(reading)
        told.append(getattr(plant, "measured", x))
    return np.array(states), np.array(readings), np.array(told)


def sampled(rng, times, numbers):
    """Standard normal numbers (k, numbers) at some times (k,) (s)."""
    return Sampled(numbers, (0.0,)).begin(rng)(times, 0.0)
