"""The control step as CasADi functions: one Gauss-Newton SQP iteration per control step (real-time iteration).

    min  sum_{k<N} |x_k - x*_k|_{Q_k}^2 + |u_k - u*_k|_{R_k}^2  +  |x_N - x*_N|_{Q_end}^2
    s.t. x_{k+1} = F(x_k, u_k, theta, dt_k),   x_0 measured,   u_min <= u <= u_max

The last solution is shifted in time, the dynamics are linearised there, and the quadratic subproblem is solved without
bounds. Where no bound is violated that is the subproblem's solution; otherwise control.mpc.active_set continues from
the factorisation.

The iteration has two phases (Diehl, Bock and Schloeder 2005). `prepare` is what does not depend on the measured state:
the shift, the linearisation of the nodes 1 .. N - 1 and the backward Riccati pass over them. `feedback` linearises node
0 at the measured state and runs forwards. `Step` calls the two on the arrays from which the bounded subproblem goes on.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from quadexp.compile.backend import BufferedFunction, array_for
from quadexp.compile.symbolic import ca
from quadexp.control.mpc.attitude_error import AttitudeError, attitude_error_in, reference_frames
from quadexp.control.mpc.prediction import held_deviation
from quadexp.control.mpc.riccati import CompiledPasses, MatrixPasses, Passes
from quadexp.control.mpc.settings import SAMPLES
from quadexp.control.mpc.subproblem import (
    backward_pass,
    bounded_function,
    forward_pass,
    input_gradient,
    subproblem_sparsity,
)
from quadexp.models.residual import Residual
from quadexp.names import without
from quadexp.physics.expression import Expression, limited, named_function, named_symbols
from quadexp.physics.rigid_body import N_DISTURBANCE
from quadexp.physics.sensitivity import rk4_sensitivity_function
from quadexp.physics.state import ATTITUDE, N_STATE
from quadexp.physics.vehicle import Vehicle

LENGTH_MIN, LENGTH_MAX = 0.5, 2.0  # limits of a quaternion's length at a shooting node


class _Prepared(NamedTuple):
    """What feedback needs of the preparation; lists have an entry for each of the nodes 1 .. N - 1 unless said.

    x: states at the nodes 1 .. N; u, r: inputs and their gradients of all nodes; q of the nodes 1 .. N; cost: the cost
    to go from node 1; multiplier: of the dynamics into node 1; kkt: optimality residual of the nodes from 1 on; added:
    of node 0, empty where commands are held; frames: empty with the plain error of attitude.
    """

    x: list[Expression]
    u: list[Expression]
    A: list[Expression]
    B: list[Expression]
    b: list[Expression]
    q: list[Expression]
    r: list[Expression]
    K: list[Expression]
    k: list[Expression]
    factor: list[Expression]
    cost: list[Expression]
    multiplier: Expression
    kkt: Expression
    added: list[Expression]
    frames: list[Expression]


class _Step:
    """Symbols and expressions of a step; for the arguments see `step_functions`."""

    def __init__(
        self,
        vehicle: Vehicle,
        residual: Residual,
        nodes: int,
        attitude_error: str,
        *,
        scalar: bool,
        lag: bool,
        deviation: bool,
        disturbed: bool,
    ) -> None:
        if scalar and residual.to_compile is not None:
            residual = replace(residual, function=residual.to_compile)
        n, samples = vehicle.n_rotors, SAMPLES if deviation else 1
        m = N_STATE + n * lag
        self.nodes, self.attitude_error, self.deviation, self.samples = nodes, attitude_error, deviation, samples
        form = {"lag": lag, "added": deviation, "disturbed": disturbed}
        self.node = rk4_sensitivity_function(vehicle, residual, scalar=scalar, **form)
        self._kind = CompiledPasses if scalar else MatrixPasses
        self._passes: Passes | None = None
        shapes = {"X": (m, nodes + 1), "U": (n, nodes), "x0": m, "X_ref": (m, samples * nodes + 1)}
        shapes |= {"U_ref": (n, samples * nodes), "theta": residual.function.size1_in(1), "Q": (m, nodes)}
        shapes |= {"Q_end": m, "R": (n, nodes), "u_min": n, "u_max": n}
        shapes |= {"dt": nodes, "shift": nodes} | ({"tau": 1} if lag else {})
        shapes |= {"first_share": 1} if deviation else {}
        shapes |= {"disturbance": N_DISTURBANCE} if disturbed else {}
        self.given = named_symbols(ca.MX, shapes)
        self.disturbance = [self.given["disturbance"]] if disturbed else []
        self.time_constant = [self.given["tau"]] if lag else []
        self.X_ref = self.given["X_ref"][:, ::samples]

    def prepare(self) -> _Prepared:
        a, nodes = self.given, self.nodes
        X, U, along = a["X"], a["U"], a["shift"].T
        m, n = X.size1(), U.size1()
        moved = X[:, :nodes] + ca.repmat(along, m, 1) * (X[:, 1:] - X[:, :nodes])
        guard = _attitude_guard(m)
        x = [guard(x_k) for x_k in ca.horzsplit(ca.horzcat(moved[:, 1:], X[:, nodes]))]
        U_lin = ca.horzcat(U[:, :-1] + ca.repmat(along[:-1], n, 1) * (U[:, 1:] - U[:, :-1]), U[:, -1])
        u, U_ref = ca.horzsplit(U_lin), a["U_ref"]
        added: list[Expression] = []
        if self.deviation:
            arguments = (a[name] for name in ("U_ref", "u_min", "u_max", "dt", "first_share"))
            U_ref, added = held_deviation(*arguments, *self.time_constant)

        frames = reference_frames(self.X_ref, self.attitude_error)
        error, dt = attitude_error_in(*frames or [None]), ca.vertsplit(a["dt"])
        linear = [self._linearised(error, k, x[k - 1], u[k], x[k], dt[k], added[k : k + 1]) for k in range(1, nodes)]
        A, B, b = (list(parts) for parts in zip(*linear, strict=True))
        weights = [*ca.horzsplit(a["Q"])[1:], a["Q_end"]]
        errors = ca.horzsplit(ca.horzcat(*x) - self.X_ref[:, 1:])
        q = [Q_k * error.deviation(k + 1, d) for k, (Q_k, d) in enumerate(zip(weights, errors, strict=True))]
        R = ca.horzsplit(a["R"])
        r = [R_k * e for R_k, e in zip(R, ca.horzsplit(U_lin - U_ref), strict=True)]

        passes = self._passes_for(A, B)
        cost, K, k_gain, factor = backward_pass(passes, A, B, b, q, r[1:], weights[:-1], a["Q_end"], R[1:])
        multiplier, gradient = input_gradient(passes, A, B, q, r[1:])
        kkt = ca.fmax(ca.norm_inf(ca.vertcat(*b)), self._projected(u[1:], gradient))
        return _Prepared(x, u, A, B, b, q, r, K, k_gain, factor, cost, multiplier, kkt, added[:1], frames)

    def feedback(self, p: _Prepared) -> dict[str, Expression]:
        """What node 0 adds to the subproblem, and the answer: A, B, b, q and factor of node 0; X_new, U_new, checks."""
        a, nodes, x0 = self.given, self.nodes, self.given["x0"]
        error = attitude_error_in(*p.frames or [None])
        A_0, B_0, b_0 = self._linearised(error, 0, x0, p.u[0], p.x[0], a["dt"][0], p.added)
        Q_0, R_0 = a["Q"][:, 0], a["R"][:, 0]
        q_0 = Q_0 * error.deviation(0, x0 - self.X_ref[:, 0])
        passes = self._passes_for(p.A, p.B)
        k_0, factor_0 = passes.first_node(p.cost, A_0, B_0, b_0, q_0, p.r[0], Q_0, R_0)
        dX, dU = forward_pass(passes, B_0, b_0, k_0, p.A, p.B, p.b, p.K, p.k)
        X_new = ca.horzcat(x0, *(p.x[k] + error.change(k + 1, dX[k]) for k in range(nodes)))
        U_new = ca.horzcat(*(p.u[k] + dU[k] for k in range(nodes)))
        high, low = ca.repmat(a["u_max"], 1, nodes), ca.repmat(a["u_min"], 1, nodes)
        turn = ca.sqrt(ca.mmax(ca.sum1(ca.horzcat(*dX)[ATTITUDE, :] ** 2)))
        excess = ca.mmax(ca.fmax(U_new - high, low - U_new))
        _, gradient = passes.adjoint(p.multiplier, A_0, B_0, q_0, p.r[0])
        kkt = ca.fmax(p.kkt, ca.fmax(ca.norm_inf(b_0), self._projected(p.u[:1], [gradient])))
        results = {"X_new": X_new, "U_new": U_new, "checks": ca.vertcat(excess, turn, kkt)}
        return results | {"A": A_0, "B": B_0, "b": b_0, "q": q_0, "factor": factor_0}

    def _passes_for(self, A: list[Expression], B: list[Expression]) -> Passes:
        """Made once: all nodes have the same structural zeros."""
        self._passes = self._passes or self._kind.build(A[0].sparsity(), B[0].sparsity())
        return self._passes

    def _linearised(
        self,
        error: AttitudeError,
        k: int,
        x: Expression,
        u: Expression,
        x_next: Expression,
        dt: Expression,
        added: list[Expression],
    ) -> tuple[Expression, Expression, Expression]:
        """A, B and b of node k, linearised at x and u, in the cost's coordinates."""
        predicted, A, B = self.node(x, u, self.given["theta"], dt, *self.time_constant, *added, *self.disturbance)
        return error.linearisation(k, A, B, predicted - x_next)

    def _projected(self, u: list[Expression], gradient: list[Expression]) -> Expression:
        """The largest component of the projected gradient step."""
        low, high = self.given["u_min"], self.given["u_max"]
        steps = [u_k - limited(u_k - g, low, high) for u_k, g in zip(u, gradient, strict=True)]
        return ca.norm_inf(ca.vertcat(*steps))


def step_functions(
    vehicle: Vehicle,
    residual: Residual,
    nodes: int,
    *,
    attitude_error: str = "plain",
    scalar: bool = True,
    lag: bool = False,
    deviation: bool = False,
    disturbed: bool = False,
) -> list[ca.Function]:
    """`prepare` and `feedback` of one iteration for N = nodes, and with `scalar` the bounded subproblem, see `Step`.

    attitude_error: what Q weighs of the attitude, see control.mpc.attitude_error.
    scalar: the form to compile, otherwise the form that the virtual machine runs.
    lag: rotors lag behind their commands, and their thrusts are states: m = 13 + n of them; otherwise m = 13.
    deviation: nodes hold the deviation from the reference's thrust, see control.mpc.prediction.
    disturbed: the model has a disturbance, see physics.rigid_body: an input like the others, constant over the horizon.

    Inputs: X (m, N + 1), U (n, N) last solution; x0 (m,) measured; X_ref (m, s N + 1), U_ref (n, s N) the reference at
    s times in every node, s = 2 with `deviation`, otherwise 1; theta (p,) residual parameters; Q (m, N), Q_end (m,),
    R (n, N) weights; u_min, u_max (n,) N; dt (N,) node periods (s); shift (N,), the share of each node by which to
    move the last solution forward; with `lag` tau, the lag's time constant (s); with `deviation` first_share, the part
    of the first node for which its command is held; with `disturbed` disturbance (6,).
    Outputs: X_new, U_new; checks (3,): the largest bound violation (N), the largest change of a quaternion (length),
    and the optimality residual of the shifted guess (the largest of the gaps of the dynamics and of the projected
    gradient step in u); then the subproblem: A (m, m N), B (m, n N), b (m, N), q (m, N + 1), r (n, N), its
    factorisation K (n, m N), factor (n, n N), the linearisation point X_lin, U_lin, and frames, (4, 4 (N + 1)), where
    the subproblem is in the coordinates of "body".

    prepare has no x0, and of the subproblem leaves X_lin, q at the nodes 1 .. N, U_lin, r at all, the others at the
    nodes 1 .. N - 1; and k, cost_0 .., multiplier, kkt, added. All of these are inputs of feedback, `.._prepared`
    there, with what else it needs; it leaves X_new, U_new, checks, and of the subproblem node 0, but for K.
    """
    form = {"scalar": scalar, "lag": lag, "deviation": deviation, "disturbed": disturbed}
    step = _Step(vehicle, residual, nodes, attitude_error, **form)
    p = step.prepare()
    left = {"X_lin": ca.horzcat(*p.x), "U_lin": ca.horzcat(*p.u), "r": ca.horzcat(*p.r), "q": ca.horzcat(*p.q)}
    left |= {name: ca.horzcat(*getattr(p, name)) for name in ("A", "B", "b", "K", "factor", "k")}
    left |= {f"cost_{i}": part for i, part in enumerate(p.cost)} | {"multiplier": p.multiplier, "kkt": p.kkt}
    left |= {name: getattr(p, name)[0] for name in ("added", "frames") if getattr(p, name)}
    given = {name: value for name, value in step.given.items() if name != "x0"}
    prepare = named_function("mpc_prepare", given, left)

    known = {name: ca.MX.sym(name, value.sparsity()) for name, value in left.items()}
    width = {name: left[name].size2() // len(parts) for name, parts in (("A", p.A), ("B", p.B), ("K", p.K))}
    split = {name: ca.horzsplit(value, width.get(name, 1)) for name, value in known.items()}
    split["factor"] = ca.horzsplit(known["factor"], width["B"])
    prepared = _Prepared(
        x=split["X_lin"],
        u=split["U_lin"],
        **{name: split[name] for name in ("A", "B", "b", "q", "r", "K", "k", "factor")},
        cost=[known[f"cost_{i}"] for i in range(len(p.cost))],
        multiplier=known["multiplier"],
        kkt=known["kkt"],
        added=[known[name] for name in ("added",) if name in known],
        frames=[known[name] for name in ("frames",) if name in known],
    )
    answer = step.feedback(prepared) | {"X_lin": step.given["x0"]}
    unused = ("X", "U", "U_ref", "Q_end", "shift", "first_share")
    given = without(step.given, unused)
    # An input has another name than an output that goes to the same array.
    inputs = given | {f"{name}_prepared": value for name, value in known.items()}
    feedback = named_function("mpc_feedback", inputs, answer)
    return [prepare, feedback, bounded_function(prepare, feedback, nodes)] if scalar else [prepare, feedback]


def _attitude_guard(m: int) -> ca.Function:
    """State (m,) with its quaternion's length brought back between LENGTH_MIN and LENGTH_MAX.

    Integration alone leaves the length within half a percent of one; Newton steps far from the solution do not, and at
    a length of zero a quaternion is no attitude.
    """
    x = ca.SX.sym("x", m)
    length = ca.norm_2(x[ATTITUDE])
    scale = limited(length, LENGTH_MIN, LENGTH_MAX) / length
    return ca.Function("attitude_guard", [x], [ca.vertcat(x[:3], x[ATTITUDE] * scale, x[7:])])


class Step:
    """The control step: a call is `prepare`, then `feedback`, each a BufferedFunction that may be called by itself.

    arguments, results: of both, by name; see `step_functions`. sparsity: of the results that make the subproblem.
    """

    def __init__(self, prepare: ca.Function, feedback: ca.Function) -> None:
        self.sparsity = subproblem_sparsity(prepare, feedback)
        whole = {name: array_for(sparsity) for name, sparsity in self.sparsity.items()}
        behind = {name: array.ravel()[-prepare.nnz_out(name) :] for name, array in whole.items()}
        before = {name: whole[name].ravel()[: feedback.nnz_out(name)] for name in feedback.name_out() if name in whole}
        self.prepare = BufferedFunction(prepare, into=behind)
        known = {f"{name}_prepared": array for name, array in self.prepare.results.items()}
        self.feedback = BufferedFunction(feedback, self.prepare.arguments | known, before)
        self.arguments = {"x0": self.feedback.arguments["x0"]} | self.prepare.arguments
        self.results = whole | {name: self.feedback.results[name] for name in ("X_new", "U_new", "checks")}

    def __call__(self) -> None:
        self.prepare()
        self.feedback()
