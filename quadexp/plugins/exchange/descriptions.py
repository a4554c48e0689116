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

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.plugins.exchange.document import XML, Target, Written
from quadexp.plugins.exchange.known import Known, Quantity, of_file
from quadexp.plugins.exchange.simulators import (
    MOMENTS,
    PRODUCTS,
    RPM,
    SPEEDS,
    body,
    hub_force,
    hub_lost,
    lag,
    largest_speed,
    linear_drag,
    linear_lost,
    per_rotor,
)

TEMPLATES = Path(__file__).with_name("templates")
ROTOR_SHARE = 1e-3  # of the mass, in each rotor link of SDF
ROTOR_INERTIA = 1e-8 * np.diag([1.0, 1.0, 2.0])  # kg m^2, of a rotor link
HEIGHT = 0.1  # of the shape that stands for the body, of its width
NO_SHAPE = "the shape: a flat box as wide as the rotors are apart"


def numeral(value: Any) -> str:
    """Numbers with the digits that give them back."""
    return " ".join(repr(float(number)) for number in np.ravel(value))


def filled(template: str, known: Known, numbers: dict[str, Quantity], **more: Any) -> str:
    """A template with the vehicle, the numbers and more."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(loader=FileSystemLoader(TEMPLATES), undefined=StrictUndefined, autoescape=True)
    environment.filters["n"] = numeral
    vehicle = known.vehicle
    span = np.ptp(np.array(vehicle.rotor_position, float), axis=0)
    more |= {name: number.value for name, number in numbers.items()}
    more["box"] = np.array([span[0], span[1], HEIGHT * max(span[0], span[1])])
    more["rotors"] = list(zip(vehicle.rotor_position, vehicle.rotor_spin, strict=True))
    return environment.get_template(template).render(name=vehicle.name, moments=MOMENTS, **more) + "\n"


def sdf(known: Known) -> Written:
    """A model for Gazebo: a base, and a link, joint and motor model a rotor."""
    known.require_speeds("sdf")
    vehicle = known.vehicle
    drag = per_rotor(known)["k_d"]
    tau, lost = lag(known)
    numbers = body(known)
    numbers["motorConstant"] = known.quantity(lambda p: p.k, "N s^2")
    numbers["momentConstant"] = of_file(vehicle.torque_coefficient, "m")
    numbers["rotorDragCoefficient"] = drag
    numbers["timeConstant"] = tau
    numbers["maxRotVelocity"] = largest_speed(known)
    rotor_mass = ROTOR_SHARE * vehicle.mass
    base_inertia = vehicle.inertia_matrix.copy()
    for position in np.array(vehicle.rotor_position, float):
        base_inertia -= ROTOR_INERTIA + rotor_mass * (position @ position * np.eye(3) - np.outer(position, position))
    text = filled(
        "model.sdf",
        known,
        numbers,
        rotor_mass=rotor_mass,
        rotor_inertia=ROTOR_INERTIA,
        base_inertia=base_inertia,
        base_mass=vehicle.mass - vehicle.n_rotors * rotor_mass,
    )
    lost += [
        "drag along z, of the body (|v| v), translational lift: the motor model has none",
        "rollingMomentCoefficient: not identified, 0 (and there it acts along the velocity, not across it)",
        NO_SHAPE,
        *hub_lost(known, {"k_d": drag}),
    ]
    return Written(text, numbers, lost)


def gym_pybullet(known: Known) -> Written:
    """The drone CF2X of gym-pybullet-drones: takes the place of its assets/cf2x.urdf."""
    known.require_speeds("gym_pybullet")
    order = known.place("gym_pybullet", ("fr", "br", "bl", "fl"), (-1, 1, -1, 1))
    known.same_arms("gym_pybullet")
    vehicle = known.vehicle
    air = per_rotor(known)
    arm = float(np.linalg.norm(vehicle.rotor_position[0][:2]))
    numbers = body(known)
    numbers["kf"] = known.quantity(lambda p: p.k * RPM**2, "N/rpm^2")
    numbers["km"] = known.quantity(lambda p: p.torque_coefficient * p.k * RPM**2, "N m/rpm^2")
    numbers["thrust2weight"] = of_file(vehicle.thrust_max / vehicle.hover_thrust, "1")
    numbers["arm"] = of_file(arm, "m")
    numbers["drag_coeff_xy"] = air["k_d"]
    numbers["drag_coeff_z"] = air["k_z"]

    def world_drag(velocity: np.ndarray, thrust: np.ndarray) -> np.ndarray:
        turned = Rotation.random(len(velocity), random_state=0)
        values = {name: air[name].value for name in ("k_d", "k_z")}
        return turned.inv().apply(hub_force(known, turned.apply(velocity), thrust, values))

    radius = vehicle.rotor.radius if vehicle.rotor else arm / 2
    positions = [vehicle.rotor_position[i] for i in order]
    text = filled("cf2x.urdf", known, numbers, prop_radius=radius, positions=positions)
    lost = [
        "rotors in its order: front right, back right, back left, front left",
        "drag acts in Physics.PYB_DRAG only, and along the world's axes; what follows is at random attitudes",
        "gravity: 9.8 m/s^2 is built in",
        "motor lag, drag of the body (|v| v), translational lift: there is none",
        "ground effect and downwash: not identified, 0",
        f"{PRODUCTS}: not in Physics.DYN",
        NO_SHAPE,
        *known.departure(world_drag),
    ]
    return Written(text, numbers, lost)


def mjcf(known: Known) -> Written:
    """A model for MuJoCo: thrusts in N in, linear drag inside."""
    vehicle = known.vehicle
    drag = linear_drag(known)
    numbers = body(known) | {f"drag_{axis}": number for axis, number in drag.items()}
    numbers["gear"] = of_file(vehicle.torque_coefficient, "m")
    numbers["ctrlrange"] = of_file([vehicle.thrust_min, vehicle.thrust_max], "N")
    scale = known.facts["sigma"].value
    lost = [
        f"ctrl 0 to n - 1 are thrusts in N, not commands: {scale:.4g} times those of the curve, or of the vehicle file",
        "the controls of drag_x, drag_y, drag_z do nothing",
        "motor lag",
        "wind (the velocity is that of the body, not of the air)",
        NO_SHAPE,
        *linear_lost(known, drag),
    ]
    return Written(filled("mujoco.xml", known, numbers, gravity=vehicle.gravity), numbers, lost)


SDF = Target("sdf", sdf, ".sdf", "A model for Gazebo (gz-sim, MulticopterMotorModel)", SPEEDS, XML)
GYM_PYBULLET = Target(
    "gym_pybullet", gym_pybullet, ".urdf", "The CF2X of gym-pybullet-drones (its assets/cf2x.urdf)", comment=XML
)
MJCF = Target("mjcf", mjcf, ".xml", "A model for MuJoCo", comment=XML)
