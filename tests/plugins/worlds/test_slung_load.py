"""The slung load: pendulum, energy, momentum, tension at rest, slack cable."""

import casadi as ca
import numpy as np
import pytest
from scipy.special import ellipk

from quadexp.errors import UsageError
from quadexp.plugins.worlds.slung_load import SlungLoad, advanced, cable, cable_force, cable_torque, check_step, hanging

G = 9.81


def made(mass, length, **keys):
    return cable(SlungLoad(mass=mass, length=length, **keys), G)


LEVEL = np.r_[np.zeros(3), 1, np.zeros(9)]


def pair(rope, mass, thrust, step, held=False):
    """A CasADi step of load and a point-mass vehicle (6,) each under thrust (3,) (N), in the form the plant's has."""
    v, load = ca.SX.sym("v", 6), ca.SX.sym("load", 6)
    x = ca.vertcat(v[:3], 1, 0, 0, 0, v[3:], 0, 0, 0)
    force = cable_force(rope, x, load, step)
    a = ca.DM.zeros(3) if held else ca.DM([0, 0, -G]) + (ca.DM(thrust) + force) / mass
    v_next = ca.vertcat(v[:3] + step * v[3:] + step**2 / 2 * a, v[3:] + step * a)
    return ca.Function("pair", [v, load], [v_next, advanced(rope, load, force, ca.DM.zeros(3), step), force])


def flown(step_function, v, load, steps):
    state = ca.vertcat(v, load)
    s = ca.SX.sym("s", 12)
    out = step_function(s[:6], s[6:])
    return ca.Function("s", [s], [ca.vertcat(out[0], out[1])]).mapaccum(steps)(state).full().T


def energy(rope, mass, states):
    v, load = states[:, :6], states[:, 6:]
    stretch = np.maximum(np.linalg.norm(load[:, :3] - v[:, :3], axis=1) - rope.length, 0)
    kinetic = 0.5 * mass * (v[:, 3:] ** 2).sum(1) + 0.5 * rope.mass * (load[:, 3:] ** 2).sum(1)
    return kinetic + G * (mass * v[:, 2] + rope.mass * load[:, 2]) + 0.5 * rope.stiffness * stretch**2


@pytest.mark.parametrize(("length", "angle"), [(0.5, 0.05), (1.0, 0.05), (2.0, 0.8)])
def test_the_swing_has_the_period_of_a_pendulum(length, angle):
    """Vehicle held: 4 K(sin(a/2)) sqrt(L / g), the complete elliptic integral; 2 pi sqrt(L / g) for small angles."""
    rope, step = made(0.3, length, stretch=1e-3, damping=0.3), 1e-3
    place = length * (1 + 1e-3 * np.cos(angle)) * np.array([np.sin(angle), 0, -np.cos(angle)])
    period = 4 * ellipk(np.sin(angle / 2) ** 2) * np.sqrt(length / G)
    steps = int(5.2 * period / step)
    x = flown(pair(rope, 1.0, np.zeros(3), step, held=True), np.zeros(6), np.r_[place, np.zeros(3)], steps)[:, 6]
    falling = np.flatnonzero((x[:-1] > 0) & (x[1:] <= 0))
    crossing = step * (falling + x[falling] / (x[falling] - x[falling + 1]))
    assert np.diff(crossing) == pytest.approx(np.full(len(crossing) - 1, period), rel=2e-3)
    assert len(crossing) >= 4


@pytest.mark.parametrize("mass", [0.5, 2.0])
def test_beneath_a_free_vehicle_it_swings_faster(mass):
    """Both swing about their common centre of mass: omega^2 = g / L (1 + m / M), the thrust holding both."""
    rope, step = made(0.5, 1.0, stretch=1e-3), 1e-3
    period = 2 * np.pi / np.sqrt(G / 1.001 * (1 + 0.5 / mass))
    load = np.r_[1.001 * np.sin(0.03), 0, -1.001 * np.cos(0.03), np.zeros(3)]
    states = flown(pair(rope, mass, [0, 0, G * (mass + 0.5)], step), np.zeros(6), load, int(4.2 * period / step))
    x = states[:, 6] - states[:, 0]
    falling = np.flatnonzero((x[:-1] > 0) & (x[1:] <= 0))
    crossing = step * (falling + x[falling] / (x[falling] - x[falling + 1]))
    assert len(crossing) == 4
    assert np.diff(crossing) == pytest.approx(np.full(3, period), rel=2e-3)


@pytest.mark.parametrize("step", [5e-4, 2e-3])
def test_without_damping_energy_and_momentum_are_kept(step, rng):
    """A free vehicle with a load, ten seconds of a wild swing, the cable slack at times."""
    rope, mass = made(0.4, 0.8, stretch=0.005, damping=0.0), 1.1
    v, load = np.r_[0, 0, 0, 0.3, -1, 0.5], np.r_[0.3, 0.2, -0.55, -1.0, 2.0, 0.4]
    states = np.vstack([np.r_[v, load], flown(pair(rope, mass, np.zeros(3), step), v, load, int(10 / step))])
    t = step * np.arange(len(states))
    momentum = mass * states[:, 3:6] + rope.mass * states[:, 9:]
    start = momentum[0] + np.outer(t, [0, 0, -G * (mass + rope.mass)])
    assert momentum == pytest.approx(start, abs=1e-9)
    centre = (mass * states[:, :3] + rope.mass * states[:, 6:9]) / (mass + rope.mass)
    fall = centre[0] + np.outer(t, start[0] / (mass + rope.mass)) - np.outer(t**2, [0, 0, G / 2])
    assert centre == pytest.approx(fall, abs=1e-9)
    relative = energy(rope, mass, states) - _of_centre(rope, mass, states)
    assert np.abs(relative - relative[0]).max() < 0.01 * relative[0]
    distance = np.linalg.norm(states[:, :3] - states[:, 6:9], axis=1)
    assert (distance < rope.length).any() and (distance > rope.length).any()


def _of_centre(rope, mass, states):
    """Energy of the fall of the common centre of mass; the rest is that of the relative motion."""
    whole = mass + rope.mass
    velocity = (mass * states[:, 3:6] + rope.mass * states[:, 9:]) / whole
    height = (mass * states[:, 2] + rope.mass * states[:, 8]) / whole
    return 0.5 * whole * (velocity**2).sum(1) + G * whole * height


def test_energy_error_falls_with_the_square_of_the_step():
    rope, mass, errors = made(0.4, 0.8, stretch=0.005, damping=0.0), 1.1, []
    v, load = np.zeros(6), np.r_[0.5, 0.0, -0.63, 0, 0.5, 0]  # always taut
    load[:3] *= 0.8 * 1.005 / np.linalg.norm(load[:3])
    thrust = np.array([0, 0, G * (mass + rope.mass)])
    for step in (2e-3, 1e-3, 5e-4):
        states = flown(pair(rope, mass, thrust, step), v, load, int(2 / step))
        whole = energy(rope, mass, states) - thrust[2] * states[:, 2]
        errors.append(np.abs(whole - whole[0]).max())
    assert np.array(errors[:-1]) / np.array(errors[1:]) == pytest.approx([4, 4], rel=0.25)


@pytest.mark.parametrize("mass", [0.05, 0.5])
def test_at_rest_the_tension_is_the_weight(mass):
    rope = made(mass, 0.7, point=(0.05, -0.02, -0.04))
    load = hanging(rope, LEVEL)
    force = np.array(cable_force(rope, ca.DM(LEVEL), ca.DM(load), 1e-3)).ravel()
    assert force == pytest.approx([0, 0, -mass * G], rel=1e-6, abs=1e-9)
    assert np.array(cable_torque(rope, ca.DM(LEVEL[3:7]), ca.DM(force))).ravel() == pytest.approx(
        np.cross(rope.point, force), abs=1e-12
    )
    after = np.array(advanced(rope, ca.DM(load), ca.DM(force), ca.DM.zeros(3), 1e-3)).ravel()
    assert after == pytest.approx(load, abs=1e-9)


def test_a_slack_cable_pulls_nothing_and_a_cable_never_pushes():
    rope = made(0.3, 1.0, damping=1.0)
    for place, velocity in (((0, 0, -0.9), (0, 0, 0)), ((0, 0, -1.001), (0, 0, 9.0))):
        force = cable_force(rope, ca.DM(LEVEL), ca.DM(np.r_[place, velocity]), 1e-4)
        assert np.abs(np.array(force)).max() == 0


def test_drag_pulls_the_load_with_the_wind():
    """At rest in the wind the cable leans by atan(k W^2 / (m g)); its pull is the sum of both."""
    rope, wind = made(0.3, 1.0, drag=0.02), np.array([6.0, 0, 0])
    load = ca.SX.sym("load", 6)
    force = cable_force(rope, ca.DM(LEVEL), load, 1e-3)
    one = ca.Function("one", [load], [advanced(rope, load, force, ca.DM(wind), 1e-3)])
    rest = np.array(one.mapaccum(60_000)(hanging(rope, LEVEL)))[:, -1]
    assert np.arctan2(rest[0], -rest[2]) == pytest.approx(np.arctan2(0.02 * 36, 0.3 * G), rel=1e-3)


def test_a_step_too_long_for_the_cable_is_refused():
    with pytest.raises(
        UsageError, match="oscillates along its length at 79.85 rad/s, .* plant.step must be at most 0.0063 s"
    ):
        check_step(made(0.3, 1.0), 0.02, 1.0)
    check_step(made(0.3, 1.0), 1e-3, 1.0)
