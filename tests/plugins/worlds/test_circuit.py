"""The battery's circuit: charge and energy in balance, its equations by SciPy, the sag of the thrust in closed form."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from quadexp.physics.motor import lagging_thrust
from quadexp.plugins.worlds.circuit import (
    charge_after,
    compensated_power,
    compensated_thrust,
    open_circuit_tangent,
    open_circuit_voltage,
    operating_point,
    rotor_power,
    sagging_power,
    sagging_thrust,
)

CELLS, CAPACITY, R0, R1, TAU = 4, 1.5, 0.03, 0.02, 20.0
HOVER, POWER = 2.5, 40.0  # N and W of a rotor


def source(z):
    return float(open_circuit_voltage(z, CELLS))


def solved(
    u, E, guess=None, *, exponent=2.0, reference=16.0, compensation=False, thrust_max=20.0, electronics=5.0, calls=20
):
    """Voltage, current and thrusts of thrusts u (n,) (N) commanded of a source E (V)."""

    def thrust_at(voltage):
        ratio = voltage / reference
        if compensation:
            return compensated_thrust(ca.DM(u), ratio, exponent, thrust_max)
        return sagging_thrust(ca.DM(u), ratio, exponent)

    def power_at(voltage):
        return ca.sum1(rotor_power(thrust_at(voltage), HOVER, POWER)) + electronics

    V = ca.SX.sym("guess")
    point = ca.Function("point", [V], operating_point(ca.SX(E), ca.SX(R0), V, thrust_at, power_at))
    voltage = E if guess is None else guess
    for _ in range(calls):
        voltage, current, thrust = (value.full().ravel() for value in point(voltage))
        voltage = voltage.item()
    return voltage, current.item(), thrust


def test_open_circuit_voltage_is_that_of_the_published_cell():
    """4.10 V full, 3.68 V at 15 %, and it never rises while the cell empties (Chen & Rincon-Mora 2006, figure 5)."""
    charge = np.linspace(0, 1, 201)
    voltage = np.array(open_circuit_voltage(ca.DM(charge), 1)).ravel()
    assert voltage[-1] == pytest.approx(3.685 + 0.2156 - 0.1178 + 0.3201, abs=1e-9)
    assert voltage[0] == pytest.approx(2.654) and 3.6 < voltage[30] < 3.75
    assert np.all(np.diff(voltage) > 0)
    assert source(0.5) == pytest.approx(4 * voltage[100])


def test_charge_and_energy_are_in_balance():
    """What leaves the source arrives at the terminals, is stored in C_1, or is lost in R_0 and R_1."""
    z, V1, h, capacitance = 0.6, 0.3, 2e-3, TAU / R1
    taken = delivered = lost = drawn = 0.0
    current = 20 + 15 * np.sin(np.arange(4000) / 700) ** 3
    stored = 0.5 * capacitance * V1**2
    start = z
    weights, nodes = np.array([5, 8, 5]) / 18, 0.5 + np.array([-1, 0, 1]) * np.sqrt(0.15)  # Gauss-Legendre, 3 points
    for amps in current:
        at = h * nodes
        Vs = np.array([float(lagging_thrust(V1, R1 * amps, t, TAU)) for t in at])
        E = np.array([source(float(charge_after(z, amps, CAPACITY, t))) for t in at])
        taken += h * amps * weights @ E
        delivered += h * amps * weights @ (E - Vs - R0 * amps)
        lost += h * weights @ (R0 * amps**2 + Vs**2 / R1)
        drawn += h * amps
        z, V1 = float(charge_after(z, amps, CAPACITY, h)), float(lagging_thrust(V1, R1 * amps, h, TAU))
    stored = 0.5 * capacitance * V1**2 - stored
    assert start - z == pytest.approx(drawn / (3600 * CAPACITY), rel=1e-10)
    assert delivered + lost + stored == pytest.approx(taken, rel=1e-6)
    assert lost > 0.02 * taken and abs(stored) > 1e-3 * taken  # the terms are all of a size that counts


def test_the_circuit_under_a_constant_current_is_that_of_scipy():
    amps, T = 25.0, 60.0
    found = solve_ivp(
        lambda _, s: [-amps / (3600 * CAPACITY), (R1 * amps - s[1]) / TAU], (0, T), [0.9, 0.0], rtol=1e-11, atol=1e-12
    ).y[:, -1]
    z, V1 = 0.9, 0.0
    for _ in range(600):
        z, V1 = float(charge_after(z, amps, CAPACITY, T / 600)), float(lagging_thrust(V1, R1 * amps, T / 600, TAU))
    assert (z, V1) == pytest.approx(tuple(found), rel=1e-9)
    assert float(lagging_thrust(0.0, R1 * amps, TAU, TAU)) == pytest.approx(R1 * amps * (1 - np.exp(-1)))


@pytest.mark.parametrize("share", [0.5, 1.0, 2.0, 4.0])
def test_sag_without_compensation_is_the_closed_form(share):
    """k = 2, no electronics: P ~ V^3, so that V solves a quadratic."""
    u, E, reference = np.full(4, share * HOVER), 15.5, 16.0
    voltage, current, thrust = solved(u, E, reference=reference, electronics=0.0)
    a = R0 * 4 * POWER * share**1.5 / reference**3
    assert voltage == pytest.approx((np.sqrt(1 + 4 * a * E) - 1) / (2 * a), rel=1e-9)
    assert thrust == pytest.approx(u * (voltage / reference) ** 2, rel=1e-9)
    assert voltage * current == pytest.approx(np.sum(POWER * (thrust / HOVER) ** 1.5), rel=1e-9)
    assert voltage == pytest.approx(E - R0 * current, rel=1e-12)


def test_compensation_holds_the_thrust_and_draws_the_full_power():
    """Constant power P: V^2 - E V + R_0 P = 0, until full throttle gives less than is asked."""
    u, E = np.array([2.0, 3.0, 4.0, 2.5]), 13.5
    voltage, current, thrust = solved(u, E, compensation=True, electronics=0.0)
    P = np.sum(POWER * (u / HOVER) ** 1.5)
    assert thrust == pytest.approx(u, rel=1e-12)
    assert voltage == pytest.approx((E + np.sqrt(E**2 - 4 * R0 * P)) / 2, rel=1e-9)
    _, _, weak = solved(u, E)
    assert weak == pytest.approx(u * (solved(u, E)[0] / 16.0) ** 2) and np.all(weak < 0.75 * u)
    voltage, _, thrust = solved([12.0, 3.0, 3.0, 3.0], E, compensation=True, thrust_max=12.0)
    assert thrust[0] == pytest.approx(12.0 * (voltage / 16.0) ** 2) and thrust[0] < 9 and thrust[1:] == pytest.approx(3)


@pytest.mark.parametrize("exponent", [0.0, 0.7, 1.0, 2.0, 3.0])
def test_power_by_the_commands_is_power_by_the_thrusts(exponent):
    """sum P(u_i r^k) without a power of any thrust, also where one rotor has full throttle."""
    u, ratio, most = ca.DM([2.0, 7.0, 0.0, 11.0]), 0.83, 8.0
    commanded = rotor_power(u, HOVER, POWER)
    for thrust, found in (
        (sagging_thrust(u, ratio, exponent), sagging_power(commanded, ratio, exponent)),
        (
            compensated_thrust(u, ratio, exponent, most),
            compensated_power(commanded, ratio, exponent, rotor_power(most, HOVER, POWER)),
        ),
    ):
        wanted = POWER * np.sum((np.array(thrust).ravel() / HOVER) ** 1.5)
        assert float(found) == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize("compensation", [False, True])
def test_one_step_finds_the_voltage_after_a_jump_of_the_power(compensation):
    """Commands that double within a step: the voltage moves by a few tenths, one call is right to a microvolt."""
    keys = {"compensation": compensation, "thrust_max": 50.0}
    before, after = (solved(np.full(4, share * HOVER), 15.5, **keys)[0] for share in (1.0, 1.6))
    assert 0.15 < before - after < 0.5
    once = solved(np.full(4, 1.6 * HOVER), 15.5, before, calls=1, **keys)
    assert once[0] == pytest.approx(after, abs=1e-6)


def test_the_tangent_touches_the_curve():
    for z in (0.9, 0.4, 0.05):
        first, slope = (float(ca.evalf(one)) for one in open_circuit_tangent(ca.SX(z), CELLS))
        assert first + slope * z == pytest.approx(source(z), rel=1e-14)
        assert slope == pytest.approx((source(z + 1e-6) - source(z - 1e-6)) / 2e-6, rel=1e-6)


def test_more_power_than_the_battery_has_pulls_its_voltage_down():
    """E^2 / 4 R_0 is the most that a source gives; beyond it the voltage falls from step to step."""
    most = 13.5**2 / (4 * R0)
    voltage, *_ = solved(np.full(4, HOVER), 13.5, compensation=True, electronics=1.2 * most, thrust_max=1e3)
    assert voltage < 13.5 / 2
