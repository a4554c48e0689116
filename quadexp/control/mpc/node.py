"""The functions of one node of the control step, from which both of its forms are made.

`linearise` is common to both: the dynamics of a node as the rows of riccati_backward.c. `held` and `frame` are for
stages.c, the others for CasADi's virtual machine (interpreted.py); each has the other's equations. What functions of
the virtual machine take and leave is named as in step.py, with `_next` behind it where it is of the next node.

The Gauss-Newton subproblem in deviations (dx, du) from the linearisation point is

    min sum_k 1/2 dx'Q dx + q'dx + 1/2 du'R du + r'du,     dx_{k+1} = A_k dx_k + B_k du_k + b_k,     dx_0 = 0

With the cost to go 1/2 dx'P dx + p'dx of the next node and H = R + B'PB, G = B'PA, h = r + B'(Pb + p):

    K = H^-1 G,   k = H^-1 h,   P <- Q + A'PA - G'K,   p <- q + A'(Pb + p) - G'k,   du = -k - K dx

The factor of a node is that of H = L D L', with L below the diagonal and D^-1 on it. A's first columns are [I; 0], as
nothing depends on the position; M = [A B b] without them, (m, m - 3 + n + 1), is what the rows contain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from quadexp.compile.symbolic import ca
from quadexp.control.mpc.attitude_error import attitude_error_in, reference_frames
from quadexp.control.mpc.prediction import held_thrust
from quadexp.control.mpc.settings import SAMPLES
from quadexp.models.residual import Residual
from quadexp.names import named
from quadexp.physics.expression import Expression, dense_function, limited, named_symbols, symbols
from quadexp.physics.rigid_body import N_DISTURBANCE
from quadexp.physics.scalars import as_scalars
from quadexp.physics.sensitivity import rk4_sensitivity_function
from quadexp.physics.state import ATTITUDE, N_STATE
from quadexp.physics.vehicle import Vehicle

N_PLACE = 3  # first states, the position
LENGTH_MIN = 0.5  # of a quaternion at a shooting node
LENGTH_MAX = 2.0  # of it; both keep q away from 0 and from overflow


@dataclass(frozen=True)
class Form:
    """What decides the structure of the step, besides the model.

    inputs: n. parameters: p of the model. attitude_error: what Q weighs of it, see control.mpc.attitude_error.
    lag: rotors lag behind their commands, and their thrusts are states: m = 13 + n of them; otherwise m = 13.
    deviation: nodes hold the deviation from the reference's thrust, see control.mpc.prediction.
    disturbed: the model has a disturbance, see physics.rigid_body: an input like the others, constant over the horizon.
    width: numbers of which a row is a multiple; 1 for processors without vector registers.
    """

    inputs: int
    parameters: int
    attitude_error: str = "plain"
    lag: bool = False
    deviation: bool = False
    disturbed: bool = False
    width: int = 8

    @property
    def states(self) -> int:
        """M."""
        return N_STATE + self.inputs * self.lag

    @property
    def samples(self) -> int:
        """Of the reference in a node."""
        return SAMPLES if self.deviation else 1

    @property
    def frames(self) -> bool:
        """Whether the subproblem is in other coordinates of the attitude than the state."""
        return self.attitude_error != "plain"

    @property
    def line(self) -> int:
        """Length of a row: states without position, inputs, the affine column, padding."""
        return self.width * ((self.states - N_PLACE + self.inputs) // self.width + 1)


def linearise_function(vehicle: Vehicle, residual: Residual, form: Form, *, scalar: bool) -> ca.Function:
    """(X_lin, U_lin, theta, dt, X_lin_next, then tau, added, disturbance, frames, frames_next) -> rows.

    Those that the form does not have are empty. rows: (line, m), a row in each column. scalar: the form to
    compile, see `rk4_sensitivity_function`.
    """
    if scalar and residual.to_compile is not None:
        residual = replace(residual, function=residual.to_compile)
    structure = {"lag": form.lag, "added": form.deviation, "disturbed": form.disturbed}
    node = rk4_sensitivity_function(vehicle, residual, scalar=scalar, **structure)
    m = form.states
    n = form.inputs
    frame = (4, 4 * form.frames)
    shapes = {"X_lin": (m, 1), "U_lin": (n, 1), "theta": (form.parameters, 1), "dt": (1, 1), "X_lin_next": (m, 1)}
    shapes |= {"tau": (form.lag, 1), "added": (n, 3 * form.deviation)}
    shapes |= {"disturbance": (N_DISTURBANCE * form.disturbed, 1)}
    a = named_symbols(ca.SX if node.is_a("SXFunction") else ca.MX, shapes | {"frames": frame, "frames_next": frame})
    arguments = {"x": a["X_lin"], "u": a["U_lin"]} | a
    predicted, A, B = node(*(arguments[name] for name in node.name_in()))
    error = attitude_error_in(ca.horzcat(a["frames"], a["frames_next"]) if form.frames else None)
    dynamics = error.linearisation(0, A, B, predicted - a["X_lin_next"])
    padding = form.line - (m - N_PLACE + n + 1)

    def rows(A: Expression, B: Expression, b: Expression) -> Expression:
        return ca.densify(ca.vertcat(A[:, N_PLACE:].T, B.T, b.T, ca.SX(padding, m)))

    return dense_function("linearise", a, {"rows": as_scalars(rows)(*dynamics)})


def held_function(form: Form) -> ca.Function:
    """(start, middle, end, dt, share, u_min, u_max, with a lag tau) -> reference u* (n,), added (n, 3), see
    prediction.held_thrust."""
    n = form.inputs
    names = ("start", "middle", "end", "dt", "share", "u_min", "u_max", *(["tau"] if form.lag else []))
    a = named_symbols(ca.SX, {name: 1 if name in ("dt", "share", "tau") else n for name in names})
    return dense_function("held", a, named(("reference", "added"), held_thrust(*a.values())))


def frame_function(form: Form) -> ca.Function:
    """(x_ref (m,)) -> frame (4, 4) of the attitude's error, see control.mpc.attitude_error."""
    x = ca.SX.sym("x_ref", form.states)
    return ca.Function("frame", [x], reference_frames(x, form.attitude_error), ["x_ref"], ["frame"])


def start_function(form: Form) -> ca.Function:
    """Of node 0: (x0, X_ref, Q, frames) -> q, the gradient of its cost."""
    m = form.states
    a = named_symbols(ca.SX, {"x0": m, "X_ref": m, "Q": m, "frames": (4, 4 * form.frames)})
    error = attitude_error_in(a["frames"] if form.frames else None)
    return dense_function("start", a, {"q": a["Q"] * error.deviation(0, a["x0"] - a["X_ref"])})


def backward_function(form: Form) -> ca.Function:
    """One node of the backward pass. P, p: of the cost to go. multiplier: of the dynamics into a node. kkt: the largest
    of the gaps of the dynamics and of the projected gradient step in u, from a node on."""
    m = form.states
    n = form.inputs
    affine = form.states - N_PLACE + form.inputs
    shapes = {"P_next": (m, m), "p_next": m, "multiplier_next": m, "kkt_next": 1, "rows": (form.line, m), "q": m}
    a = named_symbols(ca.MX, shapes | {"r": n, "Q": m, "R": n, "U_lin": n, "u_min": n, "u_max": n})
    P = a["P_next"]
    p = a["p_next"]
    multiplier = a["multiplier_next"]
    q = a["q"]
    r = a["r"]
    M = a["rows"][: affine + 1, :]
    place = slice(0, N_PLACE)
    motion = slice(0, m - N_PLACE)
    u = slice(m - N_PLACE, affine)
    W = M @ P  # its first columns belong to the position
    S = W @ M.T
    slope = M @ ca.horzcat(p, multiplier)
    G = ca.horzcat(W[u, place], S[u, motion])
    K, k, factor = _solve_function(n, m)(S[u, u] + ca.diag(a["R"]), G, r + S[u, affine] + slope[u, 0])
    mixed = W[motion, place]
    curvature = ca.blockcat([[P[place, place], mixed.T], [mixed, S[motion, motion]]])
    gradient = ca.vertcat(p[place] + W[affine, place].T, S[motion, affine] + slope[motion, 0])
    gap = M[affine, :]
    step = a["U_lin"] - limited(a["U_lin"] - r - slope[u, 1], a["u_min"], a["u_max"])
    results = {"P": curvature - G.T @ K + ca.diag(a["Q"]), "p": q + gradient - G.T @ k}
    results |= {"multiplier": q + ca.vertcat(multiplier[place], slope[motion, 1])}
    results |= {"kkt": ca.fmax(a["kkt_next"], ca.fmax(ca.norm_inf(gap), ca.norm_inf(step)))}
    return dense_function("backward", a, results | {"K": K, "k": k, "factor": factor})


def forward_function(form: Form) -> ca.Function:
    """One node of the forward pass. dX: change of the state in the cost's coordinates. extremes (2,): the largest bound
    violation (N) and change of a quaternion (length) before a node."""
    m = form.states
    n = form.inputs
    shapes = {"dX": m, "extremes": 2, "rows": (form.line, m), "K": (n, m), "k": n, "U_lin": n, "u_min": n, "u_max": n}
    a = named_symbols(ca.MX, shapes | {"X_lin_next": m, "frames_next": (4, 4 * form.frames)})
    du = -a["k"] - a["K"] @ a["dX"]
    padding = ca.MX(form.line - (m - N_PLACE + n + 1), 1)
    dx = a["rows"].T @ ca.vertcat(a["dX"][N_PLACE:], du, 1, padding)
    dx += ca.vertcat(a["dX"][:N_PLACE], ca.MX(m - N_PLACE, 1))
    u_new = a["U_lin"] + du
    error = attitude_error_in(a["frames_next"] if form.frames else None)
    excess = ca.mmax(ca.vertcat(a["extremes"][0], u_new - a["u_max"], a["u_min"] - u_new))
    extremes = ca.vertcat(excess, ca.fmax(a["extremes"][1], ca.norm_2(dx[ATTITUDE])))
    moved = {"X_new_next": a["X_lin_next"] + error.change(0, dx), "U_new": u_new}
    return dense_function("forward", a, {"dX_next": dx, "extremes_next": extremes} | moved)


def _solve_function(n: int, m: int) -> ca.Function:
    """(H, G, h) -> K = H^-1 G, k = H^-1 h, factor by an unrolled LDL' factorisation; H's upper triangle is read."""
    H, G, h = symbols(ca.SX, H=(n, n), G=(n, m), h=n)
    D, LT, order = ca.ldl(ca.triu2symm(ca.triu(H)), False)
    gains = ca.ldl_solve(ca.horzcat(G, h), D, LT, order)
    factor = ca.densify(LT.T + ca.diag(1 / D))
    return ca.Function("solve", [H, G, h], ca.cse([gains[:, :m], gains[:, m], factor]))
