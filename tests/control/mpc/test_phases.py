"""Preparation and feedback: the answer of the whole step, whatever the measurement turns out to be."""

import numpy as np
import pytest

import quadexp as qx
from quadexp.control.base import Measurement
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.controller import PredictiveController
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.errors import QuadexpError
from quadexp.experiment.rollout import SampledReference
from quadexp.physics.state import ATTITUDE, POSITION
from quadexp.reference.lemniscate import Lemniscate
from quadexp.world import PlantEffects, SimplifiedPlant
from tests.models.residuals import make_residual

FORMS = {
    "published": {},
    "body": {"attitude_error": "body", "terminal_weight": 2.0},
    "precise": {"first_node": 0.02, "input_hold": "deviation"},
    "late": {"first_node": 0.04, "dead_time": 0.03, "motor_lag": 0.03, "input_hold": "deviation"},
}


def controller_of(vehicle, residual="none", backend="interpreted", **settings) -> PredictiveController:
    settings = MPCSettings(nodes=6, **settings)
    return PredictiveController(
        ModelPredictiveController(vehicle, make_residual(residual, vehicle), settings, backend=backend)
    )


def fly(vehicle, one, other, rng, steps=60):
    """Both controllers in one flight with large disturbances, the first prepared: largest difference, and the records.

    Every 13th step the vehicle is moved by about 0.5 m, and every other quaternion is measured with the other sign.
    """
    plant = SimplifiedPlant(vehicle, PlantEffects(), backend="interpreted")
    reference = SampledReference(Lemniscate(speed=5.0, acceleration=2.5), one)
    x, worst, records = reference.along()[0][0].copy(), 0.0, []
    for controller in (one, other):
        controller.reset(x, reference.window(0))
    for k in range(steps):
        if k % 13 == 5:
            x[POSITION] += rng.normal(0, 0.5, 3)
        measured = x.copy()
        measured[ATTITUDE] *= rng.choice([-1, 1])
        window = reference.window(k)
        one.prepare(window)
        u, record = one.step(Measurement(0.0, measured, None, None), window)
        expected, same = other.step(Measurement(0.0, measured, None, None), reference.window(k))
        worst = max(worst, np.abs(u - expected).max())
        assert (record.status, record.active) == (same.status, same.active)
        assert record.kkt == pytest.approx(same.kkt, rel=1e-6, abs=1e-9)
        records.append(record)
        x, _ = plant.advance(x, u, one.control_period, rng)
    return worst, records


@pytest.mark.parametrize(
    ("form", "backend"), [*((form, "interpreted") for form in FORMS), ("body", "auto"), ("late", "auto")]
)
def test_the_answer_is_the_whole_steps(vehicle, rng, form, backend):
    """With bounds met, attitudes on either side, and process noise."""
    one, other = (controller_of(vehicle, "linear_drag", backend, **FORMS[form]) for _ in range(2))
    worst, records = fly(vehicle, one, other, rng)
    assert worst < 1e-8 and any(record.status == Status.ACTIVE_SET for record in records)


@pytest.mark.parametrize("residual", ["gp_with_mean", "neural", "plant"])
def test_with_every_model_of_the_air(vehicle, rng, residual):
    one, other = (controller_of(vehicle, residual) for _ in range(2))
    assert fly(vehicle, one, other, rng, steps=16)[0] < 1e-8


def prepared(vehicle, **settings):
    """A controller at hover after its first step, and the window for which it is prepared."""
    controller = controller_of(vehicle, **settings)
    reference = SampledReference(Lemniscate(speed=5.0, acceleration=2.5), controller)
    x, window = reference.along()[0][0].copy(), reference.window(1)
    controller.reset(x, window)
    controller.step(Measurement(0.0, x, None, None), window)
    controller.prepare(window)
    return controller, x, window


def test_an_attitude_on_the_other_side_of_the_reference_takes_the_whole_step(vehicle):
    """Turned by over half a revolution from the prediction the reference's sign is another one."""
    answers = []
    for with_preparation in (True, False):
        controller, x, window = prepared(vehicle)
        turned = x.copy()
        turned[ATTITUDE] = [np.cos(1.7), np.sin(1.7), 0.0, 0.0]
        controller.mpc._X[:, ATTITUDE] = [np.cos(1.5), np.sin(1.5), 0.0, 0.0]  # a prediction near to it
        if with_preparation:
            controller.prepare(window)
            answers.append(controller.mpc.feedback(turned)[0])
        else:
            answers.append(controller.mpc.command(turned, window.state, window.input)[0])
    assert answers[0] == pytest.approx(answers[1], abs=1e-8)


def test_a_preparation_serves_one_step_on_its_own_window(vehicle):
    """Another window, new parameters, a reset or a step: then the whole step is made, on what it is given."""
    controller, x, window = prepared(vehicle)
    elsewhere = window._replace(state=window.state + np.r_[0.05, np.zeros(12)])
    plain, _, _ = prepared(vehicle)
    measurement = Measurement(0.0, x, None, None)
    expected = plain.mpc.command(x, elsewhere.state, elsewhere.input)[0]
    assert controller.step(measurement, elsewhere)[0] == pytest.approx(expected)
    with pytest.raises(QuadexpError, match="nothing has been prepared"):
        controller.mpc.feedback(x)
    controller.prepare(window)
    controller.mpc.set_parameters(controller.mpc.parameters.copy())
    assert not controller.mpc.prepared
    controller.prepare(window)
    controller.mpc.reset(x, window.state, window.input)
    assert not controller.mpc.prepared
    controller.prepare(window)  # before the first step there is no solution to go on from
    assert not controller.mpc.prepared and controller.step(measurement, window)[1].converged


def test_from_beyond_the_distance_limit_the_whole_step_is_made(vehicle):
    answers = []
    for with_preparation in (True, False):
        controller, x, window = prepared(vehicle, distance_limit=0.5)
        if not with_preparation:
            controller.mpc.prepared = False
        answers.append(controller.step(Measurement(0.0, x + np.r_[2.0, np.zeros(12)], None, None), window)[0])
    assert answers[0] == pytest.approx(answers[1], abs=1e-12)


def test_what_is_no_number_is_refused(vehicle):
    controller, x, window = prepared(vehicle)
    with pytest.raises(QuadexpError, match="the measured state is not finite"):
        controller.mpc.feedback(x * np.nan)
    with pytest.raises(QuadexpError, match="the reference is not finite"):
        controller.prepare(window._replace(state=window.state * np.nan))


@pytest.mark.parametrize("name", ["perfect_mpc", "rls_mpc", "static_feedback"])
def test_in_a_loop_of_ones_own(name):
    """ControlLoop.prepare: the same thrusts, of a controller that prepares and of those that cannot."""
    settings = ["vehicle=lei_li", "plant=blade_element", f"controller={name}", "trajectory=circle"]
    settings += ["trajectory.speed=3", "trajectory.acceleration=1.5", "plant.backend=interpreted"]
    settings += [] if name == "static_feedback" else ["controller.backend=interpreted"]
    thrusts = []
    for with_preparation in (True, False):
        loop = qx.controller(*settings)
        x, rng, sent, acceleration = loop.start, np.random.default_rng(0), [], None
        for t in loop.times[:10]:
            if with_preparation:
                loop.prepare(t)
            sent.append(loop.step(qx.Measurement(t, x, acceleration, getattr(loop.plant, "rotor_speed", None))))
            x, acceleration = loop.plant.advance(x, sent[-1], loop.period, rng)
        thrusts.append(sent)
    assert np.array(thrusts[0]) == pytest.approx(np.array(thrusts[1]), abs=1e-8)
