"""Geometric tracking has the error dynamics that Lee, Leok and McClamroch prove, and follows references exactly."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.control.base import Belief, Measurement
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.physics.state import POSITION, RATE, VELOCITY
from quadexp.plugins.laws.geometric import Geometric
from quadexp.reference.base import FlatOutput
from quadexp.reference.flatness import flat_reference
from tests.control.laws.flown import VEHICLES, Body, at_rest, fly, hovering, rotation, vehicle_of

INTERPRETED = {"backend": "interpreted"}
QUIET = [f"plant.{what}_noise_density=0" for what in ("force", "torque", "motor")]


def wanted_attitude(x, reference, keys, vehicle):
    """R_d by SciPy, from the printed equations; reference: position, velocity, acceleration (3, 3)."""
    w, zeta = np.array(keys.position_bandwidth), keys.position_damping
    e_p, e_v = x[POSITION] - reference[0], x[VELOCITY] - reference[1]
    force = reference[2] + [0, 0, vehicle.gravity] - w**2 * e_p - 2 * zeta * w * e_v
    z = force / np.linalg.norm(force)
    y = np.cross(z, [1.0, 0, 0])
    y /= np.linalg.norm(y)
    return Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=1))


@pytest.mark.parametrize("name", ["torrente", "lei_li"])
def test_the_error_of_the_rate_obeys_its_equation_with_position_errors_too(name):
    """e_w' = -W^2 e_R - 2 zeta W e_w: only with the exact rate, and its derivative, of the wanted attitude."""
    vehicle = vehicle_of(name, thrust_max=500.0)
    keys = Geometric(**INTERPRETED, rate=1000.0, attitude_bandwidth=(8.0, 7.0, 1.5), rates="exact")
    controller = keys.controller(vehicle)
    start = at_rest((0.3, -0.2, 0.1), Rotation.from_rotvec([0.15, -0.2, 0.1]))
    start[VELOCITY], start[RATE] = (0.5, 0.4, -0.6), (0.4, -0.3, 0.1)
    window = hovering(vehicle)
    states, commands = fly(Body(vehicle), controller, start, 0.4, lambda t: window)
    assert commands.min() > vehicle.thrust_min and commands.max() < vehicle.thrust_max
    h, R = controller.control_period, rotation(states)
    R_d = Rotation.concatenate([wanted_attitude(x, window.position[:3], keys, vehicle) for x in states])
    w_d = (R_d[:-2].inv() * R_d[2:]).as_rotvec() / (2 * h)  # in the frame of R_d, to second order
    error = R_d[1:-1].inv() * R[1:-1]
    e_w = states[1:-1, RATE] - error.inv().apply(w_d)
    skew = error.as_matrix()
    e_R = np.stack([skew[:, 2, 1] - skew[:, 1, 2], skew[:, 0, 2] - skew[:, 2, 0], skew[:, 1, 0] - skew[:, 0, 1]], 1) / 2
    W, zeta = np.array(keys.attitude_bandwidth), keys.attitude_damping
    wanted = -(W**2) * e_R - 2 * zeta * W * e_w
    found = (e_w[2:] - e_w[:-2]) / (2 * h)  # of the commands of the period before and after
    expected = (wanted[:-2] + wanted[1:-1]) / 2
    assert np.abs(expected).max() > 3 and np.abs(found - expected).max() < 6e-3 * np.abs(expected).max()


@pytest.mark.parametrize("angle", [0.5, 1.5, 2.5, 3.0])
def test_psi_decays_exponentially_from_any_angle_below_pi(angle):
    vehicle = vehicle_of("torrente", thrust_max=500.0, torque_coefficient=0.3)
    keys = Geometric(**INTERPRETED, rate=500.0, position_bandwidth=(0.0,) * 3, attitude_bandwidth=(5.0,) * 3)
    controller = keys.controller(vehicle)
    axis = np.array([0.5, 0.7, -0.4])
    start = at_rest(attitude=Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)))
    window = hovering(vehicle)
    states, _ = fly(Body(vehicle), controller, start, 4.0, lambda t: window)
    psi = 1 - np.cos(rotation(states).magnitude())
    t = controller.control_period * np.arange(len(psi))
    slow = keys.attitude_damping * 5.0  # of the linear equation: Psi goes with the square of the angle
    settled = psi < 0.1
    assert settled[-1]
    first = int(np.argmax(settled))
    bound = 40 * psi[first] * np.exp(-1.5 * slow * (t[first:] - t[first]))
    assert (psi[first:] <= bound + 1e-12).all() and psi[-1] < 1e-8


@pytest.mark.parametrize(
    ("world", "largest"),
    [
        (["plant=ideal"], 0.02),
        (["plant=ideal", "vehicle=crazyflie", "trajectory.speed=4", "trajectory=lemniscate"], 0.02),
        (["plant=ideal", "vehicle=lei_li", "trajectory.speed=6", "trajectory=random", "seed=3"], 0.05),
        ([*QUIET, "controller.residual=plant"], 0.05),
        ([*QUIET, "controller.residual=plant", "trajectory=random", "trajectory.speed=8", "seed=2"], 0.1),
        (["vehicle=lei_li", "plant=blade_element", "controller.residual=plant", "trajectory.speed=6"], 0.5),
    ],
)
def test_a_reference_is_followed_exactly_with_the_exact_model(world, largest):
    """Largest distance, mm: what is left is that commands are held for a period."""
    flight = fly_one(compose(["controller=geometric", *world]))
    assert flight.outcome == "ok" and 1e3 * flight.metadata["row"]["max_error"] < largest


def test_without_the_reference_s_rates_it_is_not():
    given = ["controller=geometric", *QUIET, "controller.residual=plant"]
    error = {
        rates: fly_one(compose([*given, f"controller.rates={rates}"])).metadata["row"]["mean_error"]
        for rates in ("exact", "reference", "none")
    }
    assert error["none"] > 100 * error["reference"] and error["reference"] < 2 * error["exact"] + 1e-5


def lee():
    """Lee's vehicle and gains (in its paper k_x = 16 m, k_v = 5.6 m, k_R = 8.81, k_w = 2.54), whose rotors push both
    ways without limit."""
    J, arm = np.array([0.0820, 0.0845, 0.1377]), 0.315
    vehicle = vehicle_of(
        "torrente",
        name="lee",
        mass=4.34,
        inertia=tuple(map(tuple, np.diag(J))),
        rotor_position=((arm, 0.0, 0.0), (0.0, -arm, 0.0), (-arm, 0.0, 0.0), (0.0, arm, 0.0)),
        rotor_spin=(1.0, -1.0, 1.0, -1.0),
        torque_coefficient=8.004e-3,
        thrust_max=900.0,
    )
    object.__setattr__(vehicle, "thrust_min", -900.0)
    bandwidth = tuple(np.sqrt(8.81 / J))
    damping = float(np.mean(2.54 / J / 2 / bandwidth))
    keys = Geometric(
        **INTERPRETED,
        rate=500.0,
        position_bandwidth=(4.0,) * 3,
        position_damping=0.7,
        attitude_bandwidth=bandwidth,
        attitude_damping=damping,
        rates="exact",
    )
    return vehicle, keys


def test_lee_s_recovery_from_upside_down():
    """Its second example: at the wanted point, turned by 178.2 degrees; attitude and position errors go to zero."""
    vehicle, keys = lee()
    start = at_rest(attitude=Rotation.from_matrix([[1, 0, 0], [0, -0.9995, -0.0314], [0, 0.0314, -0.9995]]))
    window = hovering(vehicle)
    states, _ = fly(Body(vehicle), keys.controller(vehicle), start, 8.0, lambda t: window)
    psi = 1 - np.cos(rotation(states).magnitude())
    tilt = 1 - rotation(states).as_matrix()[:, 2, 2]
    distance = np.linalg.norm(states[:, POSITION], axis=1)
    assert psi[0] > 1.99 and tilt[-1] < 1e-6 and distance[-1] < 1e-3
    assert np.argmax(tilt < 1) < 1.5 / 0.002 and distance.max() < 3.0 and distance[2000:].max() < 0.1


def test_lee_s_helix():
    """Its first example: an elliptic helix from rest at its wrong start, yaw turning; errors go to zero."""
    vehicle, keys = lee()
    pi = np.pi

    def path(t):
        s, c = np.sin(pi * t), np.cos(pi * t)
        rows = [[0.4 * t, 0.4 * s, -0.6 * c], [0.4, 0.4 * pi * c, 0.6 * pi * s]]
        rows += [[0, -0.4 * pi**2 * s, 0.6 * pi**2 * c], [0, -0.4 * pi**3 * c, -0.6 * pi**3 * s]]
        return np.array([*rows, [0, 0.4 * pi**4 * s, -0.6 * pi**4 * c]])

    class Helix:
        duration, peak_speed = 100.0, 3.0

        def flat_output(self, t):
            yaw = np.stack([pi * t, np.full_like(t, pi), np.zeros_like(t)], axis=1)
            return FlatOutput(np.stack([path(float(one)) for one in t]), yaw)

    times = np.arange(0, 10.002, 0.001)
    reference = flat_reference(Helix(), times, vehicle)

    def window(t):
        k = round(t / 0.001)
        states, inputs = reference.state[k : k + 3], reference.input[k : k + 2]
        return hovering(vehicle)._replace(state=states, input=inputs, position=path(t), yaw=np.array([pi * t, pi, 0.0]))

    states, _ = fly(Body(vehicle), keys.controller(vehicle), at_rest(), 9.0, window)
    distance = np.array([np.linalg.norm(x[POSITION] - path(0.002 * k)[0]) for k, x in enumerate(states)])
    assert distance[0] == pytest.approx(0.6) and distance[2500:].max() < 1e-3 and distance.max() < 1.0


@pytest.mark.parametrize("name", VEHICLES)
def test_every_vehicle_recovers_from_upside_down_within_its_limits(name):
    vehicle = vehicle_of(name)
    start = at_rest(attitude=Rotation.from_euler("xz", [3.1, 0.4]))
    window = hovering(vehicle)
    controller = Geometric(**INTERPRETED).controller(vehicle)
    states, commands = fly(Body(vehicle), controller, start, 8.0, lambda t: window)
    assert commands.min() >= vehicle.thrust_min and commands.max() <= vehicle.thrust_max
    tilt = np.arccos(rotation(states[-1]).as_matrix()[2, 2])
    assert np.linalg.norm(states[-1, POSITION]) < 2e-3 and tilt < 2e-3


FORCE, TORQUE = np.array([1.5, -1.0, 0.8]), np.array([0.05, -0.03, 0.01])


def test_an_unknown_force_leaves_the_offset_of_a_spring_and_a_believed_one_none():
    vehicle, keys = vehicle_of("torrente"), Geometric(**INTERPRETED)
    body, window = Body(vehicle, lambda t: FORCE), hovering(vehicle)
    offset = FORCE / vehicle.mass / 16.0
    controller = keys.controller(vehicle)
    states, _ = fly(body, controller, at_rest(), 6.0, lambda t: window)
    assert states[-1, POSITION] == pytest.approx(offset, abs=1e-3)  # nearly: the tilted thrust along z is projected
    body = Body(vehicle, lambda t: FORCE, lambda t: TORQUE)
    belief = Belief(FORCE, TORQUE, np.zeros(3))
    states, _ = fly(body, controller, at_rest(), 6.0, lambda t: window, lambda t: controller.believe(belief))
    assert np.abs(states[-1, POSITION]).max() < 1e-6


def test_a_believed_thrust_scale_is_divided_out():
    vehicle, window = vehicle_of("torrente"), hovering(vehicle_of("torrente"))
    controller = Geometric(**INTERPRETED).controller(vehicle)
    controller.reset(at_rest(), window)
    controller.believe(Belief(np.zeros(3), np.zeros(3), np.zeros(3), 0.8))
    u, _ = controller.step(Measurement(0.0, at_rest(), None, None), window)
    assert u == pytest.approx(vehicle.hover_thrust / 0.8)


def test_the_adaptive_variant_learns_a_constant_force_and_torque():
    """Goodarzi et al. 2015: no error is left, and the estimates are the disturbance."""
    vehicle, window = vehicle_of("torrente"), hovering(vehicle_of("torrente"))
    keys = Geometric(**INTERPRETED, force_adaptation=8.0, torque_adaptation=60.0)
    controller = keys.controller(vehicle)
    states, _ = fly(Body(vehicle, lambda t: FORCE, lambda t: TORQUE), controller, at_rest(), 15.0, lambda t: window)
    assert np.abs(states[-1, POSITION]).max() < 1e-4
    learned = controller.memory.now
    assert learned[:3] == pytest.approx(FORCE / vehicle.mass, abs=2e-3)
    assert learned[3:] == pytest.approx(TORQUE / np.diag(vehicle.inertia_matrix), abs=2e-3)
    controller.reset(at_rest(), window)
    assert not controller.memory.now.any()


def test_what_is_adapted_stays_in_its_ball():
    vehicle, window = vehicle_of("torrente"), hovering(vehicle_of("torrente"))
    keys = Geometric(**INTERPRETED, force_adaptation=50.0, force_limit=0.5)
    controller = keys.controller(vehicle)
    fly(Body(vehicle, lambda t: FORCE), controller, at_rest(), 3.0, lambda t: window)
    assert np.linalg.norm(controller.memory.now[:3]) == pytest.approx(0.5)


def test_compiled_and_interpreted_give_the_same_commands():
    vehicle, x = vehicle_of("lei_li"), at_rest((0.2, 0.1, -0.3), Rotation.from_rotvec([0.4, 0.3, -0.2]))
    commands = []
    for backend in ("compiled", "interpreted"):
        controller = Geometric(backend=backend).controller(vehicle)
        controller.reset(x, hovering(vehicle))
        commands.append(controller.step(Measurement(0.0, x, None, None), hovering(vehicle))[0])
    assert commands[0] == pytest.approx(commands[1], rel=1e-12)


def test_the_air_is_that_of_the_state_and_of_the_believed_wind():
    """At rest, a model of drag is an assumed force of the same size; wind takes its part of the velocity."""
    from quadexp.models.linear_drag import linear_drag_residual

    vehicle, window, drag = vehicle_of("torrente"), hovering(vehicle_of("torrente")), np.array([0.5, 0.3, 0.1])
    knowing = Geometric(**INTERPRETED).controller(vehicle, linear_drag_residual(vehicle, drag))
    told = Geometric(**INTERPRETED).controller(vehicle)
    x = at_rest((0.1, -0.2, 0.3), Rotation.from_rotvec([0.3, -0.2, 0.5]))
    x[VELOCITY], wind = (2.0, -1.0, 0.5), np.array([1.5, 3.0, 0.0])
    commands = []
    for controller, through in ((knowing, np.zeros(3)), (knowing, wind), (told, np.zeros(3)), (told, wind)):
        controller.reset(x, window)
        R = rotation(x)
        force = (
            np.zeros(3)
            if controller is knowing
            else -vehicle.mass * R.apply(drag * R.inv().apply(x[VELOCITY] - through))
        )
        controller.believe(Belief(force, np.zeros(3), through))
        commands.append(controller.step(Measurement(0.0, x, None, None), window)[0])
    assert commands[0] == pytest.approx(commands[2]) and commands[1] == pytest.approx(commands[3])
    assert np.abs(commands[0] - commands[1]).max() > 0.1


def test_an_observer_around_it_takes_the_offset_of_an_unknown_force_away():
    push = ["controller=geometric", "plant=ideal", "trajectory=hover", "trajectory.duration=6"]
    push += ["external=push", "external.force=[1.5,-1,0.5]", "external.torque=[0.03,0.02,0.01]"]
    offsets = []
    for observer in ("none", "disturbance"):
        columns = fly_one(compose([*push, f"observer={observer}"])).columns
        offsets.append(max(abs(columns[f"p_{axis}"][-1] - columns[f"ref_p_{axis}"][-1]) for axis in "xyz"))
    assert offsets[0] > 0.05 and offsets[1] < 1e-4
