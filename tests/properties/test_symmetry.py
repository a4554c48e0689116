"""What turning or mirroring the whole experiment must do: nothing else than turn or mirror the outcome.

Mirror: y -> -y. Vectors S = diag(1, -1, 1), axial vectors -S; the mirrored vehicle has S r_i, S J S and opposite spins.
Turning the body's own axes about z leaves the motion as it is, whatever the rotors are called.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs
from scipy.spatial.transform import Rotation

from quadexp.models.linear_drag import linear_drag_residual
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.plugins.gaussian_process.posterior import gaussian_process_residual
from quadexp.plugins.papers.lei_li.plant import BladeElementPlant
from quadexp.world import SimplifiedPlant
from tests.properties.strategies import (
    few,
    generators,
    make_blade,
    make_blade_effects,
    make_effects,
    make_gp_outputs,
    make_residual,
    make_thrusts,
    make_upright_state,
    vehicles,
)

MIRROR = np.diag([1.0, -1.0, 1.0])
AXIAL = -MIRROR
turns = st.floats(-np.pi, np.pi)


def z_turn(angle: float) -> Rotation:
    return Rotation.from_euler("z", angle)


def with_frame(vehicle, matrix: np.ndarray, spin: float):
    """The vehicle in body axes matrix @ (old axes)."""
    place = np.array(vehicle.rotor_position) @ matrix.T
    inertia = matrix @ vehicle.inertia_matrix @ matrix.T
    return replace(
        vehicle,
        rotor_position=tuple(map(tuple, place)),
        inertia=tuple(map(tuple, (inertia + inertia.T) / 2)),
        rotor_spin=tuple(spin * s for s in vehicle.rotor_spin),
    )


def mirrored_vehicle(vehicle):
    return with_frame(vehicle, MIRROR, -1.0)


def mirrored(x: np.ndarray) -> np.ndarray:
    w, a, b, c = x[ATTITUDE]
    return np.r_[MIRROR @ x[POSITION], w, -a, b, -c, MIRROR @ x[VELOCITY], AXIAL @ x[RATE]]


def turned_world(x: np.ndarray, angle: float) -> np.ndarray:
    """The state after turning everything about the vertical."""
    turn = z_turn(angle)
    q = (turn * Rotation.from_quat(x[ATTITUDE], scalar_first=True)).as_quat(scalar_first=True)
    return np.r_[turn.apply(x[POSITION]), q, turn.apply(x[VELOCITY]), x[RATE]]


def renamed_body(x: np.ndarray, angle: float) -> np.ndarray:
    """The same motion, its body axes turned about z_body by the angle."""
    q = (Rotation.from_quat(x[ATTITUDE], scalar_first=True) * z_turn(angle)).as_quat(scalar_first=True)
    return np.r_[x[POSITION], q, x[VELOCITY], z_turn(-angle).apply(x[RATE])]


def assert_same(a: np.ndarray, b: np.ndarray, tolerance: float = 1e-8) -> None:
    """Equal states; q and -q are one attitude. Induced velocities that end 1e-10 m/s apart turn a light body otherwise
    by some 1e-9 rad/s."""
    b = b.copy()
    b[ATTITUDE] *= np.sign(a[ATTITUDE] @ b[ATTITUDE])
    np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


def plant_makers(rng: np.random.Generator, *, isotropic: bool):
    """Two functions from a vehicle to a plant, without noise."""
    effects, blade, options = make_effects(rng, isotropic=isotropic), make_blade(rng), make_blade_effects(rng)
    if isotropic:
        drag = blade.body_drag
        blade = replace(blade, body_drag=(drag[0], drag[0], drag[2]))
    return (
        lambda v: SimplifiedPlant(v, effects, step=2e-3, backend="interpreted"),
        lambda v: BladeElementPlant(v, blade, options, step=2e-3, method="rk4", backend="interpreted"),
    )


@pytest.mark.parametrize("kind", [0, 1], ids=["simplified", "blade_element"])
@few
@given(vehicles(), turns, generators)
def test_plants_turn_with_the_world_and_with_the_body(kind, vehicle, angle, rng):
    make = plant_makers(rng, isotropic=True)[kind]
    x, u = make_upright_state(rng), make_thrusts(rng, vehicle)
    after, reading = make(vehicle).advance(x, u, 0.02, rng)
    there, reading_there = make(vehicle).advance(turned_world(x, angle), u, 0.02, rng)
    assert_same(turned_world(after, angle), there)
    assert np.allclose(reading_there, reading, rtol=1e-9, atol=1e-9)

    body = z_turn(-angle).as_matrix()
    renamed, reading_renamed = make(with_frame(vehicle, body, 1.0)).advance(renamed_body(x, angle), u, 0.02, rng)
    assert_same(renamed_body(after, angle), renamed)
    assert np.allclose(reading_renamed, body @ reading, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", [0, 1], ids=["simplified", "blade_element"])
@few
@given(vehicles(), generators)
def test_plants_in_a_mirror(kind, vehicle, rng):
    make = plant_makers(rng, isotropic=False)[kind]
    x, u = make_upright_state(rng), make_thrusts(rng, vehicle)
    after, reading = make(vehicle).advance(x, u, 0.02, rng)
    other, reading_other = make(mirrored_vehicle(vehicle)).advance(mirrored(x), u, 0.02, rng)
    assert_same(mirrored(after), other)
    assert np.allclose(reading_other, MIRROR @ reading, rtol=1e-9, atol=1e-9)


@given(vehicles(), generators)
def test_a_quarter_turn_swaps_the_axes_of_drag(vehicle, rng):
    """Drag per axis is not isotropic: with k_x and k_y swapped a quarter turn of the body axes changes nothing."""
    effects = make_effects(rng)
    swapped = replace(effects, linear_drag=tuple(np.array(effects.linear_drag)[[1, 0, 2]]),
                      quadratic_drag=tuple(np.array(effects.quadratic_drag)[[1, 0, 2]]))  # fmt: skip
    body = z_turn(-np.pi / 2).as_matrix().round()
    x, u = make_upright_state(rng), make_thrusts(rng, vehicle)
    after, _ = SimplifiedPlant(vehicle, effects, backend="interpreted").advance(x, u, 0.01, rng)
    other = SimplifiedPlant(with_frame(vehicle, body, 1.0), swapped, backend="interpreted")
    assert_same(renamed_body(after, np.pi / 2), other.advance(renamed_body(x, np.pi / 2), u, 0.01, rng)[0])


def mirrored_residual(name: str, vehicle, rng: np.random.Generator):
    """A residual of the kind and its mirror image, for the vehicle and the mirrored one."""
    other = mirrored_vehicle(vehicle)
    if name == "linear_drag":
        drag, intercept, gain = rng.uniform(0, 0.5, 3), 0.1 * rng.normal(size=3), 0.02
        return (
            linear_drag_residual(vehicle, drag, intercept, gain),
            linear_drag_residual(other, drag, MIRROR @ intercept, gain),
        )
    if name == "gaussian_process":
        outputs, odd, turned = make_gp_outputs(rng), ("v_y", "w_x", "w_z"), ("a_y", "tau_x", "tau_z")
        signs = [np.array([-1.0 if name in odd else 1.0 for name in o.features]) for o in outputs]
        images = [
            structs.replace(o, inducing=o.inducing * s, alpha=-o.alpha if o.output in turned else o.alpha)
            for o, s in zip(outputs, signs, strict=True)
        ]
        return gaussian_process_residual(vehicle, outputs), gaussian_process_residual(other, images)
    seed = rng.integers(2**32)
    return (make_residual(name, v, np.random.default_rng(seed)) for v in (vehicle, other))


@pytest.mark.parametrize("name", ["none", "linear_drag", "gaussian_process", "blade_element"])
@given(vehicles(), turns, generators)
def test_models_turn_with_the_world_and_in_a_mirror(name, vehicle, angle, rng):
    residual, image = mirrored_residual(name, vehicle, rng)
    f, f_image = corrected_function(vehicle, residual), corrected_function(mirrored_vehicle(vehicle), image)
    x, u = make_upright_state(rng), make_thrusts(rng, vehicle)
    slope = np.array(f(x, u, residual.theta)).reshape(-1)
    assert np.allclose(f(turned_world(x, angle), u, residual.theta).full().ravel()[RATE], slope[RATE], rtol=1e-9)
    there = np.array(f(turned_world(x, angle), u, residual.theta)).reshape(-1)
    assert np.allclose(there[VELOCITY], z_turn(angle).apply(slope[VELOCITY]), atol=1e-10)
    other = np.array(f_image(mirrored(x), u, image.theta)).reshape(-1)
    assert np.allclose(other, mirrored(slope), rtol=1e-9, atol=1e-9)
