"""Parameter files of simulators in Python and C++: RotorPy, crazyflow, agilicious.

Symbols as in known.py; J: inertia, r_i = (x, y, z) and s_i: rotors, tau: motor lag, w_h: rotor speed in hover.

    RotorPy 3      T = k_eta w^2 + k_h V_h^2, H = -w diag(k_d, k_d, k_z) v, -|v| diag(c_D) v
                   k_eta = k, k_m = c_tau k, k_d = m hub kappa, k_z = m climb kappa, k_h = m advance, c_D = m body;
                   of linear drag k_d = m d / (n w_h), k_z likewise: exact in hover, elsewhere it grows with w
    crazyflow 0.4  f = rpm2thrust polynomial in rpm, J w' = L mixing f ..., -drag_matrix v
                   rpm2thrust = [0, 0, k (pi/30)^2], rpm2torque = c_tau times that, L mixing = [y, -x], s
                   drag_matrix = -m diag(d), rotor_dyn_coef = [1/tau, 0, 1/tau, 0]
    agilicious     thrust_map = k, kappa = c_tau, aero_coeff_1 = m d; rotors fr, bl, br, fl (front, back, left, right)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from quadexp.errors import UsageError
from quadexp.plugins.exchange.document import Target, Written
from quadexp.plugins.exchange.known import AXES, Known, Quantity, is_per_speed, of_file

RPM = np.pi / 30  # rad/s
MOMENTS = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
NO_LAG = 1e-3  # s, where the motors' lag is not known: as good as none
LAG_UNKNOWN = f"the motors' lag: not known, {NO_LAG:g} s is as good as none (--motor-lag S)"
PRODUCTS = "products of inertia"
FOR_LINEAR = "linear drag written per rotor speed: exact at the rotor speed of hover, elsewhere it grows with the speed"


def linear_force(velocity: np.ndarray, drag: Sequence[float]) -> np.ndarray:
    """-d v, (k, 3) (m/s^2)."""
    return -velocity * np.asarray(drag)


def hub_force(known: Known, velocity: np.ndarray, thrust: np.ndarray, air: dict[str, float]) -> np.ndarray:
    """RotorPy's air per mass, (k, 3) (m/s^2). thrust: of the curve, per mass (k, n) (m/s^2). air: 0 where absent."""
    speeds = (np.sqrt(thrust) / known.value(lambda p: p.kappa)).sum(axis=1, keepdims=True)
    per_speed = [air.get(name, 0.0) for name in ("k_d", "k_d", "k_z")]
    per_square = [air.get(f"c_D{axis}", 0.0) for axis in AXES]
    force = -velocity * (speeds * per_speed + np.linalg.norm(velocity, axis=1, keepdims=True) * per_square)
    force[:, 2] += known.vehicle.n_rotors * air.get("k_h", 0.0) * (velocity[:, 0] ** 2 + velocity[:, 1] ** 2)
    return force / known.vehicle.mass


def per_rotor(known: Known) -> dict[str, Quantity]:
    """k_d, k_z (kg/rad), k_h, c_Dx, c_Dy, c_Dz (kg/m); a negative drag is 0, and says so."""
    if is_blade_element(known):
        numbers = {
            "k_d": known.quantity(lambda p: p.mass * p.kappa * (p.hub_x + p.hub_y) / 2, "kg/rad"),
            "k_z": known.quantity(lambda p: p.mass * p.kappa * p.climb, "kg/rad"),
            "k_h": known.times_mass("advance", "kg/m"),
        }
        numbers |= {f"c_D{axis}": known.times_mass(f"body_{axis}", "kg/m") for axis in AXES}
    else:
        numbers = {
            "k_d": known.quantity(lambda p: p.mass * (p.d_x + p.d_y) / (2 * p.n_rotors * p.hover_speed), "kg/rad"),
            "k_z": known.quantity(lambda p: p.mass * p.d_z / (p.n_rotors * p.hover_speed), "kg/rad"),
        }
        for name in ("k_h", "c_Dx", "c_Dy", "c_Dz"):
            numbers[name] = Quantity(0.0, "kg/m", "not in linear drag")
    return {name: number if name == "k_h" else number.not_negative() for name, number in numbers.items()}


def is_blade_element(known: Known) -> bool:
    """Whether what is known of the air has the form of RotorPy's."""
    return hasattr(known.model, "models") and is_per_speed(known.model.model())  # type: ignore[union-attr]


def linear_drag(known: Known) -> dict[str, Quantity]:
    """m d by axis (N s/m); a negative one is 0, and says so."""
    return {axis: known.times_mass(f"d_{axis}", "N s/m").not_negative() for axis in AXES}


def linear_lost(known: Known, drag: dict[str, Quantity]) -> list[str]:
    """What is lost by linear drag."""
    values = [drag[axis].value / known.vehicle.mass for axis in AXES]
    return ["drag beyond linear", *known.departure(lambda velocity, thrust: linear_force(velocity, values))]


def hub_lost(known: Known, air: dict[str, Quantity]) -> list[str]:
    """What is lost by RotorPy's form, with these numbers and the others 0."""
    values = {name: number.value for name, number in air.items()}
    lines = known.departure(lambda velocity, thrust: hub_force(known, velocity, thrust, values))
    if is_blade_element(known) or not lines:
        return lines
    return [*lines, FOR_LINEAR]


def lag(known: Known) -> tuple[Quantity, list[str]]:
    """The motors' time constant, and what is lost where it is not known."""
    number = known.quantity(lambda p: p.lag, "s")
    if number.value:
        return number, []
    return number._replace(value=NO_LAG), [LAG_UNKNOWN]


def body(known: Known) -> dict[str, Quantity]:
    """Mass and inertia."""
    return {"mass": of_file(known.vehicle.mass, "kg"), "inertia": of_file(known.vehicle.inertia_matrix, "kg m^2")}


def largest_speed(known: Known) -> Quantity:
    return known.quantity(lambda p: np.sqrt(p.thrust_max / p.k), "rad/s")


def plain(value: Any) -> Any:
    """Python's own numbers, whose repr every program reads."""
    return np.asarray(value).tolist()


def rotorpy(known: Known) -> Written:
    """quad_params of RotorPy's Multirotor, a Python file."""
    known.require_speeds("rotorpy")
    air = per_rotor(known)
    tau, lost = lag(known)
    numbers = body(known) | air
    numbers["k_eta"] = known.quantity(lambda p: p.k, "N s^2")
    numbers["k_m"] = known.quantity(lambda p: p.torque_coefficient * p.k, "N m s^2")
    numbers["tau_m"] = tau
    numbers["rotor_speed_max"] = largest_speed(known)
    rows: dict[str, Any] = {"mass": known.vehicle.mass, "num_rotors": known.vehicle.n_rotors}
    rows |= {name.capitalize(): known.vehicle.inertia_matrix[place] for name, place in MOMENTS.items()}
    rows |= {name: number.value for name, number in numbers.items() if name not in ("mass", "inertia")}
    rows["k_flap"] = 0.0
    rows["rotor_speed_min"] = 0.0
    rows["motor_noise_std"] = 0.0
    settings = "\n".join(f"    {name!r}: {plain(value)!r}," for name, value in rows.items())
    places = enumerate(known.vehicle.rotor_position, 1)
    positions = "\n".join(f"        'r{i}': np.array({plain(position)!r})," for i, position in places)
    text = f"""import numpy as np

quad_params = {{
{settings}
    'rotor_pos': {{
{positions}
    }},
    'rotor_directions': np.array({plain(known.vehicle.rotor_spin)!r}),
    'rI': np.zeros(3),
}}
"""
    lost += ["k_d by axis: one for x and y, their mean", "gains of RotorPy's own loops (k_w, k_v, kp_att, kd_att)"]
    return Written(text, numbers, [*lost, *hub_lost(known, air)])


def crazyflow(known: Known) -> Written:
    """A section of crazyflow's first_principles/params.toml, under the vehicle's name."""
    if known.vehicle.n_rotors != 4:
        raise UsageError(f"--to crazyflow: has four rotors, vehicle={known.vehicle.name} has {known.vehicle.n_rotors}")
    tau, lost = lag(known)
    drag = linear_drag(known)
    numbers = body(known)
    if known.signal == "rotor_speed":

        def thrust(p: Any) -> Any:
            return p.mass * p.sigma * np.array([0.0, p.c1 * RPM, p.c2 * RPM**2])
    else:
        known.require_speeds("crazyflow")

        def thrust(p: Any) -> Any:
            return np.array([0.0, 0.0, p.k * RPM**2])

    numbers["rpm2thrust"] = known.quantity(thrust, "N per rpm^i")
    numbers["rpm2torque"] = known.quantity(lambda p: p.torque_coefficient * thrust(p), "N m per rpm^i")
    numbers["tau"] = tau
    numbers |= {f"drag_{axis}": number for axis, number in drag.items()}
    x, y, _ = np.array(known.vehicle.rotor_position, float).T
    arm = float(np.abs([x, y]).max())
    rows: dict[str, Any] = {
        "mass": known.vehicle.mass,
        "J": known.vehicle.inertia_matrix,
        "thrust_min": known.vehicle.thrust_min,
        "thrust_max": known.vehicle.thrust_max,
        "L": arm,
        "prop_inertia": 0.0,
        "rpm2thrust": numbers["rpm2thrust"].value,
        "rpm2torque": numbers["rpm2torque"].value,
        "rotor_dyn_coef": [1 / tau.value, 0.0, 1 / tau.value, 0.0],
        "mixing_matrix": np.array([y / arm, -x / arm, known.vehicle.rotor_spin]),
        "drag_matrix": -np.diag([drag[axis].value for axis in AXES]) + 0.0,
    }
    text = f'["{known.vehicle.name}"]\n' + "".join(f"{name} = {plain(value)!r}\n" for name, value in rows.items())
    lost += linear_lost(known, drag)
    lost += ["the models so_rpy* (rpy_coef, rpy_rates_coef, cmd_rpy_coef): of the attitude loop, not identified"]
    return Written(text, numbers, lost)


def agilicious(known: Known) -> Written:
    """A quadrotor file of agilicious."""
    known.require_speeds("agilicious")
    quadrants = ("fr", "bl", "br", "fl")
    order = known.place("agilicious", quadrants, (-1, -1, 1, 1))
    tau, lost = lag(known)
    drag = linear_drag(known)
    numbers = body(known)
    numbers["thrust_map"] = known.quantity(lambda p: p.k, "N s^2")
    numbers["torque_map"] = known.quantity(lambda p: p.torque_coefficient * p.k, "N m s^2")
    vehicle = known.vehicle
    numbers["kappa"] = of_file(vehicle.torque_coefficient, "m")
    numbers["motor_tau"] = tau
    numbers["motor_omega_max"] = largest_speed(known)
    numbers |= {f"aero_coeff_1_{axis}": number for axis, number in drag.items()}
    rows: dict[str, Any] = {name: numbers[name].value for name in ("mass", "kappa", "motor_tau", "motor_omega_max")}
    rows |= {f"tbm_{quadrant}": vehicle.rotor_position[i] for quadrant, i in zip(quadrants, order, strict=True)}
    rows |= {name: [numbers[name].value, 0.0, 0.0] for name in ("thrust_map", "torque_map")}
    rows |= {
        "inertia": np.diag(vehicle.inertia_matrix),
        "omega_max": [vehicle.rate_max] * 3,
        "motor_omega_min": 0.0,
        "thrust_min": vehicle.thrust_min,
        "thrust_max": vehicle.thrust_max,
        "rotors_config": "cross",
        "aero_coeff_1": [drag[axis].value for axis in AXES],
        "aero_coeff_3": [0.0] * 3,
        "aero_coeff_h": 0.0,
    }
    text = "".join(f"{name}: {plain(value)}\n" for name, value in rows.items())
    lost += [PRODUCTS, *linear_lost(known, drag)]
    return Written(text, numbers, lost)


SPEEDS = frozenset({"motor_lag"})
ROTORPY = Target("rotorpy", rotorpy, ".py", "quad_params for RotorPy 3's Multirotor", SPEEDS)
CRAZYFLOW = Target("crazyflow", crazyflow, ".toml", "A drone for crazyflow 0.4 (first_principles/params.toml)", SPEEDS)
AGILICIOUS = Target("agilicious", agilicious, ".yaml", "A quadrotor for agilicious", SPEEDS)
