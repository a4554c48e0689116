"""Recorded flights whose model is known: thrust curve, linear drag, offsets, noise and a thrust scale of their own."""

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight
from quadexp.physics.vehicle import Vehicle

DRAG = np.array([0.42, 0.38, 0.10])  # 1/s, body axes
OFFSET = np.array([0.05, -0.03, 0.0])  # m/s^2, of the accelerometer
CURVE = 4.0  # m/s^2 per unit of command and rotor
GRAVITY = 9.81
DT = 0.01


def crazyflie() -> Vehicle:
    """The vehicle that the flights name."""
    from quadexp.experiment.build import build_vehicle
    from quadexp.parts.compose import compose

    return build_vehicle(compose(["vehicle=crazyflie"]).vehicle)


def recorded_flight(
    seed: int, vehicle: Vehicle, *, duration: float = 12.0, scale: float = 1.0, noise: float = 0.02, wind=None
) -> Flight:
    """A path of some 2 m/s, flown exactly: attitude and command follow from the motion under drag and thrust.

    scale: true thrust over thrust curve, of this flight. wind: (3,) m/s world, constant.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(round(duration / DT)) * DT
    amplitude, omega, phase = np.array([1.2, 1.0, 0.3]), np.array([1.4, 1.1, 1.7]), rng.uniform(0, 6, 3)
    s, c = np.sin(np.outer(t, omega) + phase), np.cos(np.outer(t, omega) + phase)
    p, v, a = amplitude * s + [0, 0, 2], amplitude * omega * c, -amplitude * omega**2 * s
    air = np.zeros(3) if wind is None else np.asarray(wind, float)
    world = a + [0, 0, GRAVITY]
    R = None
    for _ in range(40):  # the thrust points along what the drag leaves: a fixed point in the attitude
        drag = (
            np.zeros_like(v) if R is None else np.einsum("kij,kj->ki", R, -DRAG * np.einsum("kji,kj->ki", R, v - air))
        )
        z = world - drag
        z = z / np.linalg.norm(z, axis=1, keepdims=True)
        y = np.cross(z, [1.0, 0, 0])
        y = y / np.linalg.norm(y, axis=1, keepdims=True)
        R = np.stack([np.cross(y, z), y, z], axis=2)
    force = np.einsum("kji,kj->ki", R, world)
    body = np.einsum("kji,kj->ki", R, v - air)
    collective = force[:, 2] + DRAG[2] * body[:, 2]
    rotation = Rotation.from_matrix(R)
    w = (rotation[:-1].inv() * rotation[1:]).as_rotvec() / DT
    command = np.repeat(collective[:, None] / (4 * CURVE * scale), 4, axis=1)
    reading = force + OFFSET + noise * rng.standard_normal(force.shape)
    columns = {"t": t}
    for name, values in (("p", p), ("v", v), ("acc", reading), ("w", np.vstack([w, w[-1:]]))):
        columns |= {f"{name}_{axis}": values[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"q_{axis}": rotation.as_quat(scalar_first=True)[:, i] for i, axis in enumerate("wxyz")}
    columns |= {f"motor_command_{i}": command[:, i] for i in range(4)}
    if wind is not None:
        columns |= {f"wind_{axis}": np.full(len(t), air[i]) for i, axis in enumerate("xyz")}
    record = {"name": vehicle.name, "fingerprint": vehicle.fingerprint}
    return Flight(columns, {"name": f"flight_{seed}", "recorded": True, "outcome": "ok", "vehicle": record})
