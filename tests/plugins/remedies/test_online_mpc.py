"""The MPC whose model adapts in flight, and sums of models."""

from dataclasses import replace

import numpy as np
import pytest

from quadexp.control.base import Measurement
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.errors import UsageError
from quadexp.experiment.evaluate import fly_one
from quadexp.experiment.identity import find_model
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.models.linear_drag import adapting_drag, linear_drag_residual
from quadexp.models.residual import sum_residual
from quadexp.models.terms import adapting_terms
from quadexp.parts.compose import compose
from quadexp.physics.state import POSITION, STATE_COLUMNS
from quadexp.plugins.remedies.online_mpc import AdaptingController, AdaptKeys
from quadexp.reference.circle import Circle
from quadexp.reference.hover import Hover
from quadexp.world import PlantEffects, SimplifiedPlant
from tests.models.residuals import make_residual

QUIET = {"motor_noise_density": 0.0, "force_noise_density": 0.0, "torque_noise_density": 0.0}
CIRCLE = Circle(radius=5.0, speed=6.0, acceleration=2.0)


def flown(vehicle, controller, effects=None, trajectory=CIRCLE):
    plant = SimplifiedPlant(vehicle, effects or PlantEffects(**QUIET))
    reference = SampledReference(trajectory, controller)
    return fly(plant, controller, reference, np.random.default_rng(0))


def errors(flight):
    """Distance from the reference, (k,) (m)."""
    p = [STATE_COLUMNS[i] for i in range(*POSITION.indices(13))]
    return np.sqrt(sum((flight.columns[name] - flight.columns[f"ref_{name}"]) ** 2 for name in p))


def terms(vehicle, known=(), backend="auto", **adapt):
    return AdaptingController(
        vehicle,
        list(known),
        adapting_terms(vehicle, 1.0),
        MPCSettings(),
        AdaptKeys(**adapt),
        reference_period=1.0,
        backend=backend,
    )


def rigid(vehicle, residual, backend="interpreted"):
    return PredictiveController(ModelPredictiveController(vehicle, residual, backend=backend))


@pytest.mark.parametrize("law", ["bayes", "rls", "composite"])
def test_from_nothing_it_learns_the_air_of_the_circle(vehicle, law):
    """With no data at all: a fifth of the error of the rigid body once it has flown a while."""
    nominal = errors(flown(vehicle, rigid(vehicle, make_residual("none", vehicle), "auto")))
    learned = errors(flown(vehicle, terms(vehicle, law=law)))
    half = len(nominal) // 2
    assert learned[half:].mean() < 0.2 * nominal[half:].mean()


@pytest.mark.parametrize("payload", [0.15, 0.4])
def test_an_unknown_mass_leaves_little_offset_at_hover(vehicle, payload):
    """The pull to the prior leaves (1 - rho) r of a constant; without forgetting nothing is left."""
    loaded, hover = replace(vehicle, mass=vehicle.mass + payload), Hover(duration=6.0)
    short, long = (errors(flown(loaded, terms(vehicle, memory=m), trajectory=hover)) for m in (2.0, 1e6))
    assert short.max() > 4 * short[-1]
    assert short[-1] < 5e-4 and long[-1] < 5e-5


def test_a_flight_leaves_nothing_behind_and_compiles_nothing(vehicle):
    """The second flight of a controller is the first one, bit by bit, on the same functions."""
    controller = terms(vehicle)
    before = controller.mpc.step
    first, second = (flown(vehicle, controller) for _ in range(2))
    for name, values in first.columns.items():
        if name != "solve_time":
            assert np.array_equal(values, second.columns[name]), name
    assert controller.mpc.step is before
    assert {"innovation_x", "innovation_y", "innovation_z"} <= set(first.columns)
    assert controller.samples == len(first.columns["t"]) - 1
    sparing = terms(vehicle, every=2)
    assert sparing.samples == 0 and len(flown(vehicle, sparing).columns["t"]) // 2 == sparing.samples


def test_without_a_reading_the_weights_stay(vehicle):
    controller = terms(vehicle)
    reference = SampledReference(Hover(duration=2.0), controller)
    window, x = reference.window(0), reference.at(0)[0]
    controller.reset(x, window)
    controller.step(Measurement(0.0, x, None, None), window)
    assert controller.samples == 0
    controller.step(Measurement(0.0, x, np.array([0.5, 0, 9.81]), None), window)
    assert controller.samples == 1 and controller.theta[2] > 0  # the offset along x


def test_the_reference_gets_the_adapted_model(vehicle):
    controller = terms(vehicle)
    assert controller.residual is controller.residual
    before = controller.residual.theta.copy()
    flown(vehicle, controller)
    assert not np.array_equal(controller.residual.theta, before)
    assert np.array_equal(controller.residual.theta, controller.mpc.parameters.ravel())
    controller.forget()
    assert np.array_equal(controller.residual.theta, before)


def test_a_sum_is_its_whole(vehicle, rng):
    """Linear drag in two halves commands what the whole does."""
    whole, half = ((0.5, 0.6, 0.1), (0.02, -0.01, 0.1), -0.015), ((0.25, 0.3, 0.05), (0.01, -0.005, 0.05), -0.0075)
    one = linear_drag_residual(vehicle, *whole)
    two = sum_residual([linear_drag_residual(vehicle, *half, source=name) for name in "ab"])
    assert (two.name, two.source) == ("linear_drag+linear_drag", "a+b")
    flights = [flown(vehicle, rigid(vehicle, part), trajectory=Hover(duration=1.0)) for part in (one, two)]
    for name in STATE_COLUMNS:
        assert np.allclose(flights[0].columns[name], flights[1].columns[name], atol=1e-9)


def test_a_sum_knows_where_all_its_parts_were_fitted(vehicle):

    parts = [make_residual(name, vehicle) for name in ("linear_drag", "neural", "none")]
    ranges = ({"v_x": [-9.0, 8.0]}, {"v_x": [-5.0, 12.0], "thrust": [1.0, 30.0]}, None)
    both = sum_residual([replace(part, ranges=own) for part, own in zip(parts, ranges, strict=True)])
    assert both.ranges == {"v_x": [-5.0, 8.0], "thrust": [1.0, 30.0]}
    assert sum_residual(parts[:1]) is parts[0]
    with pytest.raises(UsageError, match="at least one"):
        sum_residual([])


def test_only_the_last_part_adapts(vehicle):
    known, last = make_residual("gp_per_axis", vehicle), linear_drag_residual(vehicle, (0.1, 0.1, 0.1))
    controller = AdaptingController(
        vehicle, [known], adapting_drag(vehicle, last, 1.0), MPCSettings(), AdaptKeys(), backend="interpreted"
    )
    flown(vehicle, controller, trajectory=Hover(duration=1.0))
    used = controller.mpc.parameters.ravel()
    assert np.array_equal(used[: len(known.theta)], known.theta)
    assert not np.array_equal(used[len(known.theta) :], last.theta)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ("controller.residual=[]", "must be one of terms"),
        ("controller.residual=[gp]", "controller.residual=gp: must be one of terms, .*gaussian_process"),
        ("controller.residual=[terms,neural]", "terms have no fitted values"),
        ("controller.residual=[linear_drag,neural]", "one folder for each of linear_drag, neural"),
        ("controller.residual=[neural]", "fit neural DATASET"),
        ("controller.adapt.memory=0", r"must be in \(0, 1e9\] s"),
        ("controller.adapt.law=newton", "must be one of bayes, rls, composite"),
    ],
)
def test_impossible_settings_are_refused(change, found):
    with pytest.raises(UsageError, match=found):
        find_model(compose(["controller=online_mpc", change]))


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        (["controller.adapt.fitc=true"], "terms has no inducing points"),
        (["observer=disturbance"], "what it learns in flight"),
    ],
)
def test_what_does_not_go_together_is_refused(changes, found):
    with pytest.raises(UsageError, match=found):
        fly_one(compose(["controller=online_mpc", "controller.backend=interpreted", *changes]))


def test_a_sum_is_not_given_one_model():
    with pytest.raises(UsageError, match=r"sums several models; set controller.models"):
        find_model(compose(["controller=sum_mpc", "model=models/gp"]))
