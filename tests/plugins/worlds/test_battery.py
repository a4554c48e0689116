"""A battery around three airframes: charge, energy and sag of a flight, compensation, and how a flight ends."""

import numpy as np
import pytest
from scipy.integrate import simpson

from quadexp.errors import ModelDomainError, UsageError
from quadexp.plugins.worlds.battery import Battery
from quadexp.plugins.worlds.circuit import open_circuit_voltage
from quadexp.world.actuator import Actuator
from quadexp.world.rotor_loss import RotorLoss
from quadexp.world.world import World
from tests.world.airframes import AIRFRAMES, PERIOD, REST, airframe, ideal


def drained(world, u, *, seed=0):
    """Columns of the battery after every period under commands u, (k, 3): voltage, current, charge; and readings."""
    x, streams = REST.copy(), world.begin(REST, PERIOD, 1.0, np.random.default_rng(seed))
    places = world.columns(PERIOD)
    rows, force = [], []
    for command in u:
        x, reading = world.advance(x, command, PERIOD, streams)
        rows.append(world.inner[[places[name] for name in ("battery_voltage", "battery_current", "state_of_charge")]])
        force.append(reading[2])
    return np.array(rows), np.array(force)


@pytest.mark.parametrize("kind", AIRFRAMES)
def test_charge_and_energy_of_a_flight_are_in_balance(vehicle, kind):
    """Step by step: what the source gives arrives at the terminals, is stored in the RC pair, or is lost as heat."""
    battery = Battery(resistance=0.05, rc_resistance=0.04, rc_time_constant=0.2, electronics=20.0, capacity=0.5)
    world, h = World(airframe(kind, vehicle), [battery]), 1e-3
    rng = np.random.default_rng(2)
    u = vehicle.hover_thrust * np.repeat(rng.uniform(0.5, 2.0, 20), 25)[:, None] * np.ones(vehicle.n_rotors)
    x, streams = REST.copy(), world.begin(REST, h, 1.0, rng)
    first = world.columns(h)["state_of_charge"]
    charge, pair, voltage, current = np.array(
        [world.inner[first : first + 4]]
        + [(world.advance(x, one, h, streams), world.inner[first : first + 4])[1] for one in u]
    ).T
    drawn = current[1:] * h
    assert charge[0] - charge[-1] == pytest.approx(drawn.sum() / (3600 * 0.5), rel=1e-9)
    z = np.linspace(charge[-1], charge[0], 2001)
    taken = 3600 * 0.5 * simpson(np.array(open_circuit_voltage(z, 4)).ravel(), x=z)
    delivered, series = np.sum(voltage[1:] * drawn), np.sum(0.05 * current[1:] * drawn)
    # V_1 within a step goes from pair to pair exponentially: the mean of its square by Gauss-Legendre's two points
    target = 0.04 * current[1:]
    inside = [
        target + (pair[:-1] - target) * np.exp(-h * s / 0.2) for s in (0.5 - np.sqrt(1 / 12), 0.5 + np.sqrt(1 / 12))
    ]
    heat = sum(np.sum(one**2) for one in inside) / 2 * h / 0.04
    stored = 0.5 * (0.2 / 0.04) * (pair[-1] ** 2 - pair[0] ** 2)
    assert delivered + series + heat + stored == pytest.approx(taken, rel=1e-6)
    assert min(series, heat, stored) > 1e-3 * taken


@pytest.mark.parametrize("charge", [1.0, 0.3])
def test_charge_and_voltage_do_not_depend_on_the_control_period(vehicle, charge):
    """E by its tangent over periods of 20 ms, or of one integration step, which the test above holds in balance."""
    keys = {"capacity": 0.1, "state_of_charge": charge, "rc_time_constant": 0.2, "rc_resistance": 0.04}
    u = vehicle.hover_thrust * np.random.default_rng(5).uniform(0.5, 1.8, 40)
    found = []
    for parts in (1, 20):
        world = World(ideal(vehicle), [Battery(**keys)])
        x, streams = REST.copy(), world.begin(REST, PERIOD / parts, 1.0, np.random.default_rng(0))
        first = world.columns(PERIOD / parts)["state_of_charge"]
        for one in u:
            for _ in range(parts):
                world.advance(x, np.full(vehicle.n_rotors, one), PERIOD / parts, streams)
        found.append(world.inner[first : first + 4].copy())
    assert found[0] == pytest.approx(found[1], rel=1e-6) and found[0][0] < charge - 0.01


def test_thrust_sags_with_the_voltage_unless_it_is_compensated(vehicle):
    """At rest the accelerometer reads sum T / m: T = u (V / V_ref)^2, or u where the flight stack compensates."""
    u = np.tile(np.full(vehicle.n_rotors, 2.0 * vehicle.hover_thrust), (150, 1))
    options = {"capacity": 0.1, "reference_voltage": 16.0}
    rows, force = drained(World(ideal(vehicle), [Battery(**options)]), u)
    asked = u[0].sum() / vehicle.mass
    assert force == pytest.approx(asked * (rows[:, 0] / 16.0) ** 2, rel=1e-9)
    assert force[-1] < 0.97 * force[0] < 0.97 * asked
    rows, force = drained(World(ideal(vehicle), [Battery(**options, compensation=True)]), u)
    assert force == pytest.approx(np.full(150, asked), rel=1e-9) and rows[-1, 2] < 0.95


def test_without_a_reference_thrusts_are_as_commanded_in_the_first_hover(vehicle):
    u = np.tile(np.full(vehicle.n_rotors, vehicle.hover_thrust), (1, 1))
    for charge in (1.0, 0.4):
        _, force = drained(World(ideal(vehicle), [Battery(state_of_charge=charge)]), u)
        assert force[0] == pytest.approx(9.81, rel=1e-4)


@pytest.mark.parametrize("kind", AIRFRAMES)
def test_an_empty_battery_ends_the_flight(vehicle, kind):
    """After the time in which hovering draws the charge."""
    world = World(airframe(kind, vehicle), [Battery(capacity=0.01, state_of_charge=0.2, cutoff_voltage=0.0)])
    hover = np.full(vehicle.n_rotors, vehicle.hover_thrust)
    x, streams = REST.copy(), world.begin(REST, PERIOD, 1.0, np.random.default_rng(0))
    drawn = 0.0
    with pytest.raises(ModelDomainError, match=r"the battery is empty .* at t=0\.[6-9]\d s"):
        for _ in range(100):
            x, _ = world.advance(x, hover, PERIOD, streams)
            drawn += world.inner[world.columns(PERIOD)["battery_current"]] * PERIOD
    assert drawn == pytest.approx(0.2 * 0.01 * 3600, rel=0.05)


def test_a_voltage_below_the_cutoff_ends_the_flight(vehicle):
    world = World(ideal(vehicle), [Battery(cutoff_voltage=3.5, compensation=True)])
    with pytest.raises(ModelDomainError, match=r"below battery\.cutoff_voltage=3\.5 V per cell, at \d+ A"):
        drained(world, np.tile(np.full(vehicle.n_rotors, 0.9 * vehicle.thrust_max), (5, 1)))
    with pytest.raises(UsageError, match="hovering takes 155 W"):
        drained(World(ideal(vehicle), [Battery(resistance=0.5)]), np.zeros((1, 4)))


def test_motors_battery_and_loss_act_one_after_another(lei_li):
    """Settled: k w^2 is the command through voltage and loss, whatever the scale; the thrust is the scale times it."""
    effects = [
        Actuator(time_constant_up=0.01, time_constant_down=0.01, rotor_scale_std=0.05),
        Battery(reference_voltage=15.0),
        RotorLoss(losses=({"rotor": 3, "t": 0.0, "factor": 0.8},)),
    ]
    world = World(ideal(lei_li), effects)
    u = np.full(4, 1.2 * lei_li.hover_thrust)
    rows, force = drained(world, np.tile(u, (25, 1)), seed=4)
    world.begin(REST, PERIOD, 1.0, np.random.default_rng(4))
    scale = 1 + world._own_parameters[5:21:4]
    drained_again, _ = drained(world, np.tile(u, (25, 1)), seed=4)
    assert np.array_equal(rows, drained_again)
    expected = u * (rows[-1, 0] / 15.0) ** 2 * [1, 1, 1, 0.8]
    assert lei_li.thrust_coefficient * world.rotor_speed**2 == pytest.approx(expected, rel=1e-6)
    assert np.ptp(scale) > 0.02 and force[-1] == pytest.approx((scale * expected).sum() / lei_li.mass, rel=1e-6)
