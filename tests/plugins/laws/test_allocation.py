"""The constrained allocation against a general solver, on vehicles of four and six rotors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from quadexp.errors import UsageError
from quadexp.plugins.laws.allocation import allocation, exact_allocation

WEIGHT = (0.001, 10.0, 10.0, 0.1)


def cost(vehicle, wrench, u):
    return float(np.array(WEIGHT) @ (wrench - vehicle.allocation @ u) ** 2)


@pytest.mark.parametrize("kind", ["vehicle", "odd_vehicle"])
def test_no_thrusts_within_the_limits_are_better(kind, request):
    """Bounded least squares by SciPy reaches no lower cost, and ours keeps the limits."""
    vehicle, rng = request.getfixturevalue(kind), np.random.default_rng(1)
    solve, root = exact_allocation(vehicle, WEIGHT), np.sqrt(WEIGHT)
    reach = vehicle.n_rotors * vehicle.thrust_max
    for _ in range(40):
        wrench = np.r_[rng.uniform(-0.3, 1.3) * reach, rng.normal(0, 0.2 * reach, 3) * (0.3, 0.3, 0.05)]
        u = np.array(solve(wrench)).ravel()
        assert (u >= vehicle.thrust_min).all() and (u <= vehicle.thrust_max).all()
        limits = vehicle.thrust_min, vehicle.thrust_max
        other = lsq_linear(root[:, None] * vehicle.allocation, root * wrench, limits, method="bvls", tol=1e-14).x
        assert cost(vehicle, wrench, u) <= cost(vehicle, wrench, other) * (1 + 1e-5) + 1e-6


def test_what_the_rotors_can_give_is_given_exactly(vehicle):
    u = np.array([3.0, 4.0, 2.5, 3.5])
    found = exact_allocation(vehicle, WEIGHT)(vehicle.allocation @ u)
    assert np.array(found).ravel() == pytest.approx(u, abs=1e-9)


def test_tilt_comes_before_thrust_and_yaw(vehicle):
    """Full thrust with a roll torque: the torque is kept, thrust is given up; a clip of each rotor keeps less of it."""
    wrench = np.array([4 * vehicle.thrust_max, 1.0, 0.0, 0.1])
    exact, clip = (
        vehicle.allocation @ np.array(allocation(vehicle, kind, WEIGHT)(wrench)).ravel() for kind in ("exact", "clip")
    )
    assert exact[1] == pytest.approx(1.0, rel=1e-2) and exact[0] < wrench[0]
    assert clip[1] < 0.6


def test_too_many_rotors_are_refused_by_name(vehicle):
    angle = np.arange(8) * np.pi / 4
    place = tuple((float(np.cos(a)), float(np.sin(a)), 0.0) for a in angle)
    octo = replace(vehicle, name="octo", rotor_position=place, rotor_spin=(1, -1) * 4)
    with pytest.raises(UsageError, match=r"vehicle=octo: has 8 rotors.*allocation=clip"):
        exact_allocation(octo, WEIGHT)
