"""The reference that a flight follows, as its controller sees it."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.air.none import no_residual
from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.rollout import SampledReference
from quadexp.reference.circle import Circle
from quadexp.reference.flatness import flat_reference


@pytest.mark.parametrize(
    ("rate", "nodes", "first_node"),
    [(50.0, 10, 0.0), (100.0, 10, 0.0), (50.0, 20, 0.0), (30.0, 8, 0.0), (50.0, 10, 0.02)],
    ids=["5", "10", "2.5", "3.75", "growing"],
)
def test_horizons_are_the_trajectory_at_the_nodes(vehicle, rate, nodes, first_node):
    """Whether or not the node period is a whole number of control periods (the id says how many)."""
    settings, path = MPCSettings(rate=rate, nodes=nodes, first_node=first_node), Circle(speed=3.0)
    controller = ModelPredictiveController(vehicle, no_residual(vehicle), settings, backend="interpreted")
    reference = SampledReference(path, controller)
    whole = not first_node and (settings.node_period / settings.control_period) % 1 < 1e-9
    for k in (0, 1, len(reference) // 2, len(reference) - 1):
        states, inputs = reference.horizon(k)
        times = k * settings.control_period + np.r_[0.0, np.cumsum(settings.node_periods)]
        exact = flat_reference(path, times, vehicle)
        turned = np.sign((states[0, 3:7] * exact.state[0, 3:7]).sum())  # the sign of q is free at the start
        exact.state[:, 3:7] *= turned
        assert states.shape == (nodes + 1, 13) and inputs.shape == (nodes, vehicle.n_rotors)
        assert np.allclose(states, exact.state, atol=1e-7) and np.allclose(inputs, exact.input[:-1], atol=1e-6)
        assert states.flags.writeable != whole  # then it is a view into what later steps will see


def test_what_a_controller_sees_cannot_be_changed_by_it(vehicle):
    controller = ModelPredictiveController(vehicle, no_residual(vehicle), backend="interpreted")
    reference = SampledReference(Circle(speed=3.0), controller)
    states, _ = reference.horizon(0)
    with pytest.raises(ValueError, match="read-only"):
        states[0, 0] = 1.0


def test_a_renewal_that_fails_is_tried_again_after_twice_the_time():
    """And after the usual time once it has succeeded."""
    from quadexp.errors import UsageError
    from quadexp.experiment.rollout import Renewal

    made = []

    class Reference:
        residual_share = 1.0

        def renew(self, residual):
            made.append(k)
            if k < 60:
                raise UsageError("no reference")

    renewal = Renewal(10)
    for k in range(160):
        if renewal.due(k):
            renewal.renew(k, Reference(), None)
    assert made == [10, 30, 70, 80, 90, 100, 110, 120, 130, 140, 150]
    assert renewal.failed == 2
    assert not Renewal(0).due(0)
