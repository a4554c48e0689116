"""Motors around an airframe: steps in closed form, limits, scales by their statistics, hover on three airframes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.world.actuator import Actuator
from quadexp.world.blade_element import BladeElementEffects, BladeElementPlant
from quadexp.world.effect import Clock, Start
from quadexp.world.world import World
from tests.models.residuals import BLADE, with_rotors
from tests.world.airframes import AIRFRAMES, PERIOD, REST, airframe, commands, fly, ideal, start

UP, DOWN = 0.0125, 0.025


def readings(world, vehicle, command, periods, period):
    """Thrusts by the accelerometer at the end of every period, (k,) (N)."""
    x, streams = REST.copy(), world.begin(REST, period, 1.0, np.random.default_rng(0))
    found = []
    for _ in range(periods):
        x, reading = world.advance(x, np.full(vehicle.n_rotors, command), period, streams)
        found.append(vehicle.mass * reading[2])
    return np.array(found)


@pytest.mark.parametrize("lag_of", ["rotor_speed", "thrust"])
@pytest.mark.parametrize(("share", "tau"), [(1.6, UP), (0.4, DOWN)], ids=["up", "down"])
def test_a_step_goes_63_percent_of_the_way_in_its_time_constant(vehicle, lag_of, share, tau):
    """What an accelerometer at rest reads is the thrust: of it, or of its root, 1 - 1/e of the way after tau."""
    steps = 50
    world = World(ideal(vehicle, tau / steps), [Actuator(time_constant_up=UP, time_constant_down=DOWN, lag_of=lag_of)])
    hover = vehicle.hover_thrust * vehicle.n_rotors
    found = readings(world, vehicle, share * vehicle.hover_thrust, 3, tau)
    root = np.sqrt if lag_of == "rotor_speed" else np.asarray
    # the accelerometer reads in the middle of the last step
    expected = root(share) + (1 - root(share)) * np.exp(-(np.arange(1, 4) - 0.5 / steps))
    assert root(found / hover) == pytest.approx(expected, rel=1e-9)


def test_the_flight_does_not_depend_on_the_integration_step(vehicle):
    """The lag is exact, the thrust held from the middle: half the step, a quarter of the error."""

    def end(step):
        world = World(ideal(vehicle, step), [Actuator(time_constant_up=0.03, time_constant_down=0.03)])
        return fly(world, start(), commands(vehicle, 12))[0][-1]

    fine = end(6.25e-5)
    error = [np.abs(end(step) - fine).max() for step in (2e-3, 1e-3, 5e-4)]
    assert error[0] < 1e-3 and error[0] / error[1] == pytest.approx(4, rel=0.2)
    assert error[1] / error[2] == pytest.approx(4, rel=0.2)


def test_the_airframes_own_lag_is_the_same_equation(vehicle):
    """plant.motor_lag lags the rotor speed, as an actuator does; only where in a step it is taken differs."""
    vehicle = with_rotors(vehicle)
    u, x, tau = commands(vehicle, 15), start(2), 0.03

    def plant(lag):
        effects = BladeElementEffects(motor_lag=lag)
        return BladeElementPlant(vehicle, BLADE, effects, step=1e-4, backend="interpreted")

    own = fly(plant(tau), x, u)[0]
    actuator = fly(World(plant(0.0), [Actuator(time_constant_up=tau, time_constant_down=tau)]), x, u)[0]
    without = fly(plant(0.0), x, u)[0]
    assert np.abs(actuator - own).max() < 0.01 * np.abs(without - own).max()


def test_limits_of_the_speed_are_limits_of_the_thrust(lei_li):
    k, high = lei_li.thrust_coefficient, 1.3 * lei_li.hover_thrust
    world = World(ideal(lei_li), [Actuator(rotor_speed_min=100.0, rotor_speed_max=np.sqrt(high / k))])
    assert readings(world, lei_li, 3 * lei_li.hover_thrust, 2, PERIOD)[-1] == pytest.approx(4 * high, rel=1e-9)
    assert readings(world, lei_li, 0.0, 2, PERIOD)[-1] == pytest.approx(4 * k * 100.0**2, rel=1e-9)
    assert world.rotor_speed == pytest.approx(np.full(4, 100.0))


def test_scales_have_the_asked_mean_and_spread(lei_li):
    """Over many flights: of a rotor sqrt(flight^2 + rotor^2), between two rotors of one flight the flight's."""
    effect = Actuator(flight_scale_std=0.05, rotor_scale_std=0.03).among([])
    begin = Start(REST, 1.0, Clock(PERIOD, 20), lei_li, np.full(4, lei_li.hover_thrust))
    scale = np.array([effect.start(np.random.default_rng(seed), begin)[1][5:21:4] for seed in range(4000)]) + 1
    both = np.sqrt(1.05**2 + (1 + 0.05**2) * 0.03**2 - 0.05 * 2 - 1)  # of the product of two independent factors
    assert scale.mean(axis=0) == pytest.approx(np.ones(4), abs=4 * both / np.sqrt(4000))
    assert scale.std(axis=0) == pytest.approx(np.full(4, both), rel=0.05)
    assert np.cov(scale[:, 0], scale[:, 1])[0, 1] == pytest.approx(0.05**2, rel=0.1)
    assert scale.min() > 0


@pytest.mark.parametrize("kind", AIRFRAMES)
def test_hover_takes_the_scaled_command(vehicle, kind):
    """Commanded the hover thrust over their scale, rotors that differ hold the vehicle as ideal ones do.

    But for the yaw of blade_element: there the torque of a rotor at its own speed is not in proportion to its thrust.
    """
    x = REST.copy()
    plant = airframe(kind, vehicle)
    hover = np.full(vehicle.n_rotors, vehicle.hover_thrust)
    expected = fly(airframe(kind, vehicle), x, [hover] * 20)[0]
    world = World(plant, [Actuator(rotor_scale_std=0.1, time_constant_up=0.02, time_constant_down=0.02)])
    world.begin(x, PERIOD, 1.0, np.random.default_rng(1))
    scale = 1 + world._own_parameters[5 : 5 + 4 * vehicle.n_rotors : 4]
    assert np.ptp(scale) > 0.05
    settled = [hover / scale] * 60
    tilted, held = fly(world, x, [hover] * 20)[0], fly(world, x, settled)[0]
    assert np.abs(tilted[-1, 10:]).max() > 0.1  # the uncorrected command turns it over
    speeds = np.diff(held[-20:, 10 : 12 if kind == "blade_element" else 13], axis=0)
    assert np.abs(speeds).max() < 1e-3 + 2 * np.abs(np.diff(expected[:, 10:], axis=0)).max()


def test_rotor_speeds_are_columns_where_they_are_known(vehicle, lei_li):
    world = World(ideal(lei_li), [Actuator(time_constant_up=UP, time_constant_down=DOWN)])
    assert list(world.columns(PERIOD)) == [f"rotor_speed_{i}" for i in range(4)]
    readings(world, lei_li, 1.5 * lei_li.hover_thrust, 20, PERIOD)
    assert world.rotor_speed == pytest.approx(
        np.full(4, np.sqrt(1.5 * lei_li.hover_thrust / lei_li.thrust_coefficient))
    )
    unknown = replace(vehicle, thrust_coefficient=None)
    assert list(World(ideal(unknown), [Actuator()]).columns(PERIOD)) == [f"delivered_{i}" for i in range(4)]
    with pytest.raises(UsageError, match=r"actuator\.rotor_speed_max=900: needs vehicle\.thrust_coefficient"):
        World(ideal(unknown), [Actuator(rotor_speed_max=900.0)]).columns(PERIOD)
    with pytest.raises(UsageError, match="must be less than"):
        Actuator(rotor_speed_min=900.0, rotor_speed_max=100.0)
