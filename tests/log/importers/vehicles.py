"""Vehicles for tests."""

from __future__ import annotations

from quadexp.physics.vehicle import Vehicle


def quad_x() -> Vehicle:
    """1 kg, rotors front right, back right, back left, front left."""
    return Vehicle(
        1.0, ((0.01, 0.0, 0.0), (0.0, 0.01, 0.0), (0.0, 0.0, 0.02)),
        ((0.1, -0.1, 0.0), (-0.1, -0.1, 0.0), (-0.1, 0.1, 0.0), (0.1, 0.1, 0.0)),
        (-1.0, 1.0, -1.0, 1.0), 0.013, 0.0, 10.0, 20.0, name="quad_x",
    )  # fmt: skip
