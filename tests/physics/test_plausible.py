"""Vehicles of one set of units are taken, from 20 g to 40 kg; a number in another unit is named with it."""

from dataclasses import replace

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import heavy_drag
from quadexp.parts.compose import compose
from quadexp.parts.options import OptionFiles

SHIPPED = OptionFiles().options("vehicle")


def vehicle(name):
    return compose([f"vehicle={name}"]).vehicle


def ring(n, arm):
    angles = 2 * np.pi * (np.arange(n) + 0.5) / n
    return tuple((float(arm * np.cos(a)), float(arm * np.sin(a)), 0.0) for a in angles)


@pytest.mark.parametrize(
    ("n", "mass", "arm", "moments", "thrust_max", "rest"),
    [
        (4, 0.020, 0.033, (8e-6, 8e-6, 1.4e-5), 0.12, {"torque_coefficient": 0.004}),  # a tiny whoop
        (4, 0.65, 0.11, (2.5e-3, 2.1e-3, 4.3e-3), 16.0, {"thrust_coefficient": 1.5e-6}),  # a racer
        (6, 2.0, 0.3, (0.05, 0.05, 0.09), 12.0, {}),
        (8, 30.0, 0.75, (2.0, 2.0, 3.6), 90.0, {"torque_coefficient": 0.03, "thrust_coefficient": 3e-4}),
        (8, 41.0, 1.05, (5.0, 5.0, 9.0), 130.0, {"torque_coefficient": 0.04}),  # a sprayer
        (4, 1.5, 0.5, (0.03, 0.03, 0.06), 9.0, {}),  # long arms, for endurance
    ],
)
def test_real_vehicles_are_taken(n, mass, arm, moments, thrust_max, rest):
    spin = tuple(float(1 - 2 * (i % 2)) for i in range(n))
    inertia = tuple(map(tuple, np.diag(moments).tolist()))
    own = {"mass": mass, "rotor_position": ring(n, arm), "rotor_spin": spin, "inertia": inertia}
    assert build_vehicle(replace(vehicle("torrente"), **own, thrust_max=thrust_max, **rest)).n_rotors == n


def scaled(value, factor):
    return tuple(scaled(one, factor) for one in value) if isinstance(value, tuple) else value / factor


@pytest.mark.parametrize(
    ("key", "unit", "factor"),
    [
        ("mass", "g", 1e-3),
        ("rotor_position", "mm", 1e-3), ("rotor_position", "cm", 1e-2), ("rotor_position", "in", 0.0254),
        ("inertia", "g m^2", 1e-3), ("inertia", "kg cm^2", 1e-4), ("inertia", "kg mm^2", 1e-6),
        ("inertia", "g cm^2", 1e-7),
        ("thrust_max", "gram-force", 9.80665e-3), ("thrust_max", "mN", 1e-3), ("torque_coefficient", "mm", 1e-3),
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", SHIPPED)
def test_another_unit_is_named(name, key, unit, factor):
    """Of every shipped vehicle, which by itself is taken; far beyond all vehicles the range of the key is."""
    plain = vehicle(name)
    assert build_vehicle(plain).name == name
    with pytest.raises(UsageError) as told:
        build_vehicle(replace(plain, **{key: scaled(getattr(plain, key), factor)}))
    text = str(told.value)
    units = text.partition("meant in ")[2].rstrip("?").split(" or ")
    assert text.startswith(f"vehicle.{key}") and (
        unit in units or "must be in [0, 1] m" in text or "must be in (0, 100" in text
    )


@pytest.mark.parametrize("spin", [(0.5, 1.0, -1.0, 1.0), (0.0, 1.0, -1.0, 1.0), (-1.0, 0.99, -1.0, 1.0)])
def test_a_spin_is_a_sign(spin):
    with pytest.raises(UsageError, match=r"vehicle.rotor_spin=\[.*\]: each must be 1 or -1"):
        build_vehicle(replace(vehicle("torrente"), rotor_spin=spin))


@pytest.mark.parametrize(
    ("given", "heavy"),
    [
        ([], False), (["vehicle=sun", "plant=sun"], False), (["vehicle=cf2x_L250", "plant=drone_models"], False),
        (["vehicle=hummingbird"], False), (["vehicle=crazyflie"], True), (["plant.linear_drag=[30,30,0]"], True),
        (["plant.quadratic_drag=[80,80,80]"], True), (["vehicle=lei_li", "plant=blade_element"], False),
    ],
)  # fmt: skip
def test_the_drag_of_another_vehicle_is_named(given, heavy):
    assert ("another vehicle, or in mN s/m?" in heavy_drag(compose(given))) is heavy
