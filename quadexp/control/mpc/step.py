"""The control step: one Gauss-Newton SQP iteration per control step (real-time iteration).

    min  sum_{k<N} |x_k - x*_k|_{Q_k}^2 + |u_k - u*_k|_{R_k}^2  +  |x_N - x*_N|_{Q_end}^2
    s.t. x_{k+1} = F(x_k, u_k, theta, dt_k),   x_0 measured,   u_min <= u <= u_max

The last solution is shifted in time, the dynamics are linearised there, and the quadratic subproblem is solved without
bounds. Where no bound is violated that is the subproblem's solution; otherwise control.mpc.active_set continues from
the factorisation.

The iteration has two phases (Diehl, Bock and Schloeder 2005). `prepare` is what does not depend on the measured state:
the shift, the linearisation of the nodes 1 .. N - 1 and the backward Riccati pass over them. `feedback` linearises node
0 at the measured state and runs forwards. Both are loops over the functions of one node (node.py): in C (stages.py), or
in CasADi's virtual machine (interpreted.py).
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from quadexp.control.mpc.node import N_PLACE, Form
from quadexp.physics.rigid_body import N_DISTURBANCE

ALIGNMENT = 64  # bytes: a vector register

Arrays = dict[str, np.ndarray]


class Stages(Protocol):
    """The functions of the step for a model, on a back end, for any number of nodes."""

    form: Form

    def on(self, arguments: Arrays, results: Arrays) -> list[Any]:
        """prepare, feedback and the solver of the bounded subproblem on these arrays; they take no arguments."""


class Step:
    """The control step on arrays of its own: a call is `prepare`, then `feedback`. bounded: see control.mpc.active_set.

    Arguments: X (N + 1, m), U (N, n) last solution; x0 (m,) measured; X_ref (s N + 1, m), U_ref (s N, n) the reference
    at s times in every node, s = 2 with `deviation`, otherwise 1; theta (p,) residual parameters; Q (N, m), Q_end (m,),
    R (N, n) weights; u_min, u_max (n,) N; dt (N,) node periods (s); shift (N,), the share of each node by which to move
    the last solution forward; with `lag` tau, the lag's time constant (s); with `deviation` first_share, the part of
    the first node for which its command is held; with `disturbed` disturbance (6,); guess (N, n): the expected active
    set, -1 at the lower, 1 at the upper bound, 0 free.

    Results: X_new, U_new; checks (3,): the largest bound violation (N), which is not a number where the answer is not
    finite, the largest change of a quaternion (length), and the optimality residual of the shifted guess (the largest
    of the gaps of the dynamics and of the projected gradient step in u); then the subproblem: rows (N, m, line), the
    dynamics, see `dynamics`; q (N + 1, m), r (N, n); its factorisation K (N, m, n), factor (N, n, n), both by columns;
    the linearisation point X_lin, U_lin; and frames, (N + 1, 4, 4) by columns, where the subproblem is in other
    coordinates than the state. Of the bounded subproblem: bounded_X, bounded_U; side (N, n), the active set;
    bounded_checks (5,): whether it is solved, exchanges of the active set, inputs at a bound, the estimated error of
    the inputs (N), the largest change of a quaternion (length). The others are what `prepare` leaves for `feedback`.
    """

    def __init__(self, stages: Stages, nodes: int) -> None:
        self.stages = stages
        self.form = stages.form
        self.arguments, self.results = (
            {name: aligned(shape) for name, shape in shapes.items()} for shapes in array_shapes(stages.form, nodes)
        )
        self.prepare, self.feedback, self.bounded = stages.on(self.arguments, self.results)

    def __call__(self) -> None:
        self.prepare()
        self.feedback()

    @property
    def dynamics(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A (N, m, m), B (N, m, n) and b (N, m) of the last step, in the cost's coordinates."""
        return dynamics_of(self.results["rows"], self.form)


def dynamics_of(rows: np.ndarray, form: Form) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A, B and b, see Step.dynamics, from rows (N, m, line)."""
    motion = form.states - N_PLACE
    n = form.inputs
    place = np.broadcast_to(np.eye(form.states, N_PLACE), (len(rows), form.states, N_PLACE))
    A = np.concatenate([place, rows[:, :, :motion]], axis=2)
    return A, rows[:, :, motion : motion + n], rows[:, :, motion + n]


def array_shapes(form: Form, nodes: int) -> list[dict[str, tuple[int, ...]]]:
    """Of all arguments and all results, in the order of stages.c; those that the form lacks are empty."""
    m = form.states
    n = form.inputs
    samples = form.samples
    states = (nodes + 1, m)
    inputs = (nodes, n)
    arguments: dict[str, tuple[int, ...]] = {
        "x0": (m,),
        "X": states,
        "U": inputs,
        "X_ref": (samples * nodes + 1, m),
        "U_ref": (samples * nodes, n),
    }
    arguments |= {
        "theta": (form.parameters,),
        "Q": (nodes, m),
        "Q_end": (m,),
        "R": inputs,
        "u_min": (n,),
        "u_max": (n,),
    }
    arguments |= {"dt": (nodes,), "shift": (nodes,), "tau": (int(form.lag),)}
    arguments |= {
        "first_share": (int(form.deviation),),
        "disturbance": (N_DISTURBANCE * form.disturbed,),
        "guess": inputs,
    }
    results: dict[str, tuple[int, ...]] = {
        "X_new": states,
        "U_new": inputs,
        "checks": (3,),
        "X_lin": states,
        "U_lin": inputs,
    }
    results |= {"rows": (nodes, m, form.line), "q": states, "r": inputs, "K": (nodes, m, n), "k": inputs}
    results |= {"factor": (nodes, n, n), "cost": (m * form.line + N_PLACE**2,), "multiplier": (m,), "kkt": (1,)}
    results |= {"added": (nodes, 3, n * form.deviation), "frames": (nodes + 1, 4, 4 * form.frames)}
    return [arguments, results | {"bounded_X": states, "bounded_U": inputs, "side": inputs, "bounded_checks": (5,)}]


def aligned(shape: tuple[int, ...]) -> np.ndarray:
    """Zeros that begin where a vector register does."""
    size = int(np.prod(shape))
    memory = np.zeros(size + ALIGNMENT // 8)
    first = -memory.ctypes.data % ALIGNMENT // 8
    return memory[first : first + size].reshape(shape)
