"""Rotor thrusts by priority are what a linear program says: most tilt, then the nearest thrust, then most yaw."""

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import linprog

from quadexp.control.allocation import clipped
from quadexp.errors import UsageError
from quadexp.plugins.laws.allocation import prioritised
from tests.control.laws.flown import vehicle_of

HEXAGON = np.radians(60.0 * np.arange(6) + 10.0)


def hexacopter():
    return vehicle_of(
        "torrente",
        rotor_position=tuple((0.3 * float(np.cos(a)), 0.25 * float(np.sin(a)), 0.0) for a in HEXAGON),
        rotor_spin=(1.0, -1.0) * 3,
        thrust_max=8.0,
    )


def by_programs(vehicle, wrench):
    """Lexicographic optimum: share of tilt, distance of the thrust, share of yaw; each a linear program of its own."""
    inverse, low, high = np.linalg.pinv(vehicle.allocation), vehicle.thrust_min, vehicle.thrust_max
    lift, tilt, yaw = inverse[:, 0], inverse[:, 1:3] @ wrench[1:3], inverse[:, 3] * wrench[3]
    rows = np.stack([lift, tilt, 0 * lift], axis=1)  # T, s, |T - wanted|
    A, b = np.concatenate([rows, -rows]), np.concatenate([np.full(len(lift), high), np.full(len(lift), -low)])
    share = linprog([0, -1, 0], A, b, bounds=[(None, None), (0, 1), (0, None)]).x[1]
    near = [[1, 0, -1], [-1, 0, -1]]
    found = linprog(
        [0, 0, 1],
        np.concatenate([A, near]),
        np.concatenate([b, [wrench[0], -wrench[0]]]) + 1e-9,
        bounds=[(None, None), (share, share), (0, None)],
    ).x
    u = found[0] * lift + share * tilt
    last = linprog(
        [-1], np.concatenate([yaw, -yaw])[:, None], np.concatenate([high - u, u - low]) + 1e-9, bounds=[(0, 1)]
    )
    return u + last.x[0] * yaw


@pytest.mark.parametrize("vehicle", [vehicle_of("torrente"), vehicle_of("lei_li"), hexacopter()], ids=lambda v: v.name)
def test_against_three_linear_programs(vehicle):
    rng = np.random.default_rng(0)
    w = ca.SX.sym("w", 4)
    function = ca.Function("f", [w], [prioritised(vehicle, w)])
    top, arm = vehicle.n_rotors * vehicle.thrust_max, float(np.abs(vehicle.rotor_position).max())
    scale = np.array([top / 2, top * arm / 4, top * arm / 4, top * vehicle.torque_coefficient])
    saturated = 0
    for _ in range(60):
        wrench = scale * rng.normal(size=4) * rng.choice([0.2, 1.0, 2.0]) + [top / 3, 0, 0, 0]
        u = function(wrench).full().ravel()
        assert u.min() >= vehicle.thrust_min and u.max() <= vehicle.thrust_max
        assert u == pytest.approx(by_programs(vehicle, wrench), abs=1e-5 * vehicle.thrust_max)
        plain = np.linalg.pinv(vehicle.allocation) @ wrench
        if plain.min() >= vehicle.thrust_min and plain.max() <= vehicle.thrust_max:
            assert u == pytest.approx(plain)
        else:
            saturated += 1
    assert 20 < saturated < 60


def given_by(vehicle, wrench, law=prioritised, **settings):
    """The wrench that the rotors then give, (4,)."""
    w = ca.SX.sym("w", 4)
    return vehicle.allocation @ ca.Function("f", [w], [law(vehicle, w, **settings)])(wrench).full().ravel()


def test_a_yaw_torque_that_is_too_large_does_not_tilt_the_vehicle():
    wrench = np.array([70.0, 0.5, -0.3, 2.0])  # 80 N at most
    by_priority, plain = (given_by(vehicle_of("torrente"), wrench, law) for law in (prioritised, clipped))
    assert by_priority[:3] == pytest.approx(wrench[:3]) and 0 < by_priority[3] < 2.0
    assert np.abs(plain[1:3] - wrench[1:3]).max() > 0.1


def test_without_airmode_tilt_never_raises_the_thrust():
    with_it, without = (given_by(vehicle_of("torrente"), [2.0, 1.5, 0, 0], airmode=on) for on in (True, False))
    assert with_it[1] == pytest.approx(1.5) and with_it[0] > 4
    assert without[0] == pytest.approx(2.0) and 0 < without[1] < 0.5


def test_yaw_may_take_away_a_share_of_the_thrust():
    kept, given = (given_by(vehicle_of("torrente"), [80.0, 0, 0, 0.1], yaw_margin=m) for m in (0.0, 0.15))
    assert kept == pytest.approx([80, 0, 0, 0]) and given[3] == pytest.approx(0.1) and 60 < given[0] < 80


def test_a_layout_in_which_a_rotor_must_pull_is_refused():
    vehicle = vehicle_of(
        "torrente", rotor_position=((0.1, 0.1, 0.0), (0.2, -0.1, 0.0), (0.3, 0.2, 0.0), (0.15, -0.2, 0.0))
    )  # all before the centre of mass
    with pytest.raises(UsageError, match="rotors that all lift at once"):
        prioritised(vehicle, ca.SX.sym("w", 4))
