"""Hover under the MPC with motors, battery and a weakened rotor, on three airframes: held, logged, and how it ends."""

import numpy as np
import pytest

from quadexp.control.mpc.mpc import ModelPredictiveController
from quadexp.control.mpc.settings import MPCSettings
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.models.residual import no_residual
from quadexp.plugins.worlds.battery import Battery
from quadexp.reference.hover import Hover
from quadexp.world.actuator import Actuator
from quadexp.world.rotor_loss import RotorLoss
from quadexp.world.world import World
from tests.models.residuals import with_rotors
from tests.world.airframes import AIRFRAMES, airframe

WORLDS = {
    "motors": [Actuator(time_constant_up=0.0125, time_constant_down=0.025, rotor_scale_std=0.03)],
    "battery": [Battery(capacity=0.2)],
    "compensated": [Battery(capacity=0.2, compensation=True)],
    "loss": [RotorLoss(losses=({"rotor": 2, "t": 0.5, "factor": 0.9},))],
}


def hover(vehicle, kind, effects, seconds=2.0):
    vehicle = with_rotors(vehicle)
    mpc = ModelPredictiveController(vehicle, no_residual(vehicle), MPCSettings(nodes=6), backend="interpreted")
    reference = SampledReference(Hover(duration=seconds), mpc)
    return fly(World(airframe(kind, vehicle), effects), mpc, reference, np.random.default_rng(3))


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("kind", AIRFRAMES)
def test_hover_is_held_with_what_the_commands_must_be(vehicle, kind, world):
    """The controller finds the commands that deliver the weight; what is delivered is what the columns say."""
    flight = hover(vehicle, kind, WORLDS[world])
    assert flight.outcome == "ok"
    assert np.abs(flight.stack(["p_x", "p_y", "p_z"]) - [0, 0, 1]).max() < 0.25
    speed = flight.stack([f"rotor_speed_{i}" for i in range(4)])[-25:]
    delivered = with_rotors(vehicle).thrust_coefficient * np.sum(speed**2, axis=1)
    commanded = flight.input.sum(axis=1)[-25:]
    weight = vehicle.mass * 9.81
    assert delivered.mean() == pytest.approx(weight, rel=0.04 if kind == "simplified" else 0.02)  # with its motor loss
    if world == "loss":
        assert delivered.mean() == pytest.approx(commanded.mean() - 0.1 * flight["u_2"][-25:].mean(), rel=0.01)
    if "battery_voltage" in flight.columns:
        voltage, current, charge = (flight[n] for n in ("battery_voltage", "battery_current", "state_of_charge"))
        assert charge[0] == 1 and np.all(np.diff(charge) < 0) and voltage[-1] < voltage[0] and np.all(current > 0)
        sagging = world == "battery"
        assert (commanded.mean() > 1.01 * delivered.mean()) == sagging


@pytest.mark.parametrize("kind", AIRFRAMES)
def test_the_log_ends_where_the_battery_is_empty(vehicle, kind):
    flight = hover(vehicle, kind, [Battery(capacity=0.02, state_of_charge=0.3, cutoff_voltage=0.0)], seconds=4.0)
    assert flight.outcome == "lost" and flight.metadata["cause"].startswith("the battery is empty (battery.capacity")
    assert 0.5 < flight.t[-1] < 3.9 and 0 < flight["state_of_charge"][-1] < 0.02
