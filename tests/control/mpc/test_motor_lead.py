"""The inverted motor lag: rotors are where the plan wants them when the next command comes."""

import numpy as np
import pytest

from quadexp.control.control_step import run
from quadexp.control.mpc.dead_time import MotorLead
from quadexp.control.mpc.settings import MPCSettings
from quadexp.errors import UsageError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.physics.motor import lagging_thrust


def commanded(vehicle, lag, planned, now, scale=1.0):
    limits = np.full(4, scale * vehicle.thrust_min), np.full(4, scale * vehicle.thrust_max)
    calls, command = MotorLead(limits, MPCSettings(motor_lead=lag)).after(planned, now)
    run(calls)
    return command


@pytest.mark.parametrize("lag", [0.005, 0.03, 0.1])
def test_the_planned_thrust_is_reached_within_a_period(vehicle, lag):
    now, planned = np.array([2.0, 2.5, 3.0, 2.2]), np.array([2.1, 2.4, 3.0, 2.5])
    command = commanded(vehicle, lag, planned, now)
    assert np.allclose(np.array(lagging_thrust(now, command, MPCSettings().control_period, lag)).ravel(), planned)


def test_the_command_keeps_to_the_limits(vehicle):
    command = commanded(vehicle, 0.1, np.array([0.0, 20, 9, 11]), np.full(4, 10.0))
    assert command.min() == vehicle.thrust_min and command.max() == vehicle.thrust_max
    assert command[2] < 9 and command[3] > 11


def test_the_limits_are_those_of_what_rotors_deliver(vehicle):
    """Where they give a fifth more of a command, a fifth more is delivered before the command is at its limit."""
    command = commanded(vehicle, 0.1, np.array([0.0, 20, 9, 11]), np.full(4, 10.0), scale=1.2)
    assert command.max() == pytest.approx(1.2 * vehicle.thrust_max)


def test_commands_reach_their_limit_whatever_scale_is_believed():
    """A vehicle a fifth lighter than assumed, with lagging motors, in corners: all of its thrust is used."""
    light = ["truth.mass=0.83", "controller.allow_unstable=true", "remedies=auto", "world=only_motor_lag"]
    path = ["trajectory=rectangle", "trajectory.start=reference", "trajectory.duration=8", "trajectory.speed=8"]
    flight = fly_one(compose(["controller=perfect_mpc", *light, *path]))
    settled, commands = flight.t > 2, np.column_stack([flight.columns[f"u_{i}"] for i in range(4)])
    assert np.median(flight.columns["observer_thrust_scale"][settled]) > 1.1
    most = build_vehicle(compose([]).vehicle).thrust_max
    assert commands[settled].max() == pytest.approx(most, rel=1e-3) and commands.max() <= most


def test_a_lag_is_modelled_or_inverted():
    with pytest.raises(UsageError, match=r"controller.motor_lead=0.02: must be 0 where controller.motor_lag=0.03"):
        MPCSettings(motor_lag=0.03, motor_lead=0.02)


def test_what_each_way_leaves_of_the_lag():
    """A lemniscate at 8 m/s in the world of one's own model, rotors 30 ms slow: given as states better than inverted,
    that better than not given."""
    world = ["controller=perfect_mpc", "actuator=lag_30ms", "horizon=robust", "trajectory=lemniscate"]
    world += ["trajectory.speed=8", "link=latency", "controller.dead_time=0.01", "plant.step=2e-3"]
    world += ["controller.backend=interpreted", "plant.backend=interpreted"]
    error = {}
    for way in ("none", "states", "lead"):
        flight = fly_one(compose([*world, f"motor={way}"]))
        away = [flight.columns[f"p_{axis}"] - flight.columns[f"ref_p_{axis}"] for axis in "xyz"]
        error[way] = 1e3 * float(np.linalg.norm(away, axis=0).mean())
    assert error["states"] < 0.7 * error["lead"] and error["lead"] < 0.5 * error["none"] and error["lead"] < 1.3
