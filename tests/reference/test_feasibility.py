"""Feasibility: the worst violation, found where the physics puts it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quadexp.physics.state import RATE
from quadexp.reference.circle import Circle
from quadexp.reference.feasibility import check_feasible
from quadexp.reference.flatness import flat_reference
from quadexp.reference.hover import Hover
from quadexp.reference.lemniscate import Lemniscate

T = np.arange(0, 20.02, 0.02)


def test_a_flyable_reference_has_nothing_to_report(vehicle):
    assert check_feasible(flat_reference(Hover(), T, vehicle), vehicle) is None
    assert check_feasible(flat_reference(Circle(speed=8.0), T, vehicle), vehicle) is None


def test_worst_thrust_of_a_circle(vehicle):
    """Hardly any inertia: each rotor gives m sqrt(g^2 + (V^2/r)^2) / 4, most at the peak V = v + .273 a at t = 10 s."""
    tiny = tuple(tuple(1e-7 * v for v in row) for row in vehicle.inertia)
    light = replace(vehicle, inertia=tiny, thrust_max=4.0)
    circle = Circle(speed=8.0, radius=5.0)
    found = check_feasible(flat_reference(circle, T, light), light)
    worst = np.hypot(9.81, (8.0 + (4 / np.pi - 1)) ** 2 / 5.0) / 4
    assert found.value == pytest.approx(worst, rel=1e-4)
    assert found.margin == pytest.approx(worst - 4.0, rel=1e-3)
    assert found.t == pytest.approx(10.0, abs=0.05)
    assert (found.limit, found.unit) == (4.0, "N")
    assert found.what.startswith("rotor")
    for part in (
        "the reference cannot be flown: rotor",
        "N above the limit of 4 N",
        "at t = ",
        "lower trajectory.speed",
    ):
        assert part in str(found)
    assert "\n" not in str(found)


def test_thrust_below_the_least(vehicle):
    """The crossing of the lemniscate at 11.7 m/s flips the vehicle over faster than its rotors can without pulling."""
    reference = flat_reference(Lemniscate(speed=8.0), T, vehicle)
    found = check_feasible(reference, vehicle)
    assert found.value == reference.input.min() == -found.margin
    assert found.t == T[np.argmin(reference.input.min(axis=1))]
    assert "N below the limit of 0 N" in str(found)


def test_body_rate(vehicle):
    slow = replace(vehicle, rate_max=1.0)
    reference = flat_reference(Circle(speed=8.0), T, slow)
    found = check_feasible(reference, slow)
    rate = np.linalg.norm(reference.state[:, RATE], axis=1)
    assert (found.what, found.unit, found.value) == ("body rate", "rad/s", pytest.approx(rate.max()))
    assert found.t == T[np.argmax(rate)]
    assert found.share == pytest.approx((rate > 1.0).mean())
