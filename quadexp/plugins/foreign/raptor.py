"""RAPTOR: one recurrent policy for all quadrotors (Eschmann, Albani, Loianno 2025, arXiv 2509.11481) as a Controller.

The weights are those of the package foundation-policy (MIT licence), its layers are rebuilt as one CasADi function:

    o = [p - p_r, R, v - v_r, w, a_last]        22 numbers: in the frame of the wanted heading, R row by row
    h = GRU(h, relu(W_1 o + b_1)),   a = W_2 h + b_2,   u = h_max clip((a + 1)/2, 0, 1)^2                          (1)

a: -1 .. 1 per rotor, front right, back right, back left, front left, a rotor speed between 0 and the largest, so that
thrust goes with its square. As the policy's own firmware module does, position and velocity errors are clipped on each
axis, and shown in the frame that is turned by the heading; a_last starts at 0. The policy knows no feed-forward but the
velocity, and no vehicle: it finds out in flight what it flies, from what its actions do.

It was trained on rotors in an X whose front right one pushes the vehicle clockwise (reaction torque -z). Other layouts
are turned about z: a plus by 45 degrees, an X whose rotors turn the other way by 90.
World ENU, body FLU, SI.
"""

from __future__ import annotations

import importlib
from functools import lru_cache
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.inputs import Inputs
from quadexp.control.law import Law
from quadexp.errors import UsageError
from quadexp.parts.settings import key, keyed
from quadexp.physics.expression import Expression, limited
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.laws.attitude import heading_of
from quadexp.provenance import package_identity

HIDDEN = 16  # width of the published network
ACTIONS = 4  # of the published network
PLACES = np.radians([-45.0, -135.0, 135.0, 45.0])  # front right, back right, back left, front left
SPINS = np.array([-1.0, 1.0, -1.0, 1.0])
NEAR = np.radians(25.0)  # of a place: rotors of a stretched X


@keyed
class Raptor(Law):
    """RAPTOR, a learned policy for all quadrotors (Eschmann et al. 2025), of the package foundation-policy.

    Raises UsageError where the package is missing, or for a layout that is no X."""

    former_kind = "raptor"
    memory = {"hidden": HIDDEN, "action": ACTIONS}

    allow_unstable: bool = key(True, "fly although the loop is not stable at hover, where the policy trembles")
    rate: float = key(100.0, "control rate; the policy was trained at 100 Hz", "[1, 1000]", "Hz")
    position_limit: float = key(0.5, "largest position error that the policy is shown, each axis", "(0, 100]", "m")
    velocity_limit: float = key(1.0, "largest velocity error that the policy is shown, each axis", "(0, 100]", "m/s")

    def start(self, vehicle: Vehicle, x: np.ndarray) -> dict[str, np.ndarray]:
        """See Law: the policy's first hidden state, and no action."""
        return {"hidden": policy(package_identity("foundation_policy")).layers[1].initial_hidden_state.ravel()}

    def equations(self, vehicle: Vehicle, inputs: Inputs, memory: Any) -> dict[str, Any]:
        """See Law; (1)."""
        x = inputs.state
        state = inputs.reference
        weights = package_identity("foundation_policy")
        order, turn = layout(vehicle)
        turned = about_z(ca.DM(turn))  # policy's body to the vehicle's
        level = about_z(heading_of(rotation_matrix(state[ATTITUDE]))) @ turned  # policy's world to ours
        R = level.T @ rotation_matrix(x[ATTITUDE]) @ turned
        position, velocity = (
            limited(level.T @ (x[part] - state[part]), -limit, limit)
            for part, limit in ((POSITION, self.position_limit), (VELOCITY, self.velocity_limit))
        )
        observation = ca.vertcat(position, ca.vec(R.T), velocity, turned.T @ x[RATE], memory.action)
        action, hidden = evaluated(policy(weights), observation, memory.hidden)
        speed = limited((action + 1) / 2, 0, 1)
        places = np.argsort(order).tolist()  # of the vehicle's rotors among the policy's
        u = limited(vehicle.thrust_max * speed[places] ** 2, vehicle.thrust_min, vehicle.thrust_max)
        return {"command": u, "hidden": hidden, "action": action}


@lru_cache(maxsize=1)
def policy(weights: str) -> Any:
    """The package's policy. weights: the hash of its content. Raises UsageError where the package is missing, or holds
    another kind of policy."""
    try:
        network = importlib.import_module("foundation_policy").Raptor()
    except ImportError:
        raise UsageError(
            'controller=raptor: needs the package foundation-policy: pip install "quadexp[controllers]"'
        ) from None
    kinds = [type(layer).__name__ for layer in network.layers]
    if kinds != ["DenseLayer", "GRULayer", "DenseLayer"]:
        raise UsageError(f"controller=raptor: foundation-policy has layers {', '.join(kinds)}; version 1.0 is needed")
    return network


def layout(vehicle: Vehicle) -> tuple[list[int], float]:
    """Which rotor is front right, back right, back left, front left of the policy's body, and how far that is turned
    about z_body from the vehicle's (rad).

    Raises UsageError for rotors that are no X, however turned.
    """
    if vehicle.n_rotors == 4:
        x, y, _ = np.array(vehicle.rotor_position, float).T
        angle = np.arctan2(y, x)
        spin = np.sign(vehicle.rotor_spin)
        for turn in np.radians([0.0, 45.0, -45.0, 90.0]):
            apart = np.abs((angle[None] - turn - PLACES[:, None] + np.pi) % (2 * np.pi) - np.pi)
            order = apart.argmin(axis=1)
            fits = apart.min(axis=1).max() < NEAR and sorted(order) == [0, 1, 2, 3]
            if fits and (spin[order] == SPINS).all():
                return order.tolist(), float(turn)
    raise UsageError(
        f"vehicle={vehicle.name}: controller=raptor flies four rotors in an X or a plus that turn alternately"
    )


def about_z(angle: Expression) -> Expression:
    """The rotation, (3, 3), by an angle (rad) about z."""
    c = ca.cos(angle)
    s = ca.sin(angle)
    return ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))


def evaluated(function: Any, observation: Expression, hidden: Expression) -> tuple[Expression, Expression]:
    """Action (4,) and next hidden state (16,) of the package's policy."""
    first, memory, last = function.layers
    seen = ca.fmax(_matrix(first.weights) @ observation + _matrix(first.biases), 0)
    of_hidden = _matrix(memory.weights_hidden) @ hidden + _matrix(memory.biases_hidden)
    of_input = _matrix(memory.weights_input) @ seen + _matrix(memory.biases_input)
    gates = 1 / (1 + ca.exp(-(of_hidden + of_input)[: 2 * HIDDEN]))
    reset = gates[:HIDDEN]
    keep = gates[HIDDEN:]
    new = ca.tanh(reset * of_hidden[2 * HIDDEN :] + of_input[2 * HIDDEN :])
    hidden = keep * hidden + (1 - keep) * new
    return _matrix(last.weights) @ hidden + _matrix(last.biases), hidden


def _matrix(values: np.ndarray) -> ca.DM:
    values = np.asarray(values, float)
    return ca.DM(values.ravel() if 1 in values.shape else values)
