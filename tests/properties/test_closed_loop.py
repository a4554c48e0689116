"""Whole flights: turned or mirrored with everything in them, they are the same flights.

Under a turn of the world the feedback controller is exact where it takes nothing from the past (its compensation starts
from R_d = I, which has a heading), the predictive controller where its cost is: with the attitude error in the body
frame, or with one weight on all four components of the plain difference of quaternions. The paper's weights
(0, 0.1, 0.1, 0.1) on the plain difference know a heading, because a turn mixes its components.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.models.residual import no_residual
from quadexp.parts.compose import compose
from quadexp.physics.state import STATE_COLUMNS
from quadexp.plugins.papers.lei_li.plant import BladeElementPlant
from quadexp.world import PlantEffects, SimplifiedPlant
from tests.properties.paths import Transformed, Wander, near
from tests.properties.strategies import few, generators, make_effects
from tests.properties.test_symmetry import MIRROR, mirrored, mirrored_vehicle, turned_world, z_turn

QUARTER = np.pi / 2
turns = st.floats(-np.pi, np.pi)


EVEN = MPCSettings(attitude_weight=(0.1, 0.1, 0.1, 0.1))
BODY = MPCSettings(attitude_weight=(0.0, 0.3, 0.1, 0.05), attitude_error="body")
SAME = 1e-6  # m, m/s, rad/s: rounding of 1e-16, amplified by 75 steps of feedback through an active set


def flown(vehicle, plant_effects, path, start, seed, settings, drag=None) -> np.ndarray:
    """States of a flight, (k, 13), with the plant's noise of the seed."""
    residual = no_residual(vehicle) if drag is None else linear_drag_residual(vehicle, drag)
    plant = SimplifiedPlant(vehicle, plant_effects, step=5e-3, backend="interpreted")
    controller = ModelPredictiveController(vehicle, residual, settings, backend="interpreted")
    reference = SampledReference(path, controller)
    flight = fly(plant, controller, reference, np.random.default_rng(seed), start=start)
    assert flight.metadata["outcome"] == "ok", flight.metadata["cause"]
    return flight.stack(list(STATE_COLUMNS))


def start_of(path, rng) -> np.ndarray:
    flat = path.flat_output(np.zeros(1))
    half = flat.yaw[0, 0] / 2
    x = np.r_[flat.position[0, 0], np.cos(half), 0, 0, np.sin(half), flat.position[0, 1], np.zeros(3)]
    return near(x, rng, 0.1)


def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Largest differences, (13,); q and -q are one attitude."""
    sign = np.sign((a[:, 3:7] * b[:, 3:7]).sum(axis=1))[:, None]
    return np.abs(np.hstack([a[:, :3], sign * a[:, 3:7], a[:, 7:]]) - b).max(axis=0)


@pytest.mark.parametrize("settings", [EVEN, BODY], ids=["plain, even weights", "body"])
@few
@given(st.sampled_from([QUARTER, -QUARTER, 2 * QUARTER, 0.7]), generators)
def test_turning_the_whole_experiment(vehicle, settings, angle, rng):
    """Start, reference and heading turned, the same noise in the body: every state turns, to rounding."""
    path, effects, drag, seed = Wander(rng, size=2.0), PlantEffects(), (0.4, 0.4, 0.1), int(rng.integers(2**32))
    start = start_of(path, rng)
    turned_path = Transformed(path, z_turn(angle).as_matrix(), angle=angle)
    one = flown(vehicle, effects, path, start, seed, settings, drag)
    other = flown(vehicle, effects, turned_path, turned_world(start, angle), seed, settings, drag)
    assert difference(np.array([turned_world(x, angle) for x in one]), other).max() < SAME


@few
@given(turns, generators)
def test_turning_feedback_control_in_blade_element_air(lei_li, blade, angle, rng):
    """Lei and Li's controller on their plant: every heading is as good as another, to rounding."""
    path, flights = Wander(rng), []
    start = start_of(path, rng)
    for turned, x in (
        (path, start),
        (Transformed(path, z_turn(angle).as_matrix(), angle=angle), turned_world(start, angle)),
    ):
        law = replace(compose(["controller=static_feedback"]).controller, backend="interpreted")
        controller = law.controller(lei_li)
        plant = BladeElementPlant(lei_li, blade, step=2e-3, method="rk4", backend="interpreted")
        reference = SampledReference(turned, controller)
        flight = fly(plant, controller, reference, np.random.default_rng(0), start=x)
        assert flight.metadata["outcome"] == "ok", flight.metadata["cause"]
        flights.append(flight.stack(list(STATE_COLUMNS)))
    one, other = flights
    assert difference(np.array([turned_world(x, angle) for x in one]), other).max() < SAME


@few
@given(generators)
def test_mirroring_the_whole_experiment(vehicle, rng):
    """Vehicle, start, reference and drag mirrored, any weights: states are mirrored, to rounding."""
    path, effects = Wander(rng, size=2.0), make_effects(rng)
    start, drag = start_of(path, rng), rng.uniform(0, 0.5, 3)
    settings = MPCSettings(attitude_weight=tuple(rng.uniform(0, 0.2, 4)))
    one = flown(vehicle, effects, path, start, 0, settings, drag)
    image = Transformed(path, MIRROR, sign=-1.0)
    other = flown(mirrored_vehicle(vehicle), effects, image, mirrored(start), 0, settings, drag)
    assert difference(np.array([mirrored(x) for x in one]), other).max() < SAME


@pytest.mark.parametrize("angle", [QUARTER, 2 * QUARTER])
def test_the_papers_weights_are_only_nearly_the_same_under_a_turn(vehicle, angle):
    """Started on the reference, the path moves by less than a centimetre; not by nothing."""
    path = Wander(np.random.default_rng(4), size=2.0)
    controller = ModelPredictiveController(vehicle, no_residual(vehicle), backend="interpreted")
    start = SampledReference(path, controller).at(0)[0].copy()
    turned_path = Transformed(path, z_turn(angle).as_matrix(), angle=angle)
    effects = PlantEffects()
    one = flown(vehicle, effects, path, start, 1, MPCSettings())
    other = flown(vehicle, effects, turned_path, turned_world(start, angle), 1, MPCSettings())
    moved = difference(np.array([turned_world(x, angle) for x in one]), other)[:3].max()
    assert 1e-6 < moved < 0.01
