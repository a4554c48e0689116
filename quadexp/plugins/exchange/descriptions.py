"""Descriptions of a robot in XML: SDF for Gazebo, URDF for gym-pybullet-drones, MJCF for MuJoCo.

Symbols as in known.py; J: inertia, r_i and s_i: rotors, L: arm.

    SDF     MulticopterMotorModel of gz-sim, per rotor T = motorConstant w^2, Q = momentConstant T,
            drag = -w rotorDragCoefficient v in its plane: k, c_tau, k_d (simulators.py); ccw where s_i = -1.
            gz wants mass in a rotor's link: it is taken from the base, so that mass and inertia are the vehicle's.
    URDF    properties of the drone cf2x: T = kf rpm^2, Q = km rpm^2, drag = -drag_coeff sum(w) v, world axes:
            kf = k (pi/30)^2, km = c_tau kf, drag_coeff_xy = k_d, drag_coeff_z = k_z
    MJCF    a rotor: an actuator at its site with gear (0 0 1 0 0 s c_tau), ctrl in N; drag: three actuators with the
            affine bias -m d times the site's velocity, body axes
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from quadexp.plugins.exchange.document import XML, Target, Written
from quadexp.plugins.exchange.known import AXES, Known, Quantity, of_file
from quadexp.plugins.exchange.simulators import (
    MOMENTS,
    PRODUCTS,
    RPM,
    SPEEDS,
    body,
    hub_lost,
    lag,
    largest_speed,
    linear_drag,
    linear_lost,
    per_rotor,
)

ROTOR_SHARE = 1e-3  # of the mass, in each rotor link of SDF
ROTOR_INERTIA = 1e-8  # kg m^2, of a rotor link about its diameter; twice that about its axis
HEIGHT = 0.1  # of the shape that stands for the body, of its width
NO_SHAPE = "the shape: a flat box as wide as the rotors are apart"
Element = ElementTree.Element
add = ElementTree.SubElement


def numeral(*values: Any) -> str:
    """Numbers with the digits that give them back."""
    return " ".join(repr(float(value)) for value in np.hstack(values))


def leaf(parent: Element, tag: str, *values: Any) -> None:
    """A child with a text or with numbers."""
    add(parent, tag).text = values[0] if isinstance(values[0], str) else numeral(*values)


def document(root: Element) -> str:
    ElementTree.indent(root)
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def box(known: Known) -> np.ndarray:
    """Edges of the box that holds the rotors (m)."""
    span = np.ptp(np.array(known.vehicle.rotor_position, float), axis=0)
    return np.array([span[0], span[1], HEIGHT * max(span[0], span[1])])


# ---------------------------------------------------------------------------------------------------------------- SDF
def sdf(known: Known, firmware: str | None, path: Path) -> Written:
    """A model for Gazebo: a base, and a link, joint and motor model a rotor."""
    known.require_speeds("sdf")
    air = per_rotor(known)
    tau, lost = lag(known)
    numbers = body(known)
    numbers["motorConstant"] = known.quantity(lambda p: p.k, "N s^2")
    numbers["momentConstant"] = of_file(known.vehicle.torque_coefficient, "m")
    numbers["rotorDragCoefficient"] = air["k_d"]
    numbers["timeConstant"] = tau
    numbers["maxRotVelocity"] = largest_speed(known)
    root = Element("sdf", version="1.9")
    model = add(root, "model", name=known.vehicle.name)
    base = add(model, "link", name="base_link")
    rotor_mass = ROTOR_SHARE * known.vehicle.mass
    rotor_inertia = ROTOR_INERTIA * np.diag([1.0, 1.0, 2.0])
    rest = known.vehicle.inertia_matrix.copy()
    for position in np.array(known.vehicle.rotor_position, float):
        rest -= rotor_inertia + rotor_mass * (position @ position * np.eye(3) - np.outer(position, position))
    _inertial(base, known.vehicle.mass - known.vehicle.n_rotors * rotor_mass, rest)
    for kind in ("collision", "visual"):
        leaf(add(add(add(base, kind, name=f"base_{kind}"), "geometry"), "box"), "size", *box(known))
    for i, position in enumerate(known.vehicle.rotor_position):
        link = add(model, "link", name=f"rotor_{i}")
        leaf(link, "pose", *position, 0.0, 0.0, 0.0)
        _inertial(link, rotor_mass, rotor_inertia)
        joint = add(model, "joint", name=f"rotor_{i}_joint", type="revolute")
        leaf(joint, "parent", "base_link")
        leaf(joint, "child", f"rotor_{i}")
        axis = add(joint, "axis")
        leaf(axis, "xyz", 0, 0, 1)
        limit = add(axis, "limit")
        leaf(limit, "lower", -1e16)
        leaf(limit, "upper", 1e16)
    for i, spin in enumerate(known.vehicle.rotor_spin):
        _motor(model, i, "ccw" if spin < 0 else "cw", numbers)
    lost += [
        "drag along z, of the body (|v| v), translational lift: the motor model has none",
        "rollingMomentCoefficient: not identified, 0 (and there it acts along the velocity, not across it)",
        NO_SHAPE,
        *hub_lost(known, {"k_d": air["k_d"]}),
    ]
    return Written(document(root), numbers, lost)


def _inertial(link: Element, mass: float, inertia: np.ndarray) -> None:
    inertial = add(link, "inertial")
    leaf(inertial, "mass", mass)
    moments = add(inertial, "inertia")
    for name, place in MOMENTS.items():
        leaf(moments, name, inertia[place])


def _motor(model: Element, i: int, direction: str, numbers: dict[str, Quantity]) -> None:
    plugin = add(
        model,
        "plugin",
        filename="gz-sim-multicopter-motor-model-system",
        name="gz::sim::systems::MulticopterMotorModel",
    )
    texts = {
        "jointName": f"rotor_{i}_joint", "linkName": f"rotor_{i}", "actuator_number": str(i),
        "turningDirection": direction, "motorType": "velocity", "commandSubTopic": "command/motor_speed",
        "rollingMomentCoefficient": "0", "rotorVelocitySlowdownSim": "10",
    }  # fmt: skip
    for name, text in texts.items():
        leaf(plugin, name, text)
    for name in ("motorConstant", "momentConstant", "rotorDragCoefficient", "maxRotVelocity"):
        leaf(plugin, name, numbers[name].value)
    for name in ("timeConstantUp", "timeConstantDown"):
        leaf(plugin, name, numbers["timeConstant"].value)


# --------------------------------------------------------------------------------------------------------------- URDF
def gym_pybullet(known: Known, firmware: str | None, path: Path) -> Written:
    """The drone CF2X of gym-pybullet-drones: takes the place of its assets/cf2x.urdf."""
    known.require_speeds("gym_pybullet")
    order = known.place("gym_pybullet", ("fr", "br", "bl", "fl"), (-1, 1, -1, 1))
    known.same_arms("gym_pybullet")
    vehicle = known.vehicle
    air = per_rotor(known)
    numbers = body(known)
    numbers["kf"] = known.quantity(lambda p: p.k * RPM**2, "N/rpm^2")
    numbers["km"] = known.quantity(lambda p: p.torque_coefficient * p.k * RPM**2, "N m/rpm^2")
    numbers["thrust2weight"] = of_file(vehicle.thrust_max / vehicle.hover_thrust, "1")
    numbers["arm"] = of_file(float(np.linalg.norm(vehicle.rotor_position[0][:2])), "m")
    numbers["drag_coeff_xy"] = air["k_d"]
    numbers["drag_coeff_z"] = air["k_z"]
    names = ("arm", "kf", "km", "thrust2weight", "drag_coeff_xy", "drag_coeff_z")
    properties = {name: numeral(numbers[name].value) for name in names}
    radius = vehicle.rotor.radius if vehicle.rotor else numbers["arm"].value / 2
    properties |= {"prop_radius": numeral(radius), "max_speed_kmh": "30", "gnd_eff_coeff": "0"}
    properties |= {"dw_coeff_1": "0", "dw_coeff_2": "1", "dw_coeff_3": "0"}
    root = Element("robot", name="cf2")
    add(root, "properties", properties)
    base = _urdf_link(root, "base_link", (0.0, 0.0, 0.0), vehicle.mass, vehicle.inertia_matrix)
    width, depth, height = box(known)
    for kind in ("visual", "collision"):
        shape = add(base, kind)
        add(shape, "origin", rpy="0 0 0", xyz="0 0 0")
        geometry = add(shape, "geometry")
        if kind == "visual":
            add(geometry, "box", size=numeral(width, depth, height))
        else:
            add(geometry, "cylinder", radius=properties["arm"], length=numeral(height))
    places = {f"prop{i}": vehicle.rotor_position[rotor] for i, rotor in enumerate(order)}
    for name, position in (places | {"center_of_mass": (0.0, 0.0, 0.0)}).items():
        _urdf_link(root, f"{name}_link", position, 0.0, np.zeros((3, 3)))
        joint = add(root, "joint", name=f"{name}_joint", type="fixed")
        add(joint, "parent", link="base_link")
        add(joint, "child", link=f"{name}_link")
    lost = [
        "rotors in its order: front right, back right, back left, front left",
        "drag acts in Physics.PYB_DRAG only, along the world's axes; what follows is at level attitude",
        "gravity: 9.8 m/s^2 is built in",
        "motor lag, drag of the body (|v| v), translational lift: there is none",
        "ground effect and downwash: not identified, 0",
        f"{PRODUCTS}: not in Physics.DYN",
        NO_SHAPE,
        *hub_lost(known, {"k_d": air["k_d"], "k_z": air["k_z"]}),
    ]
    return Written(document(root), numbers, lost)


def _urdf_link(root: Element, name: str, position: Any, mass: float, inertia: np.ndarray) -> Element:
    link = add(root, "link", name=name)
    inertial = add(link, "inertial")
    add(inertial, "origin", rpy="0 0 0", xyz=numeral(position))
    add(inertial, "mass", value=numeral(mass))
    add(inertial, "inertia", {moment: numeral(inertia[place]) for moment, place in MOMENTS.items()})
    return link


# --------------------------------------------------------------------------------------------------------------- MJCF
def mjcf(known: Known, firmware: str | None, path: Path) -> Written:
    """A model for MuJoCo: thrusts in N in, linear drag inside."""
    vehicle = known.vehicle
    drag = linear_drag(known)
    numbers = body(known) | {f"drag_{axis}": number for axis, number in drag.items()}
    numbers["gear"] = of_file(known.vehicle.torque_coefficient, "m")
    numbers["ctrlrange"] = of_file([vehicle.thrust_min, vehicle.thrust_max], "N")
    root = Element("mujoco", model=vehicle.name)
    gravity = numeral(0, 0, -vehicle.gravity)
    add(root, "option", gravity=gravity, integrator="RK4", timestep="0.001", density="0", viscosity="0")
    frame = add(add(root, "worldbody"), "body", name=vehicle.name, pos="0 0 1")
    add(frame, "freejoint")
    inertia = vehicle.inertia_matrix
    full = numeral(inertia[0, 0], inertia[1, 1], inertia[2, 2], inertia[0, 1], inertia[0, 2], inertia[1, 2])
    add(frame, "inertial", pos="0 0 0", mass=numeral(vehicle.mass), fullinertia=full)
    add(frame, "geom", type="box", size=numeral(box(known) / 2), mass="0")
    add(frame, "site", name="centre", pos="0 0 0")
    actuators = add(root, "actuator")
    for i, (position, spin) in enumerate(zip(vehicle.rotor_position, vehicle.rotor_spin, strict=True)):
        add(frame, "site", name=f"rotor_{i}", pos=numeral(position))
        gear = numeral(0, 0, 1, 0, 0, spin * vehicle.torque_coefficient)
        limits = numeral(vehicle.thrust_min, vehicle.thrust_max)
        add(actuators, "general", name=f"u_{i}", site=f"rotor_{i}", gear=gear, ctrllimited="true", ctrlrange=limits)
    for axis, direction in zip(AXES, np.eye(3), strict=True):
        bias = numeral(0, 0, -drag[axis].value)
        gear = numeral(direction, 0, 0, 0)
        add(
            actuators, "general", name=f"drag_{axis}", site="centre", gear=gear, gaintype="fixed", gainprm="0",
            biastype="affine", biasprm=bias,
        )  # fmt: skip
    lost = [
        "ctrl 0 to n - 1 are the rotors' thrusts in N, not commands; the controls of drag_x, drag_y, drag_z do nothing",
        "motor lag",
        "wind (the velocity is that of the body, not of the air)",
        NO_SHAPE,
        *linear_lost(known, drag),
    ]
    return Written(document(root), numbers, lost)


SDF = Target("sdf", sdf, ".sdf", "A model for Gazebo (gz-sim, MulticopterMotorModel)", SPEEDS, XML)
GYM_PYBULLET = Target(
    "gym_pybullet", gym_pybullet, ".urdf", "The CF2X of gym-pybullet-drones (its assets/cf2x.urdf)", comment=XML
)
MJCF = Target("mjcf", mjcf, ".xml", "A model for MuJoCo", comment=XML)
