"""A rotor that loses thrust: as the same airframe whose command is scaled by hand, from the stated time on."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.world.rotor_loss import RotorLoss
from quadexp.world.world import World
from tests.world.airframes import AIRFRAMES, PERIOD, airframe, commands, fly, start


@pytest.mark.parametrize("kind", AIRFRAMES)
def test_a_loss_is_a_scaled_command_from_its_time_on(vehicle, kind):
    """Two rotors, one of them twice; t=0.1 and 0.2 are instants of control."""
    losses = (
        {"rotor": 2, "t": 0.2, "factor": 0.5},
        {"rotor": 2, "t": 0.1, "factor": 0.7},
        {"rotor": 0, "t": 0.0, "factor": 0.9},
    )
    u, x = commands(vehicle, 15), start(5)
    by_hand = u.copy()
    by_hand[:, 0] *= 0.9
    by_hand[5:10, 2] *= 0.7
    by_hand[10:, 2] *= 0.5
    flown = fly(World(airframe(kind, vehicle), [RotorLoss(losses=losses)]), x, u)[0]
    assert np.abs(flown - fly(airframe(kind, vehicle), x, by_hand)[0]).max() < 1e-9
    assert np.abs(flown - fly(airframe(kind, vehicle), x, u)[0])[-1].max() > 0.01


def test_a_loss_within_a_period_is_exact_on_the_integration_steps(vehicle):
    """Losing all of a rotor after 5 of the 20 ms costs a quarter less of its impulse than losing it at once."""
    plant, x = airframe("from_model", vehicle), start(1)
    u = [np.full(vehicle.n_rotors, vehicle.hover_thrust)]

    def speed(t):
        return fly(World(plant, [RotorLoss(losses=({"rotor": 1, "t": t, "factor": 0.0},))]), x, u)[0][-1, 10:]

    whole, part, none = speed(0.0), speed(0.005), speed(PERIOD)
    assert np.linalg.norm(part - none) / np.linalg.norm(whole - none) == pytest.approx(0.75, rel=0.02)


@pytest.mark.parametrize(
    ("losses", "words"),
    [
        (({"rotor": 0, "t": 1.0},), "each loss is"),
        (({"rotor": 0.5, "t": 1.0, "factor": 0.5},), "must be a rotor's number"),
        (({"rotor": 0, "t": -1.0, "factor": 0.5},), "t must not be negative"),
        (({"rotor": 0, "t": "soon", "factor": 0.5},), "must be numbers"),
    ],
)
def test_wrong_losses_are_refused(losses, words):
    with pytest.raises(UsageError, match=words):
        RotorLoss(losses=losses)


def test_a_rotor_that_is_not_there_is_refused(vehicle):
    world = World(airframe("from_model", vehicle), [RotorLoss(losses=({"rotor": 4, "t": 1.0, "factor": 0.5},))])
    with pytest.raises(UsageError, match="has rotors 0 to 3"):
        world.columns(PERIOD)
