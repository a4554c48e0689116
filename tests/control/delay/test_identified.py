"""Delays that are found in flight: what is found, a controller that is soft until then, flights that begin anew."""

import numpy as np
import pytest

from quadexp.control.delay.identified import CommandsAhead, soft
from quadexp.control.delay.timing import Delays
from quadexp.control.instant import run
from quadexp.control.mpc.dead_time import DeadTimePredictor
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.wrapped import innermost
from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller, build_trajectory, build_vehicle, build_world
from quadexp.experiment.evaluate import fly_one
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.parts.compose import compose
from quadexp.report.summary import delays_note
from tests.models.residuals import make_residual

INTERPRETED = ["controller=nominal_mpc", "controller.backend=interpreted"]
WORLD = ["estimator=late_noisy", "link=latency", "actuator=lag_30ms", "trajectory=lemniscate", "horizon=firm"]


def test_delays_are_found_and_made_good_in_flight():
    """Noisy and 50 ms late in all: soft at first, then with what was found, and better."""
    world = ["controller=perfect_mpc", "controller.backend=interpreted", *WORLD, "trajectory.speed=8"]
    flight = fly_one(compose([*world, "delay=identified", "seed=4"]))
    known = flight["delay_known"]
    first = int(np.argmax(known))
    assert flight.metadata["outcome"] == "ok" and known[:150].max() == 0 and 150 <= first < 600 and known[-1] == 1
    assert flight["delay_time"][-1] == pytest.approx(0.01, abs=2.5e-3)
    late = flight.metadata["margins"]
    assert flight["delay_dead_time"][-1] + flight["delay_lag"][-1] == pytest.approx(0.04, abs=6e-3)
    none = fly_one(compose([*world, "horizon=published", "seed=4"]))

    def away(one, after):
        error = [one[f"p_{axis}"] - one[f"ref_p_{axis}"] for axis in "xyz"]
        return float(np.linalg.norm(error, axis=0)[after:].mean())

    assert away(flight, first + 50) < 0.6 * away(none, first + 50)
    assert f"the published grid with soft weights flew until t={0.02 * first:.2f} s" in delays_note(flight.columns)
    assert not delays_note(none.columns) and "not all found" in delays_note(
        {name: column[:100] for name, column in flight.columns.items()}
    )
    assert late["growth"] < 0 and late["delay"] > 0.03  # the loop that takes off is the soft one


def test_the_soft_controller_has_the_published_grid():
    made = soft(MPCSettings(first_node=0.02, horizon=0.6, position_weight=(200.0, 5.0, 100.0)), 0.03)
    assert np.allclose(made.node_periods, MPCSettings().node_periods) and made.dead_time == 0.03
    assert made.position_weight == (10.0, 5.0, 10.0)


@pytest.mark.parametrize(("dead_time", "lag"), [(0.01, 0.0), (0.035, 0.03), (0.06, 0.02)])
def test_the_prediction_that_may_change_is_that_of_fixed_times(vehicle, rng, dead_time, lag):
    """Against DeadTimePredictor, whose dead time is a part of its structure."""
    settings = MPCSettings(dead_time=dead_time, motor_lead=lag)
    mpc = ModelPredictiveController(vehicle, make_residual("none", vehicle), settings, backend="interpreted")
    fixed, free = DeadTimePredictor(mpc), CommandsAhead(mpc)
    commands = vehicle.hover_thrust * (1 + 0.2 * rng.standard_normal((60, 4)))
    fixed.reset(commands[0])
    for u in commands:
        run(fixed.after(u))
    free.tune(dead_time, lag, commands)
    x = np.r_[1.0, 2, 3, 1, 0, 0, 0, 2, -1, 0.5, 0.3, 0.2, -0.4]
    ours, theirs = free.predict(x), fixed.predict(x)
    assert len(ours) == 17 and np.abs(ours[: len(theirs)] - theirs).max() < 2e-3  # the thrusts always stand behind
    if lag:
        assert np.abs(ours[13:] - theirs[13:]).max() < 1e-6


def test_what_was_sent_before_counts_as_far_as_it_is_delivered():
    """Delays are looked for again: by then the observer knows what the rotors give of a command."""
    hover = ["trajectory=hover", "trajectory.duration=0.1"]
    config = compose([*INTERPRETED, *hover, "observer=disturbance", "delay=identified"])
    vehicle = build_vehicle(config.vehicle)
    plant = build_world(config, vehicle)
    controller = build_controller(config, vehicle, plant, None)
    fly(plant, controller, SampledReference(build_trajectory(config.trajectory), controller), np.random.default_rng(0))
    innermost(controller).believed.numbers[9] = 0.8
    controller._make_early(Delays(0.0, 0.0, 0.0, 0.0, 0.01, 0.0, 0.03, 0.0))
    sent, delivered = controller._prediction.commands.values, controller._ahead._sent.values
    assert sent.min() > 0 and np.array_equal(delivered, 0.8 * sent[-len(delivered) :])


@pytest.mark.parametrize("told", ["controller.dead_time=0.01", "motor=states", "motor=lead"])
def test_what_is_told_needs_not_be_found(told):
    with pytest.raises(UsageError, match=r"delay=identified: finds dead time and lag itself"):
        fly_one(compose([*INTERPRETED, "trajectory=hover", "delay=identified", told]))


def test_a_controller_that_is_no_mpc_is_refused():
    with pytest.raises(UsageError, match=r"is no MPC whose grid can follow .* identify --method delays"):
        fly_one(compose(["vehicle=lei_li", "controller=static_feedback", "trajectory=hover", "delay=identified"]))
