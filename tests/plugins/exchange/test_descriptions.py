"""Models in XML: mass and inertia are the vehicle's, and forces and torques those of the model."""

import importlib.util
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from quadexp.experiment.vehicle_of import vehicle_named
from tests.plugins.exchange.models import (
    HUMMINGBIRD,
    crazyflie,
    hummingbird,
    relative,
    rotation,
    specific_force,
    states,
    torque,
)

VEHICLE, CRAZYFLIE = vehicle_named("hummingbird", None), vehicle_named("crazyflie", None)
RPM = np.pi / 30


def floats(text: str) -> np.ndarray:
    return np.array(text.split(), float)


def inertia_of(element, prefix: str = "i") -> np.ndarray:
    """Of children or attributes ixx, ixy, .."""

    def number(name: str) -> float:
        child = element.find(name)
        return float(element.get(name) if child is None else child.text)

    names = [["xx", "xy", "xz"], ["xy", "yy", "yz"], ["xz", "yz", "zz"]]
    return np.array([[number(f"i{name}") for name in row] for row in names])


def test_the_links_of_gazebos_model_weigh_and_turn_as_the_vehicle(export):
    root = ElementTree.fromstring(export("hb", "sdf"))
    mass, inertia = 0.0, np.zeros((3, 3))
    for link in root.findall("model/link"):
        own = float(link.find("inertial/mass").text)
        place = floats(link.findtext("pose", "0 0 0 0 0 0"))[:3]
        mass += own
        inertia += inertia_of(link.find("inertial/inertia")) + own * (
            place @ place * np.eye(3) - np.outer(place, place)
        )
    assert mass == pytest.approx(VEHICLE.mass, rel=1e-12)
    assert inertia == pytest.approx(VEHICLE.inertia_matrix, rel=1e-9, abs=1e-12)


def test_rotors_of_gazebos_model(export):
    """MulticopterMotorModel: thrust k w^2, drag -|w| k_d v across the axis, torque -direction momentConstant thrust."""
    root = ElementTree.fromstring(export("hb", "sdf", "--motor-lag", "0.02"))
    model = root.find("model")
    velocity, _, _, thrust = states(hummingbird(), VEHICLE)
    plugins = model.findall("plugin")
    assert len(plugins) == 4 and plugins[0].get("name") == "gz::sim::systems::MulticopterMotorModel"
    force, moment = np.zeros((len(thrust), 3)), np.zeros((len(thrust), 3))
    scale = 1 + hummingbird().model().coefficient("z", "thrust")[0]
    for i, plugin in enumerate(plugins):
        value = {child.tag: child.text for child in plugin}
        assert int(value["actuator_number"]) == i and value["jointName"] == f"rotor_{i}_joint"
        assert model.find(f"joint[@name='rotor_{i}_joint']").findtext("child") == value["linkName"]
        place = floats(model.find(f"link[@name='{value['linkName']}']").findtext("pose"))[:3]
        direction = {"ccw": 1, "cw": -1}[value["turningDirection"]]
        w = np.sqrt(scale * thrust[:, i] / float(value["motorConstant"]))
        lift = np.outer(float(value["motorConstant"]) * w**2, [0, 0, 1])
        force += lift - np.outer(w * float(value["rotorDragCoefficient"]), [1, 1, 0]) * velocity
        moment += np.cross(place, lift) - direction * float(value["momentConstant"]) * lift
        assert value["timeConstantUp"] == value["timeConstantDown"] == "0.02"
        assert float(value["maxRotVelocity"]) == pytest.approx(1500, rel=2e-3)
    assert relative(moment, torque(VEHICLE, scale * thrust)) < 1e-12
    # what it has of the model: rotor drag in the plane, without translational lift, climb, body and hub_climb
    w = np.sqrt(scale * thrust / float(value["motorConstant"]))
    wanted = -HUMMINGBIRD["k_d"] * w.sum(axis=1, keepdims=True) * velocity[:, :2]
    assert relative(force[:, :2], wanted) < 3e-3
    assert force[:, 2] == pytest.approx(scale * thrust.sum(axis=1))


def urdf(text: str) -> tuple[dict[str, float], np.ndarray, ElementTree.Element]:
    """Properties, arms of prop0 to prop3, and the root, where gym-pybullet-drones' parser finds them."""
    root = ElementTree.fromstring(text)
    assert float(root[1][0][1].attrib["value"]) == VEHICLE.mass  # as BaseAviary._parseURDFParameters has it
    assert root[1][2].tag == "collision" and float(root[1][2][1][0].attrib["length"]) > 0
    assert len(root[1][2][0].attrib["xyz"].split()) == 3
    arms = [floats(root.find(f"link[@name='prop{i}_link']/inertial/origin").get("xyz")) for i in range(4)]
    return {name: float(value) for name, value in root[0].attrib.items()}, np.array(arms), root


def test_forces_and_torques_of_gym_pybullet_drones(export):
    """_physics: kf rpm^2 at the propellers, km rpm^2 with -, +, -, +; _drag: -coefficients sum(w) v."""
    found, arms, root = urdf(export("hb", "gym_pybullet"))
    assert inertia_of(root[1][0][2]) == pytest.approx(VEHICLE.inertia_matrix)
    velocity, _, _, thrust = states(hummingbird(), VEHICLE)
    scale = 1 + hummingbird().model().coefficient("z", "thrust")[0]
    order = [1, 2, 3, 0]  # of the Hummingbird's front left, front right, back right, back left: fr, br, bl, fl
    rpm = np.sqrt(scale * thrust[:, order] / found["kf"] * RPM**2) / RPM
    lift = found["kf"] * rpm**2
    moment = sum(np.cross(arms[i], np.outer(lift[:, i], [0, 0, 1])) for i in range(4))
    moment[:, 2] += found["km"] * (rpm**2 @ [-1, 1, -1, 1])
    assert relative(moment, torque(VEHICLE, scale * thrust)) < 1e-12
    turned = np.column_stack(  # _dynamics
        [
            -(lift @ [1, 1, -1, -1]) * found["arm"] / np.sqrt(2),
            (lift @ [-1, 1, 1, -1]) * found["arm"] / np.sqrt(2),
            found["km"] * (rpm**2 @ [-1, 1, -1, 1]),
        ]
    )
    assert relative(turned, moment) < 1e-9
    drag = -np.array([found["drag_coeff_xy"], found["drag_coeff_xy"], found["drag_coeff_z"]])
    drag = drag * (rpm * RPM).sum(axis=1, keepdims=True) * velocity
    w = np.sqrt(scale * thrust / HUMMINGBIRD["k_eta"])
    wanted = -np.array([HUMMINGBIRD["k_d"]] * 2 + [HUMMINGBIRD["k_z"]]) * w.sum(axis=1, keepdims=True) * velocity
    assert relative(drag, wanted) < 3e-3


def test_gym_pybullets_file_says_how_far_its_force_is(export):
    """Of bodies that are turned in any way, since the drag there has its coefficients along the world's axes."""
    text = export("hb", "gym_pybullet")
    found, _, _ = urdf(text)
    velocity, _, q, _ = states(hummingbird(), VEHICLE, 4000)
    thrust = VEHICLE.hover_thrust * np.random.default_rng(3).uniform(0.3, 1.9, (4000, 4))
    scale = 1 + hummingbird().model().coefficient("z", "thrust")[0]
    R = rotation(q)
    w = np.sqrt(scale * thrust / found["kf"] * RPM**2)
    world = np.einsum("kij,kj->ki", R, velocity)
    pull = -np.array([found["drag_coeff_xy"]] * 2 + [found["drag_coeff_z"]]) * w.sum(axis=1, keepdims=True) * world
    force = np.einsum("kji,kj->ki", R, pull)
    force[:, 2] += (found["kf"] / RPM**2 * w**2).sum(axis=1)
    away = relative(force / VEHICLE.mass, specific_force(hummingbird(), VEHICLE, velocity, thrust))
    said = float(re.search(r"specific force here: (\S+) %", text)[1])
    assert said == pytest.approx(100 * away, rel=0.1) and away > 0.02


def test_pybullet_reads_the_urdf(export, tmp_path):
    if importlib.util.find_spec("pybullet") is None:
        pytest.skip("pybullet is not installed")
    import pybullet

    export("hb", "gym_pybullet", out="cf2x.urdf")
    client = pybullet.connect(pybullet.DIRECT)
    drone = pybullet.loadURDF(str(tmp_path / "cf2x.urdf"), flags=pybullet.URDF_USE_INERTIA_FROM_FILE)
    mass, _, inertia, *_ = pybullet.getDynamicsInfo(drone, -1)
    assert mass == pytest.approx(VEHICLE.mass) and inertia == pytest.approx(np.diag(VEHICLE.inertia_matrix))
    assert pybullet.getNumJoints(drone) == 5
    pybullet.setGravity(0, 0, -9.8)
    pybullet.changeDynamics(drone, -1, linearDamping=0, angularDamping=0)
    pushed = np.array([1.0, 2.0, 3.0, 4.0])  # N
    for i, push in enumerate(pushed):
        pybullet.applyExternalForce(drone, i, [0, 0, push], [0, 0, 0], pybullet.LINK_FRAME)
    pybullet.stepSimulation()
    _, turn = pybullet.getBaseVelocity(drone)
    moment = torque(VEHICLE, pushed[[3, 0, 1, 2]][None])[0]
    wanted = np.linalg.solve(VEHICLE.inertia_matrix, moment)[:2] / 240
    assert np.array(turn)[:2] == pytest.approx(wanted, rel=1e-3)
    pybullet.disconnect(client)


def test_actuators_of_mujocos_model(export):
    """A site's actuator: force gear[:3], torque r x force + gear[3:], times ctrl, or bias -d times gear . velocity."""
    root = ElementTree.fromstring(export("cf", "mjcf"))
    body = root.find("worldbody/body")
    sites = {site.get("name"): floats(site.get("pos")) for site in body.findall("site")}
    velocity, _, _, thrust = states(crazyflie(), CRAZYFLIE)
    force, moment = np.zeros((len(thrust), 3)), np.zeros((len(thrust), 3))
    for i, actuator in enumerate(root.find("actuator")):
        gear = floats(actuator.get("gear"))
        if i < 4:
            strength = thrust[:, i]
            assert floats(actuator.get("ctrlrange")).tolist() == [CRAZYFLIE.thrust_min, CRAZYFLIE.thrust_max]
        else:
            strength = floats(actuator.get("biasprm"))[2] * (velocity @ gear[:3])
            assert floats(actuator.get("gainprm"))[0] == 0
        pull = np.outer(strength, gear[:3])
        force += pull
        moment += np.cross(sites[actuator.get("site")], pull) + np.outer(strength, gear[3:])
    assert relative(force / CRAZYFLIE.mass, specific_force(crazyflie(), CRAZYFLIE, velocity, thrust)) < 1e-12
    assert relative(moment, torque(CRAZYFLIE, thrust)) < 1e-12
    inertial = body.find("inertial")
    assert float(inertial.get("mass")) == CRAZYFLIE.mass
    assert floats(inertial.get("fullinertia"))[:3] == pytest.approx(np.diag(CRAZYFLIE.inertia_matrix))


def test_accelerations_by_mujoco_itself(export):
    if importlib.util.find_spec("mujoco") is None:
        pytest.skip("mujoco is not installed")
    import mujoco

    model = mujoco.MjModel.from_xml_string(export("cf", "mjcf"))
    data = mujoco.MjData(model)
    velocity, rate, q, thrust = states(crazyflie(), CRAZYFLIE)
    thrust = np.minimum(thrust, CRAZYFLIE.thrust_max)
    R, force, turn = rotation(q), [], []
    for i in range(len(thrust)):
        data.qpos[:] = [0, 0, 5, *q[i]]
        data.qvel[:] = [*(R[i] @ velocity[i]), *rate[i]]
        data.ctrl[:4] = thrust[i]
        mujoco.mj_forward(model, data)
        force.append(R[i].T @ (data.qacc[:3] + [0, 0, CRAZYFLIE.gravity]))
        turn.append(data.qacc[3:].copy())
    J = CRAZYFLIE.inertia_matrix
    wanted = np.linalg.solve(J, (torque(CRAZYFLIE, thrust) - np.cross(rate, rate @ J)).T).T
    assert relative(np.array(force), specific_force(crazyflie(), CRAZYFLIE, velocity, thrust)) < 1e-9
    assert relative(np.array(turn), wanted) < 1e-9


@pytest.mark.parametrize("to", ["sdf", "gym_pybullet", "mjcf"])
def test_the_head_is_a_comment_of_xml(export, to):
    text = export("hb", to)
    begin, end = text.index("<!--"), text.index("-->")
    assert "--" not in text[begin + 4 : end] and "What is not in this file" in text[begin:end]
    assert text.startswith('<?xml version="1.0"?>\n<!--') and text.count("<!--") == 1
