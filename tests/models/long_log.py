"""An imitated log of any length and rate: a path of sines, the attitude that its thrust needs, known coefficients."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.log.schema import Flight

DRAG = np.array([0.30, 0.25, 0.10])  # 1/s
THRUST = (3.0, 14.0)  # of s and s^2, s the motor command at 16 V, m/s^2 per rotor


def long_log(seconds: float, rate: float, seed: int = 0) -> Flight:
    """A recorded flight with motor commands and a battery that empties every ten minutes."""
    rng, t = np.random.default_rng(seed), np.arange(int(seconds * rate)) / rate
    position, velocity, acceleration = np.zeros((3, len(t), 3))
    for axis, size in enumerate((1.5, 1.5, 0.5)):
        for _ in range(12):
            omega, phase = rng.uniform(0.1, 2.5), rng.uniform(0, 2 * np.pi)
            amplitude = size * rng.uniform(0.3, 1.0) / omega
            position[:, axis] += amplitude * np.sin(omega * t + phase)
            velocity[:, axis] += amplitude * omega * np.cos(omega * t + phase)
            acceleration[:, axis] -= amplitude * omega**2 * np.sin(omega * t + phase)
    force = acceleration + [0, 0, 9.81]
    along, turn = force, np.empty((len(t), 3, 3))
    for _ in range(6):  # until the thrust makes up for the drag along x and y
        z = along / np.linalg.norm(along, axis=1, keepdims=True)
        y = np.cross(z, [1.0, 0.0, 0.0])
        y /= np.linalg.norm(y, axis=1, keepdims=True)
        turn = np.stack([np.cross(y, z), y, z], axis=2)
        own = np.einsum("kji,kj->ki", turn, velocity)
        along = force + np.einsum("kij,kj->ki", turn, own * DRAG * [1, 1, 0])
    specific = np.einsum("kji,kj->ki", turn, force)
    per_rotor = (specific[:, 2] + DRAG[2] * own[:, 2]) / 4
    voltage = 16.5 - 1.8 * (t % 600) / 600
    linear, square = THRUST
    command = (-linear + np.sqrt(linear**2 + 4 * square * per_rotor)) / (2 * square) * 16 / voltage
    attitude = Rotation.from_matrix(turn)
    rates = np.vstack([(attitude[:-1].inv() * attitude[1:]).as_rotvec() * rate, np.zeros(3)])
    columns = {"t": t}
    columns |= {f"p_{name}": position[:, i] for i, name in enumerate("xyz")}
    columns |= {f"q_{name}": attitude.as_quat(scalar_first=True)[:, i] for i, name in enumerate("wxyz")}
    columns |= {f"v_{name}": velocity[:, i] for i, name in enumerate("xyz")}
    columns |= {f"w_{name}": rates[:, i] for i, name in enumerate("xyz")}
    specific += 0.05 * rng.standard_normal(specific.shape)
    columns |= {f"acc_{name}": specific[:, i] for i, name in enumerate("xyz")}
    columns |= {f"motor_command_{i}": command + 0.003 * rng.standard_normal(len(t)) for i in range(4)}
    columns["battery_voltage"] = voltage
    columns = {name: np.ascontiguousarray(values) for name, values in columns.items()}
    return Flight(columns, {"recorded": True, "vehicle": {"name": "imitated"}, "name": "long"})
