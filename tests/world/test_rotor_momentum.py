"""Rotors as gyroscopes: nothing but the air turns a vehicle with its rotors, so that its angular momentum is kept.

About the centre of mass and along the axes of the world it is L = R (J w + h) with h = -J_p sum_i s_i Omega_i e_z of
rotors that turn against their reaction torques s_i; it is computed here from the states alone.
"""

import casadi as ca
import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment.build import build_plant, build_vehicle, unshared
from quadexp.parts.compose import compose
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, RATE
from quadexp.plugins.exchange import crazyflies
from quadexp.plugins.foreign.drone_models import derivative
from quadexp.world.actuator import Actuator
from quadexp.world.true_vehicle import TrueVehicle
from quadexp.world.world import World
from tests.composing import _from_nothing  # noqa: F401 - what is installed changes from test to test
from tests.models.residuals import with_rotors
from tests.world.airframes import ideal

RPM = np.pi / 30  # rad/s
PERIOD = 0.02
TURNING = np.r_[np.zeros(3), 1, np.zeros(6), 1.0, 2.0, -0.5]
DRONE = """[cf2x_L250]
mass = 0.0328
J = [[16.8e-6, 0.0, 0.0], [0.0, 17.0e-6, 0.0], [0.0, 0.0, 29.8e-6]]
thrust_min = 0.01
thrust_max = 0.12
L = 0.03253
prop_inertia = 34.52e-9
rpm2thrust = [0.0, -5.4e-7, 2.46e-10]
rpm2torque = [0.0, 0.0, 0.0]
thrust2torque = 0.0073
rotor_dyn_coef = [7.4, 0.0, 0.0, 2.4e-4]
mixing_matrix = [[-1.0, -1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, -1.0], [-1.0, 1.0, -1.0, 1.0]]
drag_matrix = [[-0.015, 0.0, 0.0], [0.0, -0.015, 0.0], [0.0, 0.0, -0.0139]]
"""
CRAZYFLIE = ["vehicle=cf2x_L250", "plant=drone_models", "plant.backend=interpreted"]


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Writes the files of an installed crazyflow with one drone, whose air does not turn it."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(drone=DRONE):
        folder = tmp_path / "crazyflow" / "dynamics" / "first_principles"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "params.toml").write_text(drone, encoding="utf-8")
        (tmp_path / "crazyflow" / "__init__.py").write_text("raise ImportError('files are read, code is not')\n")

    return write


def crazyflie(*overrides):
    config = compose([*CRAZYFLIE, *overrides])
    with unshared():
        return build_plant(build_vehicle(config.vehicle), config.plant)


def momentum(vehicle, x, speeds, rotor_inertia):
    """L (3,), world (N m s)."""
    h = [0.0, 0.0, -rotor_inertia * np.dot(vehicle.rotor_spin, speeds)]
    return rotation_matrix(ca.DM(x[ATTITUDE])).full() @ (vehicle.inertia_matrix @ x[RATE] + h)


def kept(vehicle, advance, rotor_inertia, speeds):
    """By how much of itself L changes in 0.6 s, in which two pairs of rotors, whose arms cancel, change their speeds.

    advance: (x, thrusts) -> x after a period. speeds: () -> those of the rotors now (rad/s).
    """
    x = TURNING.copy()
    first, most = momentum(vehicle, x, speeds(), rotor_inertia), 0.0
    for k in range(30):
        pairs = (1.4, 0.7) if k < 15 else (0.6, 1.2)
        x = advance(x, vehicle.hover_thrust * np.tile(pairs, 2))
        most = max(most, np.abs(momentum(vehicle, x, speeds(), rotor_inertia) - first).max())
    turned = abs(rotor_inertia * np.dot(vehicle.rotor_spin, speeds()) * np.linalg.norm(x[RATE]) * 0.6)
    assert turned > 0.02 * np.linalg.norm(first)  # so that a wrong sign would be seen
    return most / np.linalg.norm(first)


def test_the_crazyflie_keeps_its_angular_momentum(package):
    package()
    plant = crazyflie()
    error = kept(
        plant.vehicle, lambda x, u: plant.advance(x, u, PERIOD)[0], plant.keys.propeller_inertia,
        lambda: plant.rotor_speed,
    )  # fmt: skip
    assert error < 1e-8


@pytest.mark.parametrize("lag_of", ["rotor_speed", "thrust"])
@pytest.mark.parametrize("airframe", ["ideal", "rotorpy", "other inertia"])
def test_rotors_of_an_actuator_keep_the_angular_momentum(vehicle, airframe, lag_of):
    """Without reaction torques of the air; the world holds a torque over a step, so to that order."""
    inertia = 4e-6
    lagging = Actuator(time_constant_up=0.05, time_constant_down=0.08, lag_of=lag_of, rotor_inertia=inertia)
    without_torque = TrueVehicle(torque_coefficient=0.0, inertia=(1.3, 0.9, 1.1) if "other" in airframe else (1, 1, 1))
    errors = []
    for step in (1e-3, 5e-4):
        plant = ideal(with_rotors(vehicle), step)
        if airframe == "rotorpy":
            keys = ["plant.aero=false", "plant.motor_lag=0", "plant.backend=interpreted", f"plant.step={step}"]
            config = compose(["vehicle=hummingbird", "plant=rotorpy", *keys])
            with unshared():
                plant = build_plant(build_vehicle(config.vehicle), config.plant)
        world = World(plant, [without_torque, lagging])
        noise = world.begin(TURNING, PERIOD, 1.0, np.random.default_rng(0))
        errors.append(
            kept(
                world.vehicle, lambda x, u, w=world, n=noise: w.advance(x, u, PERIOD, n)[0], inertia,
                lambda w=world: w.rotor_speed,
            )
        )  # fmt: skip
    assert errors[1] < 2e-3 and errors[1] < 0.6 * errors[0] + 1e-9


@pytest.mark.parametrize("rates", [(1, 2, 0), (-2, 1, 3), (0.5, -1, -2)])
def test_the_torque_is_the_change_of_the_rotors_momentum(package, rates):
    """tau = -w x h - h', at rotors of 15, 18, 15, 18 krpm: 4.34e-5 N m in roll at w = (1, 2, 0) rad/s."""
    package()
    plant, rates = crazyflie(), np.array(rates, float)
    vehicle, J = plant.vehicle, plant.vehicle.inertia_matrix
    speeds = 1000 * RPM * np.array([15, 18, 15, 18])
    s = np.r_[np.zeros(3), 1, np.zeros(6), rates, speeds]
    change = derivative(vehicle)(s, np.full(4, 0.08), plant.parameters(0.0))[0].full().ravel()
    h = np.array([0, 0, -34.52e-9 * np.dot(vehicle.rotor_spin, speeds)])
    h_change = np.array([0, 0, -34.52e-9 * np.dot(vehicle.rotor_spin, change[13:])])
    torque = J @ change[RATE] + np.cross(rates, J @ rates)
    assert torque == pytest.approx(-np.cross(rates, h) - h_change, rel=1e-9, abs=1e-15)
    if tuple(rates) == (1, 2, 0):
        assert torque[0] == pytest.approx(4.34e-5, rel=1e-3)


# ------------------------------------------------------------------------------------------ the files of the package
def test_numbers_are_those_of_the_installed_crazyflow(package):
    package()
    config = compose(CRAZYFLIE)
    assert config.vehicle.mass == 0.0328 and config.plant.linear_drag == (0.015, 0.015, 0.0139)
    assert config.vehicle.torque_coefficient == 0.0073 and config.vehicle.gravity == 9.81
    assert config.vehicle.rotor_position[1] == (-0.03253, -0.03253, 0.0)
    curves = DRONE.replace("thrust2torque = 0.0073\n", "").replace("[0.0, 0.0, 0.0]\n", "[0.0, 0.0, 1.46e-12]\n", 1)
    package(curves)  # as crazyflow's own, which state no such ratio: that of the curves in hover
    vehicle = compose(CRAZYFLIE).vehicle
    in_hover = 1.46e-12 * vehicle.hover_thrust / (vehicle.thrust_coefficient * RPM**2)
    assert vehicle.torque_coefficient == pytest.approx(in_hover / vehicle.hover_thrust, rel=1e-9)
    package(DRONE.replace("0.0328", "0.0400"))
    assert compose(CRAZYFLIE).vehicle.mass == 0.04
    assert compose([*CRAZYFLIE, "vehicle.mass=0.03"]).vehicle.mass == 0.03


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (DRONE.replace("cf2x_L250", "hb_x500"), "params.toml: not the numbers of cf2x_L250.*KeyError"),
        (DRONE.replace("rpm2thrust", "rpm2lift"), "params.toml: not the numbers of cf2x_L250.*rpm2thrust"),
        (DRONE.replace("[[-0.015, 0.0", "[[-0.015, 0.1"), "drag_matrix is not diagonal"),
        (DRONE.replace("mass = 0.0328", "mass = "), "params.toml: .*line 2"),
        (DRONE.replace("0.0328", "-0.0328"), "params.toml: not the numbers of cf2x_L250"),
        (DRONE.replace("0.0328", "[0.0328]"), "params.toml: not the numbers of cf2x_L250"),
    ],
)
def test_other_files_are_refused_in_one_line(package, given, message):
    package(given)
    with pytest.raises(UsageError, match=message) as refused:
        compose(CRAZYFLIE)
    assert "\n" not in str(refused.value)


def test_without_a_package_it_says_which_to_install(monkeypatch):
    monkeypatch.setattr(crazyflies, "FILES", {"no_such_package": {"params.toml": ""}})
    with pytest.raises(UsageError, match=r"cf2x_L250.*pip install crazyflow, or 'quadexp\[drone-models\]'"):
        compose(CRAZYFLIE)
