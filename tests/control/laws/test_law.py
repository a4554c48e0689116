"""A law is one class: what it reads, remembers and logs follows from its equations."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
import pytest

from quadexp.control.base import Belief, Measurement
from quadexp.control.law import Law
from quadexp.errors import UsageError
from quadexp.experiment.build import build_controller, build_trajectory, build_vehicle, build_world
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.parts.compose import compose
from quadexp.parts.listing import candidates  # noqa: F401 - what completion reads must not need a vehicle
from quadexp.parts.settings import key
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import ATTITUDE, POSITION, VELOCITY
from quadexp.plugins.margins.loop_margins import loop_margins
from tests.control.laws.flown import at_rest, hovering


@dataclass(frozen=True, kw_only=True)
class Counting(Law):
    """Hover thrust, an integral of the position error, and how many steps there were."""

    gain: float = key(2.0, "of the integral", "[0, 10]")
    memory = {"integral": 3, "steps": 1}
    logged = ("integral", "steps")

    def start(self, vehicle, x):
        return {"steps": np.array([10.0])}

    def equations(self, vehicle, inputs, memory):
        integral = memory.integral + inputs.period * self.gain * (inputs.state[POSITION] - inputs.path[:, 0])
        thrusts = vehicle.hover_thrust * ca.SX.ones(vehicle.n_rotors)
        return {"command": thrusts, "integral": integral, "steps": memory.steps + 1}


def flown(law, vehicle, steps, residual=None, **told):
    """The controller after some steps in one state, a metre ahead."""
    controller, window = law.controller(vehicle, residual), hovering(vehicle)
    x = at_rest((1.0, 0.0, 0.0))
    controller.reset(x, window)
    for k in range(steps):
        controller.step(Measurement(k * controller.control_period, x, told.get("force"), told.get("speed")), window)
    return controller


@pytest.mark.parametrize("backend", ["interpreted", "compiled"])
def test_it_remembers_what_it_names_and_logs_it_by_axis(vehicle, backend):
    """i = k T c e_p after k steps, exactly; a flight begins anew."""
    controller = flown(Counting(rate=50.0, backend=backend), vehicle, 5)
    expected = {"integral_x": 5 * 0.02 * 2.0, "integral_y": 0.0, "integral_z": 0.0, "steps": 15.0}
    assert controller.log() == pytest.approx(expected, abs=1e-15)
    controller.reset(at_rest((1.0, 0.0, 0.0)), hovering(vehicle))
    controller.step(Measurement(0.0, at_rest((1.0, 0.0, 0.0)), None, None), hovering(vehicle))
    assert controller.log()["steps"] == 11.0


def test_only_what_it_reads_is_told(vehicle):
    """No belief, so no observer can be put around it; no reference by flatness, so the air is not in it."""
    controller = Counting(backend="interpreted").controller(vehicle, linear_drag_residual(vehicle, (0.3, 0.3, 0.0)))
    assert not hasattr(controller, "believe") and controller.residual is None and controller.air is not None


@dataclass(frozen=True, kw_only=True)
class Reading(Law):
    """Logs what it is given; no vehicle would fly with it."""

    logged = ("force", "speed", "fresh", "air", "wind")

    def equations(self, vehicle, inputs, memory):
        told = {"force": inputs.specific_force, "speed": inputs.rotor_speed, "fresh": inputs.fresh, "air": inputs.air}
        return {"command": inputs.thrusts, "wind": inputs.belief.wind, **told}


def test_readings_belief_and_air_are_what_they_are_called(vehicle):
    """The air at the velocity less the assumed wind, times its scale, by the model itself."""
    residual = linear_drag_residual(vehicle, (0.4, 0.3, 0.1))
    controller = Reading(backend="interpreted").controller(vehicle, residual)
    x, window, wind = at_rest(), hovering(vehicle), np.array([1.0, -2.0, 0.5])
    x[VELOCITY] = (3.0, 1.0, -1.0)
    controller.reset(x, window)
    controller.believe(Belief(np.zeros(3), np.zeros(3), wind, 1.0, 0.5))
    controller.step(Measurement(0.0, x, np.array([0.1, 0.2, 9.8]), None), window)
    log = controller.log()
    assert [log[f"force_{axis}"] for axis in "xyz"] == [0.1, 0.2, 9.8] and [log["fresh_0"], log["fresh_1"]] == [1, 0]
    assert [log[f"wind_{axis}"] for axis in "xyz"] == wind.tolist()
    z = np.hstack([np.asarray(air_velocity(x[ATTITUDE], x[VELOCITY], wind)).ravel(), np.zeros(3), window.input[0]])
    wanted = 0.5 * residual.function(z, residual.theta)[0].full().ravel()
    assert np.abs(wanted[:3]).max() > 0.1
    assert [log[f"air_{i}"] for i in range(6)] == pytest.approx(wanted, abs=1e-12)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"integral": ca.SX(3, 1)}, "must give 'command', 4 numbers"),
        ({"command": ca.SX(3, 1), "integral": ca.SX(3, 1)}, "must give 'command', 4 numbers"),
        ({"command": ca.SX(4, 1)}, "must give 'integral', 3 numbers"),
        (None, r"equations of Wrong: AttributeError: there is no input speed; inputs are state, reference, "),
    ],
)
def test_equations_that_do_not_give_what_they_must_are_refused_in_one_line(vehicle, given, message):
    @dataclass(frozen=True, kw_only=True)
    class Wrong(Law):
        memory = {"integral": 3}

        def equations(self, vehicle, inputs, memory):
            return inputs.speed if given is None else given

    with pytest.raises(UsageError, match=message):
        Wrong(backend="interpreted").controller(vehicle)


def test_its_margins_are_known_and_it_flies_in_c():
    """Of the example: what an own law of a user gets for nothing."""
    from pathlib import Path

    from quadexp.control.compiled_loop import goes_in_c

    examples = Path(__file__).resolve().parents[3] / "examples"
    config = compose(["controller=geometric", "trajectory=hover", "trajectory.duration=0.2"], examples)
    vehicle = build_vehicle(config.vehicle)
    plant = build_world(config, vehicle)
    controller = build_controller(config, vehicle, plant, None)
    assert build_trajectory(config.trajectory, vehicle).duration == 0.2
    controller.reset(at_rest(), hovering(vehicle))
    assert 0.03 < loop_margins(controller, plant)["delay"] < 0.2
    controller.reset(at_rest(), hovering(vehicle))
    assert goes_in_c(controller) == (controller.backend == "compiled")
