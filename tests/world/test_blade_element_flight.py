"""The blade-element plant in flight: what it begins with and remembers, which periods it flies again, its words."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.errors import ModelDomainError
from quadexp.physics.state import VELOCITY
from quadexp.world.blade_element import BladeElementEffects, BladeElementPlant, PlantChange
from tests import paper

LEVEL = np.r_[np.zeros(3), 1, np.zeros(9)]
IDLE = np.zeros(4)


class Watched(BladeElementPlant):
    """Counts the periods flown again with the safe solver."""

    again = 0

    def in_doubt(self, function):
        self.again += 1
        return super().in_doubt(function)


def moving(velocity) -> np.ndarray:
    x = LEVEL.copy()
    x[VELOCITY] = velocity
    return x


@pytest.mark.parametrize("steps", [1, 2, 7])
def test_rotors_follow_their_command_whatever_the_step(lei_li, blade, steps):
    """w(t) = w_1 + (w_0 - w_1) exp(-t / tau), exact for a held command; odd and even numbers of steps alike."""
    plant = BladeElementPlant(
        lei_li, blade, BladeElementEffects(motor_lag=0.02), step=0.007 / steps, backend="interpreted"
    )
    before, target = plant.rotor_speed.copy(), np.sqrt(np.array([1.0, 2.0, 3.0, 4.0]) / lei_li.thrust_coefficient)
    for period in range(1, 4):
        plant.advance(LEVEL, np.array([1.0, 2.0, 3.0, 4.0]), 0.007)
        expected = target + (before - target) * np.exp(-0.007 * period / 0.02)
        assert plant.rotor_speed == pytest.approx(expected, rel=1e-12)


def test_changes_come_in_their_time(lei_li, blade):
    """A load taken up at 0.02 s and dropped at 0.04 s, in a flight of periods of 0.01 s from zero."""
    schedule = [PlantChange(0.04, payload=0.0), PlantChange(0.02, payload=0.5)]
    plant = BladeElementPlant(lei_li, blade, step=1e-3, schedule=schedule, backend="interpreted")
    readings = [plant.advance(LEVEL, np.full(4, lei_li.hover_thrust), 0.01)[1][2] for _ in range(6)]
    loaded = 9.81 * paper.M / (paper.M + 0.5)
    assert readings == pytest.approx([9.81, 9.81, loaded, loaded, 9.81, 9.81], rel=0.02)
    assert plant.time == pytest.approx(0.06)


@pytest.mark.parametrize("velocity", [(0, 0, 0), (9, -4, 1), (0, 0, 6), (12, 0, -4), (0.5, 0.5, -2)])
def test_ordinary_flight_is_flown_once(lei_li, blade, velocity):
    """Hover, cruise, climb, a dive at speed and a slow descent: the quick iteration is beyond doubt."""
    plant = Watched(lei_li, blade, backend="interpreted")
    for thrust in (0.5, 1.0, 2.0):
        plant.advance(moving(velocity), np.full(4, thrust * lei_li.hover_thrust), 0.01)
    assert plant.again == 0


@pytest.mark.parametrize("in_plane", [1.5, 3.0])
def test_flown_again_where_there_may_be_several_answers(lei_li, blade, in_plane):
    """Idling, V_I < V_z: g' = K (2 u^2 + V_z u + V_h^2) / sqrt(V_h^2 + u^2) + b has zeros only for V_z^2 > 8 V_h^2."""
    for ratio, again in ((2.8, 0), (2.86, 1)):
        plant = Watched(lei_li, blade, backend="interpreted")
        plant.advance(moving([in_plane, 0, -ratio * in_plane]), IDLE, 1e-4)
        assert np.all(plant.induced_velocity < ratio * in_plane)
        assert plant.again == again


def test_rotors_of_their_own_lift_in_a_steep_descent(lei_li, blade):
    """Where the safe solver flies: each rotor's induced velocity is the one of its own lift slope."""
    share = (1.0, 0.8, 1.2, 0.6)
    plant = Watched(lei_li, blade, schedule=[PlantChange(0.0, lift_scale=share)], backend="interpreted")
    x, _ = plant.advance(moving([1.5, 0, -8]), IDLE, 1e-4)
    V = paper.flip(x[VELOCITY])  # the turn within one step is of the order of 1e-6 rad
    expected = [paper.induced(50.0, np.hypot(V[0], V[1]), V[2], C_la=factor * paper.C_LA) for factor in share]
    assert plant.again == 1
    assert plant.induced_velocity == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("method", "told"), [("euler", ["t=0.0001 s", "V_z=0.000245 m/s"]), ("rk4", ["t=0.0000 s"])])
def test_one_rotor_that_stops(lei_li, blade, method, told):
    """In air at rest it may; as soon as the vehicle sinks, by g / 4 with three rotors left, it may not: Euler's method
    meets that in the second step, RK4 within the first."""
    effects = BladeElementEffects(rotor_speed_min=0.0)
    plant = BladeElementPlant(lei_li, blade, effects, method=method, backend="interpreted")
    u = np.full(4, lei_li.hover_thrust)
    u[2] = 0.0
    with pytest.raises(ModelDomainError, match="rotor 2 .* it is stopped in moving air.*w=1e-06 rad/s") as raised:
        plant.advance(LEVEL, u, 0.001)
    assert all(part in str(raised.value) for part in told)


def test_one_rotor_that_stops_in_level_flight(lei_li, blade):
    """At first the quick iteration has no trouble with it, V_I = T / (K V_h); but it has no advance ratio."""
    plant = BladeElementPlant(lei_li, blade, BladeElementEffects(rotor_speed_min=0.0), backend="interpreted")
    u = np.full(4, lei_li.hover_thrust)
    u[1] = 0.0
    with pytest.raises(ModelDomainError, match=r"rotor 1 at t=0.0000 s: it is stopped in moving air.*V_h=5 m/s"):
        plant.advance(moving([5, 0, 0]), u, 1e-4)
