"""The control step by itself: it predicts what its own linearisation says, in whatever coordinates it solves."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.control.mpc.attitude_error import attitude_error_in, reference_frames
from quadexp.control.mpc.mpc import ModelPredictiveController, stages_of
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.mpc.step import Step
from quadexp.models.residual import no_residual
from quadexp.physics.state import ATTITUDE
from tests.models.residuals import make_residual
from tests.states import random_state

NODES = 5


def trajectory(rng: np.random.Generator) -> np.ndarray:
    """States (13, N + 1) of any attitudes, quaternions of about unit length."""
    states = np.array([random_state(rng) for _ in range(NODES + 1)])
    states[:, ATTITUDE] *= rng.uniform(0.9, 1.1, (NODES + 1, 1))
    return states.T


def step_of(vehicle, residual, error: str, arguments: dict) -> dict[str, np.ndarray]:
    """What a step leaves, matrices as CasADi has them."""
    step = Step(stages_of(vehicle, residual, "interpreted", attitude_error=error), NODES)
    for name, value in arguments.items():
        step.arguments[name][...] = np.asarray(value).T
    step()
    return {name: array.T for name, array in step.results.items()} | dict(zip("ABb", step.dynamics, strict=True))


def test_both_errors_of_attitude_step_along_the_same_dynamics(vehicle, rng):
    """x'_{k+1} - x_{k+1} = A (x'_k - x_k) + B (u'_k - u_k) + b: the plain step gives A, B and b, the other one too
    must obey them, though it turns every node into the frame of that node's reference. No reference is near."""
    residual, settings = make_residual("linear_drag", vehicle), MPCSettings()
    arguments = {"X": trajectory(rng), "X_ref": trajectory(rng), "x0": random_state(rng), "theta": residual.theta}
    arguments |= {name: rng.uniform(1, 9, (4, NODES)) for name in ("U", "U_ref")}
    share, dt = rng.uniform(0.2, 2.0, NODES), rng.uniform(0.02, 0.3, NODES)
    arguments |= {"Q": np.outer(settings.state_weight(), share), "Q_end": 2 * settings.state_weight()}
    arguments |= {"R": np.outer(settings.thrust_weight(vehicle), share), "dt": dt, "shift": 0.02 / dt}
    arguments |= {"u_min": np.zeros(4), "u_max": np.full(4, 20)}
    plain, body = (step_of(vehicle, residual, error, arguments) for error in ("plain", "body"))
    assert body["X_lin"] == pytest.approx(plain["X_lin"])
    assert np.abs(body["U_new"] - plain["U_new"]).max() > 0.1  # another cost, another answer
    for step in (plain, body):
        change, effort = step["X_new"] - step["X_lin"], step["U_new"] - step["U_lin"]
        assert np.all(change[:, 0] == 0)
        for k in range(NODES):
            moved = plain["A"][k] @ change[:, k] + plain["B"][k] @ effort[:, k] + plain["b"][k]
            assert change[:, k + 1] == pytest.approx(moved, rel=1e-8, abs=1e-8)


def test_the_error_in_world_axes_is_that_of_the_rotation_from_the_reference():
    """Vector part of q o q_r^-1, by SciPy; with equal weights it costs what the error in body axes does."""
    rng = np.random.default_rng(4)
    q, ref = (Rotation.random(random_state=rng) for _ in range(2))
    X_ref, x = np.zeros((13, 1)), np.zeros(13)
    X_ref[3:7, 0], x[3:7] = ref.as_quat(scalar_first=True), q.as_quat(scalar_first=True)
    found = {}
    for kind in ("world", "body"):
        error = attitude_error_in(*reference_frames(ca.DM(X_ref), kind))
        found[kind] = np.array(error.deviation(0, ca.DM(x))).ravel()[3:7]
        assert np.array(error.change(0, error.deviation(0, ca.DM(x)))).ravel() == pytest.approx(x)
    assert np.abs(found["world"]) == pytest.approx(np.abs((q * ref.inv()).as_quat(scalar_first=True)), abs=1e-12)
    assert np.abs(found["body"]) == pytest.approx(np.abs((ref.inv() * q).as_quat(scalar_first=True)), abs=1e-12)
    assert np.abs(found["world"] - found["body"]).max() > 0.1


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
    arguments = controller.step.arguments
    arguments["X"][...], arguments["U"][...], arguments["shift"][...] = guess, hover, 0.0
    arguments["x0"][...], arguments["X_ref"][...], arguments["U_ref"][...] = measured, measured, hover
    controller.step()
    point = controller.step.results["X_lin"]
    assert point[0] == pytest.approx(measured)
    expected = guess[1:].copy()
    expected[:, ATTITUDE] = np.clip(lengths[1:], 0.5, 2.0)[:, None] * directions[1:]
    assert point[1:] == pytest.approx(expected, rel=1e-14)
