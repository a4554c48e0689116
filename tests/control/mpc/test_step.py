"""The control step by itself: it predicts what its own linearisation says, in whatever coordinates it solves."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadexp.control.mpc.attitude_error import attitude_error_in, reference_frames
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.mpc.step import Step, step_functions
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
    step = Step(*step_functions(vehicle, residual, NODES, attitude_error=error, scalar=False))
    for name, value in arguments.items():
        step.arguments[name][...] = np.asarray(value).T
    step()
    return {name: array.T for name, array in step.results.items()}


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
            A, B = plain["A"][:, 13 * k : 13 * (k + 1)], plain["B"][:, 4 * k : 4 * (k + 1)]
            assert change[:, k + 1] == pytest.approx(
                A @ change[:, k] + B @ effort[:, k] + plain["b"][:, k], rel=1e-8, abs=1e-8
            )


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
