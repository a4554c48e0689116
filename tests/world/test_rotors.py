"""Motors, their angular momentum, and rotors that lose thrust, around three airframes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from quadexp.errors import UsageError
from quadexp.physics.state import ATTITUDE, RATE
from quadexp.plugins.papers.lei_li.plant import BladeElementEffects, BladeElementPlant
from quadexp.world.actuator import Actuator
from quadexp.world.effect import Clock, Start
from quadexp.world.rotor_loss import RotorLoss
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
    # Beside what a free body does that turned at the beginning: I dw/dt = -w x I w, 1.1e-3 rad/s a period in its yaw.
    w, inertia = held[-21:, 10:], vehicle.inertia_matrix
    free = -PERIOD * np.linalg.solve(inertia, np.cross(w, w @ inertia).T).T
    speeds = (np.diff(w, axis=0) - (free[1:] + free[:-1]) / 2)[:, : 2 if kind == "blade_element" else 3]
    assert np.abs(speeds).max() < 1e-4 + 2 * np.abs(np.diff(expected[:, 10:], axis=0)).max()


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


INERTIA, TAU = 2e-4, 0.03  # kg m^2: large, so that the rotors' share is plain to see
UPWARDS = np.array([0.0, 0.0, 1.0])


def flown(vehicle, u, step, lag_of="rotor_speed", inertia=INERTIA):
    """States (k + 1, 13) and the rotors' sum of s W (k + 1,) under commands (k, n)."""
    lag = {"time_constant_up": TAU, "time_constant_down": TAU, "lag_of": lag_of}
    world = World(ideal(vehicle, step), [Actuator(rotor_inertia=inertia, **lag)])
    x = start(4)
    x[RATE] = [2.0, -1.5, 1.0]
    streams = world.begin(x, PERIOD, 1.0, np.random.default_rng(0))
    states, spin = [x], [world.rotor_speed @ np.array(vehicle.rotor_spin)]
    for command in u:
        x, _ = world.advance(x, command, PERIOD, streams)
        states.append(x)
        spin.append(world.rotor_speed @ np.array(vehicle.rotor_spin))
    return np.array(states), np.array(spin)


def thrusts(vehicle, periods):
    """Commands (k, n) that turn the vehicle about every axis and change the sum of the speeds."""
    share = 1 + 0.5 * np.random.default_rng(5).uniform(-1, 1, (periods, vehicle.n_rotors))
    return vehicle.hover_thrust * share


def momentum(vehicle, states, spin):
    """Of body and rotors about the centre of mass, world (k + 1, 3) (N m s)."""
    body = states[:, RATE] @ vehicle.inertia_matrix - INERTIA * spin[:, None] * UPWARDS
    return Rotation.from_quat(states[:, ATTITUDE], scalar_first=True).apply(body)


@pytest.mark.parametrize("lag_of", ["rotor_speed", "thrust"])
def test_without_a_torque_from_outside_angular_momentum_is_kept(lei_li, lag_of):
    """Rotors on very short arms, without drag, move the body by their inertia alone; the step's error falls with it."""
    arms = 1e-7 * np.array(lei_li.rotor_position)
    vehicle = replace(lei_li, rotor_position=tuple(map(tuple, arms)), torque_coefficient=1e-7)
    drift = []
    for step in (2e-3, 1e-3):
        states, spin = flown(vehicle, thrusts(vehicle, 25), step, lag_of)
        found = momentum(vehicle, states, spin)
        drift.append(np.abs(found - found[0]).max())
    exchanged = INERTIA * np.ptp(spin)
    assert exchanged > 0.01 and np.abs(states[:, RATE] - states[0, RATE]).max() > 1.0
    assert drift[0] < 0.02 * exchanged and drift[1] < 0.6 * drift[0]


def test_flights_are_those_of_momentum_integrated_by_itself(lei_li):
    """L' = R tau of the air, w = J^-1 (R' L + I_p S e_z): no gyroscopic term and no acceleration of rotors in it."""
    u, k = thrusts(lei_li, 15), lei_li.thrust_coefficient
    J, sign = lei_li.inertia_matrix, np.array(lei_li.rotor_spin)
    speed = np.full(4, np.sqrt(lei_li.hover_thrust / k))
    states = {step: flown(lei_li, u, step)[0] for step in (2e-3, 1e-3, 5e-4)}
    first = states[2e-3][0]
    R = Rotation.from_quat(first[ATTITUDE], scalar_first=True)
    y = np.r_[first[ATTITUDE], R.apply(J @ first[RATE] - INERTIA * (sign @ speed) * UPWARDS), speed]
    for command in u:

        def slope(t, y, command=command):
            q, L, W = y[:4], y[4:7], y[7:]
            R = Rotation.from_quat(q, scalar_first=True)
            w = np.linalg.solve(J, R.inv().apply(L) + INERTIA * (sign @ W) * UPWARDS)
            turn = 0.5 * np.r_[-q[1:] @ w, q[0] * w + np.cross(q[1:], w)]
            return np.r_[turn, R.apply(lei_li.allocation[1:] @ (k * W**2)), (np.sqrt(command / k) - W) / TAU]

        y = solve_ivp(slope, (0, PERIOD), y, rtol=1e-9, atol=1e-11).y[:, -1]
    R = Rotation.from_quat(y[:4], scalar_first=True)
    expected = np.linalg.solve(J, R.inv().apply(y[4:7]) + INERTIA * (sign @ y[7:]) * UPWARDS)
    error = [np.abs(found[-1, RATE] - expected).max() for found in states.values()]
    without = flown(lei_li, u, 5e-4, inertia=0.0)[0][-1, RATE]
    assert np.abs(without - expected).max() > 0.1
    assert error[0] < 0.02 and error[1] < 0.6 * error[0] and error[2] < 0.6 * error[1]


def test_without_inertia_nothing_is_added(lei_li):
    assert not World(ideal(lei_li), [Actuator(time_constant_up=TAU)]).effects[0].has("wrench")
    unknown = ideal(replace(lei_li, thrust_coefficient=None))
    with pytest.raises(UsageError, match=r"actuator\.rotor_inertia=5e-06: needs vehicle\.thrust_coefficient"):
        World(unknown, [Actuator(rotor_inertia=5e-6)]).columns(PERIOD)


@pytest.mark.parametrize("kind", AIRFRAMES)
def test_a_loss_is_a_scaled_command_from_its_time_on(vehicle, kind):
    """Two rotors, one of them twice; t=0.1 and 0.2 are instants of control."""
    losses = (
        {"rotor": 2, "t": 0.2, "factor": 0.5},
        {"rotor": 2, "t": 0.1, "factor": 0.7},
        {"rotor": 0, "t": 0.0, "factor": 0.9},
    )
    u, x = commands(vehicle, 15), start(5)
    by_hand = u.copy()
    by_hand[:, 0] *= 0.9
    by_hand[5:10, 2] *= 0.7
    by_hand[10:, 2] *= 0.5
    flown = fly(World(airframe(kind, vehicle), [RotorLoss(losses=losses)]), x, u)[0]
    assert np.abs(flown - fly(airframe(kind, vehicle), x, by_hand)[0]).max() < 1e-9
    assert np.abs(flown - fly(airframe(kind, vehicle), x, u)[0])[-1].max() > 0.01


def test_a_loss_within_a_period_is_exact_on_the_integration_steps(vehicle):
    """Losing all of a rotor after 5 of the 20 ms costs a quarter less of its impulse than losing it at once."""
    plant, x = airframe("from_model", vehicle), start(1)
    u = [np.full(vehicle.n_rotors, vehicle.hover_thrust)]

    def speed(t):
        return fly(World(plant, [RotorLoss(losses=({"rotor": 1, "t": t, "factor": 0.0},))]), x, u)[0][-1, 10:]

    whole, part, none = speed(0.0), speed(0.005), speed(PERIOD)
    assert np.linalg.norm(part - none) / np.linalg.norm(whole - none) == pytest.approx(0.75, rel=0.02)


@pytest.mark.parametrize(
    ("losses", "words"),
    [
        (({"rotor": 0, "t": 1.0},), "each loss is"),
        (({"rotor": 0.5, "t": 1.0, "factor": 0.5},), "must be a rotor's number"),
        (({"rotor": 0, "t": -1.0, "factor": 0.5},), "t must not be negative"),
        (({"rotor": 0, "t": "soon", "factor": 0.5},), "must be numbers"),
    ],
)
def test_wrong_losses_are_refused(losses, words):
    with pytest.raises(UsageError, match=words):
        RotorLoss(losses=losses)


def test_a_rotor_that_is_not_there_is_refused(vehicle):
    world = World(airframe("from_model", vehicle), [RotorLoss(losses=({"rotor": 4, "t": 1.0, "factor": 0.5},))])
    with pytest.raises(UsageError, match="has rotors 0 to 3"):
        world.columns(PERIOD)
