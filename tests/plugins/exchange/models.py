"""Identified vehicles whose truth is known, and what a test computes of them by itself."""

from functools import cache

import numpy as np

from quadexp.experiment.vehicle_of import vehicle_named
from quadexp.log.schema import Flight
from quadexp.plugins.identification.vehicle_model import FitSettings, VehicleModel, fit_vehicle_model
from tests.models.logged_flights import logged_flight

CURVE = (1.5, 3.0)  # m/s^2 of s V/4 and its square: of tests.models.logged_flights
HUMMINGBIRD = {  # RotorPy 3's rotorpy/vehicles/hummingbird_params.py, N, m, rad, s
    "k_eta": 5.57e-6, "k_d": 1.19e-4, "k_z": 2.32e-4, "k_h": 3.39e-3, "c_Dx": 0.5e-2, "c_Dy": 0.5e-2, "c_Dz": 1e-2,
}  # fmt: skip
VEHICLES = {name: vehicle_named(name, None) for name in ("crazyflie", "hummingbird")}


def named(flight: Flight, vehicle) -> Flight:
    return Flight(flight.columns, flight.metadata | {"vehicle": vehicle.record})


@cache
def crazyflie_flights(count: int = 2, first: int = 0) -> tuple[Flight, ...]:
    """On motor commands and battery voltage, with linear drag."""
    vehicle = vehicle_named("crazyflie", None)
    return tuple(named(logged_flight(first + seed, name=f"flight_{seed}"), vehicle) for seed in range(count))


@cache
def crazyflie(drag: str = "linear") -> VehicleModel:
    """Of `crazyflie_flights`; the best model is linear."""
    vehicle = vehicle_named("crazyflie", None)
    return fit_vehicle_model(crazyflie_flights(), vehicle, FitSettings(kinds=()), best=drag)


def rotorpy_force(v: np.ndarray, w: np.ndarray, air: dict[str, float]) -> np.ndarray:
    """RotorPy's force on a body that does not turn, (k, 3) (N), written from its paper (arXiv 2306.04485)."""
    force = np.zeros_like(v)
    for i in range(len(v)):
        for speed in w[i]:
            force[i, 2] += air["k_eta"] * speed**2 + air["k_h"] * (v[i, 0] ** 2 + v[i, 1] ** 2)
            force[i] -= speed * np.array([air["k_d"], air["k_d"], air["k_z"]]) * v[i]
        force[i] -= np.linalg.norm(v[i]) * np.array([air["c_Dx"], air["c_Dy"], air["c_Dz"]]) * v[i]
    return force


def hummingbird_flights() -> list[Flight]:
    """On rotor speeds, in the air of RotorPy's Hummingbird, with little noise."""
    vehicle = vehicle_named("hummingbird", None)
    flights = []
    for seed in range(2):
        flight = logged_flight(seed, seconds=30.0, memory=0.0)
        rng = np.random.default_rng(seed)
        hover = np.sqrt(vehicle.hover_thrust / HUMMINGBIRD["k_eta"])
        wave = np.sin(np.outer(flight.t, [0.9, 1.1, 1.3, 0.7]) + rng.uniform(0, 6, 4))
        speed = hover * (1 + 0.25 * wave)
        body = 2.0 * flight.air_velocity
        force = rotorpy_force(body, speed, HUMMINGBIRD) / vehicle.mass
        columns = dict(flight.columns)
        for name in [name for name in columns if name.startswith(("motor_command", "battery"))]:
            del columns[name]
        for i, axis in enumerate("xyz"):
            columns[f"v_{axis}"] = 2.0 * columns[f"v_{axis}"]
            columns[f"acc_{axis}"] = force[:, i] + 1e-3 * rng.normal(size=len(force))
        columns |= {f"rotor_speed_{i}": speed[:, i] for i in range(4)}
        flights.append(named(Flight(columns, flight.metadata), vehicle))
    return flights


@cache
def hummingbird() -> VehicleModel:
    """The blade element without the radius, which RotorPy's air is."""
    vehicle = vehicle_named("hummingbird", None)
    return fit_vehicle_model(
        hummingbird_flights(), vehicle, FitSettings(induced=False, signal="rotor_speed"), best="blade_element"
    )


def states(model, vehicle, count: int = 200):
    """Random velocities (k, 3) inside the model's range (m/s), rates (k, 3), quaternions (k, 4), thrusts (k, n) (N)."""
    rng = np.random.default_rng(1)
    ranges = model.feature_range if model is not None else {}
    velocity = np.stack([rng.uniform(*ranges.get(f"v_{axis}", (-4, 4)), count) for axis in "xyz"], axis=1)
    quaternion = rng.normal(size=(count, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1)[:, None]
    thrust = vehicle.hover_thrust * rng.uniform(0.4, 1.8, (count, vehicle.n_rotors))
    return velocity, rng.normal(size=(count, 3)), quaternion, thrust


def rotation(q: np.ndarray) -> np.ndarray:
    """Body to world, (k, 3, 3), of quaternions w first."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(q, scalar_first=True).as_matrix()


def specific_force(model, vehicle, velocity: np.ndarray, thrust: np.ndarray, kind: str = "best") -> np.ndarray:
    """Of the model without offsets, (k, 3) (m/s^2); thrust: of its curve (N)."""
    air = model.model(kind)
    force = air.acceleration(velocity, thrust / vehicle.mass)
    force[:, 2] += thrust.sum(axis=1) / vehicle.mass
    return force - [air.coefficient("x", "offset")[0], air.coefficient("y", "offset")[0], 0.0]


def torque(vehicle, thrust: np.ndarray) -> np.ndarray:
    """r x F and reaction of the rotors, (k, 3) (N m), rotor by rotor."""
    total = np.zeros((len(thrust), 3))
    for i, (position, spin) in enumerate(zip(vehicle.rotor_position, vehicle.rotor_spin, strict=True)):
        up = np.outer(thrust[:, i], [0, 0, 1.0])
        total += np.cross(position, up) + spin * vehicle.torque_coefficient * up
    return total


def relative(found: np.ndarray, wanted: np.ndarray) -> float:
    """rms of the difference, per rms of what is wanted."""
    return float(np.sqrt(np.mean((found - wanted) ** 2) / np.mean(wanted**2)))
