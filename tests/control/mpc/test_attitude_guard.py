"""Quaternions between the iterations of the controller: no longer of unit length, but never far from it."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.models.residual import no_residual
from quadexp.physics.state import ATTITUDE


def test_lengths_between_a_half_and_two_are_left_alone(vehicle, rng):
    """The linearisation point of a step from a guess with quaternions of any length: others get the nearest of both,
    the measured state and everything besides the attitude stays what it is."""
    controller = ModelPredictiveController(vehicle, no_residual(vehicle), backend="interpreted")
    nodes = controller.settings.nodes
    measured = np.r_[rng.normal(size=3), 1, np.zeros(9)]
    guess, hover = rng.normal(size=(nodes + 1, 13)), np.full((nodes, 4), vehicle.hover_thrust)
    lengths = np.array([1, 0.1, 0.3, 0.49, 0.51, 0.7, 0.99, 1.01, 1.9, 2.1, 9.0])
    directions = guess[:, ATTITUDE] / np.linalg.norm(guess[:, ATTITUDE], axis=1)[:, None]
    guess[:, ATTITUDE] = lengths[:, None] * directions
    arguments = controller._step.arguments
    arguments["X"][...], arguments["U"][...], arguments["shift"][...] = guess, hover, 0.0
    arguments["x0"][...], arguments["X_ref"][...], arguments["U_ref"][...] = measured, measured, hover
    controller._step()
    point = controller._step.results["X_lin"]
    assert point[0] == pytest.approx(measured)
    expected = guess[1:].copy()
    expected[:, ATTITUDE] = np.clip(lengths[1:], 0.5, 2.0)[:, None] * directions[1:]
    assert point[1:] == pytest.approx(expected, rel=1e-14)
