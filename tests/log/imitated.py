"""Imitated real flights whose truth is known: several vehicles and paths, sensors with noise, a mounting, rotors.

The path is a Lissajous figure with the small fast motions that a controller and the air make; attitude, rates and
specific force follow from it with linear drag, rotor thrusts from the rigid body of the vehicle. What the rotors do is
the torque that the motion needs, less an offset, over a gain, `lag` seconds early.
"""

from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.experiment.build import build_vehicle
from quadexp.log.schema import Flight
from quadexp.parts.compose import compose
from quadexp.physics.vehicle import Vehicle

G = 9.81
FINE = 5  # samples of the truth for one of the log
VEHICLES = ("crazyflie", "torrente", "blackbird", "lei_li")
# Speed to which a path is flown (m/s), by vehicle.
SPEED = {"crazyflie": 1.8, "torrente": 8.0, "blackbird": 5.0, "lei_li": 4.0, "hexa": 5.0, "octo": 5.0}


def polygon(rotors: int) -> Vehicle:
    """A vehicle of 6 or 8 rotors on a circle, spinning to and fro."""
    angle = 2 * np.pi * (np.arange(rotors) + 0.5) / rotors
    position = tuple((float(0.3 * np.cos(a)), float(0.3 * np.sin(a)), 0.0) for a in angle)
    spin = tuple(float((-1) ** i) for i in range(rotors))
    inertia = ((0.03, 0.0, 0.0), (0.0, 0.03, 0.0), (0.0, 0.0, 0.05))
    return Vehicle(1.8, inertia, position, spin, 0.02, 0.0, 12.0, 20.0, name={6: "hexa", 8: "octo"}[rotors])


@cache
def vehicle_named(name: str) -> Vehicle:
    if name in ("hexa", "octo"):
        return polygon({"hexa": 6, "octo": 8}[name])
    return build_vehicle(compose([f"vehicle={name}"]).vehicle)


def imitated(
    seed: int, vehicle: str = "torrente", *, duration: float = 20.0, rate: float = 100.0, speed: float | None = None,
    signal: str = "motor_command", gain: tuple[float, float, float] = (1.0, 1.0, 1.0), lag: float = 0.0,
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0), noise: float = 1.0, busy: float = 1.0,
    mounting: Rotation | None = None, turned_gyro: bool = False, voltage: float = 16.0,
) -> Flight:  # fmt: skip
    """A flight of one of VEHICLES, "hexa" or "octo".

    signal: what the log has of the rotors: motor_command (square root of thrust over its largest), rotor_speed or u.
    gain, offset (rad/s^2), lag (s): angular acceleration = gain geometric(t - lag) + offset. noise: of all sensors, 1
    as usual. busy: size of the fast motions. mounting: attitude of the accelerometer in the body, of the gyro too.
    """
    body = vehicle_named(vehicle)
    rng = np.random.default_rng([seed, len(vehicle), *map(ord, vehicle)])
    t = np.arange(-FINE * 50, int(duration * rate) * FINE + FINE * 50) / (rate * FINE)
    p, v, a, yaw = _path(rng, t, SPEED[vehicle] if speed is None else speed, busy)
    drag = rng.uniform(0.15, 0.45, 3) * [1, 1, 0.4]
    R = attitude_of(v, a, yaw, drag, 15)
    force = R.apply(a + [0.0, 0.0, G], inverse=True)
    w = np.zeros_like(v)
    w[1:-1] = (R[:-2].inv() * R[2:]).as_rotvec() * rate * FINE / 2
    alpha = np.gradient(w, t, axis=0)
    thrust = body.mass * (force[:, 2] + drag[2] * R.apply(v, inverse=True)[:, 2])
    J = body.inertia_matrix
    gyroscopic = np.linalg.solve(J, np.cross(w, w @ J).T).T
    asked = ((alpha + gyroscopic - np.array(offset)) / np.array(gain)) @ J
    u = np.column_stack([thrust, asked]) @ np.linalg.pinv(body.allocation).T
    early = np.stack([np.interp(t + lag, t, column) for column in u.T], axis=1)
    k = slice(FINE * 50, -FINE * 50, FINE)
    t, p, q, v, w, force, u = t[k], p[k], R.as_quat(scalar_first=True)[k], v[k], w[k], force[k], early[k]
    sensor = Rotation.identity() if mounting is None else mounting
    reading = sensor.apply(force, inverse=True) + rng.normal(0, 0.06, 3) + 0.3 * noise * rng.normal(size=p.shape)
    gyro = sensor.apply(w, inverse=True) if turned_gyro else w
    gyro = gyro + rng.normal(0, 0.003, 3) + 0.02 * noise * rng.normal(size=p.shape)
    tilt = Rotation.from_rotvec(
        np.radians(0.1) * noise * rng.normal(size=p.shape) + np.radians(0.3) * rng.normal(size=3)
    )
    q = (Rotation.from_quat(q, scalar_first=True) * tilt).as_quat(scalar_first=True)
    q *= np.cumprod(np.concatenate([[1.0], np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)]))[:, None]
    columns = {"t": t - t[0]}
    for name, values in (
        ("p", p + 3e-4 * noise * rng.normal(size=p.shape)), ("v", v + 0.01 * noise * rng.normal(size=p.shape)),
        ("w", gyro), ("acc", reading),
    ):  # fmt: skip
        columns |= {f"{name}_{axis}": values[:, i].copy() for i, axis in enumerate("xyz")}
    columns |= {f"q_{axis}": q[:, i].copy() for i, axis in enumerate("wxyz")}
    columns |= {f"{signal}_{i}": x.copy() for i, x in enumerate(_logged(signal, u, body).T)}
    columns["battery_voltage"] = voltage - 0.01 * columns["t"]
    record = {"name": body.name, "fingerprint": body.fingerprint}
    return Flight(columns, {"name": f"{vehicle}_{seed}", "recorded": True, "outcome": "ok", "vehicle": record})


def _logged(signal: str, u: np.ndarray, body: Vehicle) -> np.ndarray:
    u = np.clip(u, 0.0, body.thrust_max)
    if signal == "u":
        return u
    return np.sqrt(u / body.thrust_max) * (2000.0 if signal == "rotor_speed" else 1.0)


def _path(rng: np.random.Generator, t: np.ndarray, speed: float, busy: float) -> tuple[np.ndarray, ...]:
    """p, v, a, each (k, 3), and yaw (k,)."""
    period = rng.uniform(4, 9)
    omega = 2 * np.pi / period * rng.choice([1.0, 1.5, 2.0, 0.7], 3) * rng.uniform(0.95, 1.05, 3)
    omega = np.minimum(omega, 7.0 / speed)  # an acceleration that the tilt allows
    amplitude = speed / np.sqrt(2) / omega * np.array([1.0, rng.uniform(0.5, 1.0), 0.15])
    sizes, rates, phases = [amplitude], [omega], [rng.uniform(0, 6, 3)]
    for frequency in (0.8, 1.3, 2.1, 3.2):
        sizes.append(busy * rng.uniform(0.3, 1.0, 3) * 0.4 / (2 * np.pi * frequency) ** 2)
        rates.append(2 * np.pi * frequency * rng.uniform(0.9, 1.1, 3))
        phases.append(rng.uniform(0, 6, 3))
    p, v, a = (np.zeros((len(t), 3)) for _ in range(3))
    for size, rate, phase in zip(sizes, rates, phases, strict=True):
        s, c = np.sin(np.outer(t, rate) + phase), np.cos(np.outer(t, rate) + phase)
        p, v, a = p + size * s, v + size * rate * c, a - size * rate**2 * s
    yaw = rng.uniform(0, 6) + rng.choice([0.0, 0.5, 1.0]) * np.sin(rng.uniform(0.3, 0.9) * t + rng.uniform(0, 6))
    yaw = yaw + busy * 0.01 * np.sin(2 * np.pi * rng.uniform(0.8, 1.6) * t)
    return p + [0.0, 0.0, 3.0], v, a, yaw


def attitude_of(v: np.ndarray, a: np.ndarray, yaw: np.ndarray, drag: np.ndarray, iterations: int) -> Rotation:
    """Attitude with R^T (a + g e_z) + D R^T v along z, by fixed-point iteration on the drag."""
    R = Rotation.from_euler("Z", yaw[:, None])
    for _ in range(iterations):
        total = a + [0.0, 0.0, G] + R.apply(drag * R.apply(v, inverse=True))
        z = total / np.linalg.norm(total, axis=1, keepdims=True)
        x = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], 1)
        y = np.cross(z, x)
        y /= np.linalg.norm(y, axis=1, keepdims=True)
        R = Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=2))
    return R


def random_mounting(seed: int, degrees: float) -> Rotation:
    """A turn by so much about an axis drawn at random."""
    axis = np.random.default_rng([seed, 7]).normal(size=3)
    return Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
