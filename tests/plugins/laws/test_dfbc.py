"""Flatness-based control by its theory: exact on the reference, its errors and gains by a second computation."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.control.base import Belief, Measurement, Window
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.physics.state import POSITION, RATE, VELOCITY
from quadexp.plugins.laws.dfbc import FlatnessBased
from quadexp.plugins.laws.geometric import Geometric
from quadexp.plugins.papers.ellipse import Ellipse
from quadexp.reference.flatness import flat_reference
from quadexp.reference.hover import Hover
from quadexp.world.disturbance import Disturbance
from quadexp.world.simplified import PlantEffects, SimplifiedPlant
from quadexp.world.world import World


def controller(vehicle, residual=None, **keys):
    return FlatnessBased(**keys, backend="interpreted").controller(vehicle, residual)


def commanded(dfbc, x, path, yaw, thrust):
    """Thrusts (n,) for one state; thrust: that the rotors deliver, (n,)."""
    window = Window(np.tile(x, (2, 1)), thrust[None], path, yaw)
    dfbc.reset(x, window)
    return dfbc.step(Measurement(0.0, x, None, None), window)[0]


@pytest.mark.parametrize("ratio", [1.0, 3.0])
def test_on_a_reference_in_a_vertical_plane_it_commands_the_references_thrusts(vehicle, ratio):
    """All of (19)-(24) against the flatness map, upside down too: the acceleration at the top is -1.6 g."""
    trajectory = Ellipse(speed=8.0, acceleration=16.0 * ratio, ratio=ratio, plane="vertical")
    t = np.linspace(0.1, 3.1, 40)
    reference, flat = flat_reference(trajectory, t, vehicle), trajectory.flat_output(t)
    assert (reference.state[:, 3] ** 2 - reference.state[:, 5] ** 2).min() < -0.9  # of R_33: it does fly upside down
    dfbc = controller(vehicle, wrench_weight=(1.0, 1.0, 1.0, 1.0), least_thrust=1e-3)
    low, high = vehicle.thrust_min, vehicle.thrust_max
    for x, u, path in zip(reference.state, reference.input, flat.position, strict=True):
        if (u > low).all() and (u < high).all():
            assert commanded(dfbc, x, path, np.zeros(3), u) == pytest.approx(u, abs=1e-6)


def test_in_space_it_commands_the_references_thrust_and_tilt_torques(vehicle):
    """A level ellipse, on which the vehicle turns about all axes; of the yaw it knows those of the heading only."""
    body = replace(vehicle, inertia=((0.02, 0, 0), (0, 0.03, 0), (0, 0, 0.05)))
    trajectory = Ellipse(speed=8.0, acceleration=16.0, ratio=2.0, plane="horizontal")
    t, compared = np.linspace(0.1, 3.1, 40), 0
    reference, flat = flat_reference(trajectory, t, body), trajectory.flat_output(t)
    dfbc = controller(body, least_thrust=1e-3)
    for x, wanted, path, yaw in zip(reference.state, reference.input, flat.position, flat.yaw, strict=True):
        u = commanded(dfbc, x, path, yaw, wanted)
        both = np.r_[u, wanted]
        if (both > body.thrust_min + 1e-6).all() and (both < body.thrust_max - 1e-6).all():
            compared += 1
            gyroscopic = np.abs(np.cross(x[RATE], body.inertia_matrix @ x[RATE])[:2]).max()
            assert (body.allocation @ (u - wanted))[:3] == pytest.approx(np.zeros(3), abs=1e-3 * gyroscopic)
    assert compared > 10


def test_what_is_believed_is_taken_away(vehicle):
    """Torque and thrust scale by the wrench; a wind as the velocity less the wind, where drag is known."""
    residual = linear_drag_residual(vehicle, (0.4, 0.3, 0.1))
    torque, wind, scale = np.array([0.03, -0.02, 0.01]), np.array([2.0, -1.0, 0.5]), 0.8
    x, path = np.zeros(13), np.zeros((5, 3))
    x[3:7], x[VELOCITY] = Rotation.from_rotvec([0.03, -0.05, 0.04]).as_quat(scalar_first=True), (1.0, 2.0, -0.5)
    hover, dfbc = np.full(4, vehicle.hover_thrust), controller(vehicle, residual, velocity_gain=(0.0, 0.0, 0.0))
    window, still = Window(np.tile(x, (2, 1)), hover[None], path, np.zeros(3)), np.zeros(3)

    def wrench(velocity, belief):
        dfbc.reset(x, window)
        dfbc.believe(belief)
        now = x.copy()
        now[VELOCITY] = velocity
        return vehicle.allocation @ dfbc.step(Measurement(0.0, now, None, None), window)[0]

    plain = wrench(x[VELOCITY], Belief(still, still, still))
    turned = wrench(x[VELOCITY], Belief(still, torque, still, scale))
    assert scale * turned == pytest.approx(plain - np.r_[0, torque], abs=1e-9)
    blown = wrench(x[VELOCITY], Belief(still, still, wind))
    assert blown == pytest.approx(wrench(x[VELOCITY] - wind, Belief(still, still, still)), abs=1e-9)
    assert np.abs(blown - plain).max() > 1e-2


@pytest.mark.parametrize("law", [controller, lambda vehicle, air: Geometric().controller(vehicle, air)])
def test_a_believed_scale_of_the_air_is_a_model_with_so_much_more_drag(vehicle, law):
    """DFBC and geometric control, turned and fast, in an assumed wind."""
    drag, still, wind = np.array([0.4, 0.3, 0.1]), np.zeros(3), np.array([1.0, -2.0, 0.5])
    x = np.concatenate([np.zeros(3), Rotation.from_rotvec([0.03, -0.05, 0.04]).as_quat(scalar_first=True), np.zeros(6)])
    x[VELOCITY], x[RATE] = (5.0, -3.0, 1.0), (0.2, -0.1, 0.1)
    window = Window(np.tile(x, (3, 1)), np.full((2, 4), vehicle.hover_thrust), np.zeros((5, 3)), np.zeros(3))
    window.position[0], window.position[1] = x[:3], x[VELOCITY]

    def command(factor, scale):
        made = law(vehicle, linear_drag_residual(vehicle, factor * drag))
        made.reset(x, window)
        made.believe(Belief(still, still, wind, 1.0, scale))
        return made.step(Measurement(0.0, x, None, None), window)[0]

    assert command(1.0, 2.0) == pytest.approx(command(2.0, 1.0), abs=1e-9)
    assert np.abs(command(1.0, 2.0) - command(1.0, 1.0)).max() > 1e-2


def test_the_printed_side_of_y_flips_upside_down(vehicle):
    """Half a turn of heading is asked for: with the same state and reference the commands differ."""
    trajectory = Ellipse(speed=8.0, acceleration=16.0, plane="vertical")
    reference, flat = flat_reference(trajectory, np.zeros(1), vehicle), trajectory.flat_output(np.zeros(1))
    case = reference.state[0], flat.position[0], np.zeros(3), reference.input[0]
    continuous, printed = (commanded(controller(vehicle, inverted=kind), *case) for kind in ("continuous", "printed"))
    assert continuous == pytest.approx(reference.input[0], abs=1e-6)
    assert np.abs(printed - continuous).max() > 0.01


def test_the_error_of_attitude_by_quaternions(vehicle):
    """(25)-(28) as printed, with e = q^-1 o q_d counted double, for random attitudes at rest."""
    rng, keys = np.random.default_rng(2), FlatnessBased()
    big = (1.0, 1.0, 1.0, 1.0)
    hover, path = np.full(4, vehicle.hover_thrust), np.zeros((5, 3))
    for _ in range(20):
        turn = Rotation.from_rotvec(rng.normal(0, 0.25, 3))
        q = turn.as_quat(scalar_first=True)
        x = np.r_[np.zeros(3), q, np.zeros(6)]
        e_w, e_x, e_y, e_z = turn.inv().as_quat(scalar_first=True)  # q_d = 1
        n = np.hypot(e_w, e_z)
        alpha = 2 * keys.tilt_gain * np.array([e_w * e_x - e_y * e_z, e_w * e_y + e_x * e_z, 0]) / n
        alpha += 2 * keys.yaw_gain * np.sign(e_w) * np.array([0, 0, e_z]) / n
        expected = np.r_[vehicle.mass * vehicle.gravity, vehicle.inertia_matrix @ alpha]
        u = np.linalg.solve(vehicle.allocation, expected)
        if (u < vehicle.thrust_min).any() or (u > vehicle.thrust_max).any():
            continue
        found = commanded(controller(vehicle, wrench_weight=big), x, path, np.zeros(3), hover)
        assert found == pytest.approx(u, abs=1e-8)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_the_error_of_tilt_at_its_ends(vehicle, rng, sense):
    """Zero at the axis that is asked for, half a turn opposite to it, also where rounding takes its cosine past 1."""
    dfbc = controller(vehicle, position_gain=(0.0, 0.0, 0.0), velocity_gain=(0.0, 0.0, 0.0))
    for turn in Rotation.random(40, random_state=rng.integers(1000)):
        x = np.r_[np.zeros(3), turn.as_quat(scalar_first=True), np.zeros(6)]
        axis, path = turn.as_matrix()[:, 2], np.zeros((3, 5))
        path[:, 2] = sense * 12.0 * axis - [0, 0, vehicle.gravity]
        commanded(dfbc, x, path.T, np.zeros(3), np.full(4, 3.0))
        assert dfbc.log()["error_tilt"] == pytest.approx(0 if sense > 0 else np.pi, abs=1e-7)


def flown(vehicle, dfbc, world, duration=8.0):
    reference = SampledReference(Hover(position=(0, 0, 1), duration=duration), dfbc)
    return fly(world, dfbc, reference, np.random.default_rng(0))


def test_a_force_moves_it_by_what_the_position_gain_says_and_a_belief_brings_it_back(vehicle):
    """Steady error F / (m K_p), without; none with the force and the torque assumed."""
    force, torque = np.array([0.8, -0.5, 0.6]), np.array([0.02, -0.01, 0.005])
    plant = SimplifiedPlant(vehicle, PlantEffects.none(), backend="interpreted")
    push = World(plant, [Disturbance(force=tuple(force))])
    error = flown(vehicle, controller(vehicle), push).state[-1, POSITION] - [0, 0, 1]
    assert error == pytest.approx(force / (vehicle.mass * 10.0), abs=2e-3)

    dfbc = controller(vehicle)
    believe = Belief(force, torque, np.zeros(3))
    step = dfbc.step
    dfbc.step = lambda measurement, window: (dfbc.believe(believe), step(measurement, window))[1]
    both = World(plant, [Disturbance(force=tuple(force), torque=tuple(torque))])
    error = flown(vehicle, dfbc, both).state[-1, POSITION] - [0, 0, 1]
    assert error == pytest.approx(np.zeros(3), abs=1e-5)


def test_six_rotors(odd_vehicle):
    """A vehicle that nobody tuned it for holds its place."""
    plant = SimplifiedPlant(odd_vehicle, PlantEffects(), backend="interpreted")
    flight = flown(odd_vehicle, controller(odd_vehicle), plant, duration=4.0)
    assert flight.metadata["outcome"] == "ok"
    assert np.abs(flight.state[-1, POSITION] - [0, 0, 1]).max() < 0.02
