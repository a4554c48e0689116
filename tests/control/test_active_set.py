"""The subproblem's solution against an independent QP solver, with and without active bounds."""

from __future__ import annotations

import functools

import casadi as ca
import numpy as np
import pytest

from quadexp.backend import BufferedFunction, compiler, realise_together
from quadexp.control.active_set import ActiveSet, Status
from quadexp.control.settings import MPCSettings
from quadexp.control.step import step_function
from quadexp.control.subproblem import condensed_function, sweep_function
from tests.residual.models import make_residual
from tests.states import random_state

NODES = 8


@pytest.fixture(scope="module", params=["compiled", "interpreted"])
def solvers(request, vehicle):
    """The step, and what makes an ActiveSet that reads what it leaves behind."""
    return make_solvers(vehicle, request.param, "plain")


def make_solvers(vehicle, backend: str, attitude_error: str):
    if backend == "compiled" and compiler() is None:
        pytest.skip("no C compiler")
    residual = make_residual("linear_drag", vehicle)
    step = step_function(vehicle, residual, NODES, attitude_error=attitude_error, scalar=backend == "compiled")
    functions = [step, sweep_function(step, NODES), condensed_function(step, NODES)]
    step, *bounded = realise_together(functions, backend)
    step = BufferedFunction(step)
    return step, functools.partial(ActiveSet, *bounded, step.arguments | step.results)


def pose(step: BufferedFunction, vehicle, rng, *, spread: float, terminal: float) -> None:
    """A subproblem around hover with the reference `spread` away."""
    settings, a = MPCSettings(terminal_weight=terminal), step.arguments
    x = random_state(rng, speed=1.0, rate=0.5)
    x[:7] = np.r_[0, 0, 0, 1, 0, 0, 0] + 0.05 * rng.normal(size=7)
    x[7:] *= min(1.0, spread)
    a["X"][...] = x + 0.1 * spread * rng.normal(size=a["X"].shape)
    a["U"][...] = rng.uniform(1.5, 4, a["U"].shape)
    a["x0"][...], a["X_ref"][...] = x, x
    a["X_ref"][:, :3] += spread * rng.normal(size=3)
    a["U_ref"][...] = vehicle.hover_thrust
    a["theta"][...] = make_residual("linear_drag", vehicle).theta
    a["Q"][...], a["R"][...] = settings.state_weight(), settings.thrust_weight(vehicle)
    a["Q_end"][...] = terminal * settings.state_weight()
    a["u_min"][...], a["u_max"][...] = 0.0, 6.0
    a["dt"][...], a["shift"][...] = 0.1, 0.2


def blocks(step: BufferedFunction, name: str) -> np.ndarray:
    """A or B as (N, 13, columns) from the horizontally stacked, perhaps sparse, result."""
    stacked = ca.DM(step.function.sparsity_out(name), step.results[name].reshape(-1)).full()
    return np.stack(np.split(stacked, NODES, axis=1))


def independent_solution(step: BufferedFunction, low: np.ndarray, high: np.ndarray, turns=None) -> np.ndarray:
    """The same QP, states kept as variables, by qpOASES: no Riccati, no condensing, another solver.

    step: one in plain coordinates. turns: (N + 1, 13, 13), where the cost is on turns[k]' dx_k instead.
    """
    r, a = step.results, step.arguments
    A, B = (blocks(step, name) for name in ("A", "B"))
    n = B.shape[2]
    size = NODES * (13 + n)  # du_0, dx_1, du_1, dx_2, ...
    H, g, E, e = np.zeros((size, size)), np.zeros(size), np.zeros((13 * NODES, size)), np.zeros(13 * NODES)
    for k in range(NODES):
        at = k * (13 + n)
        u, x = slice(at, at + n), slice(at + n, at + n + 13)
        H[u, u], g[u] = np.diag(a["R"]), r["r"][k]
        H[x, x], g[x] = np.diag(a["Q_end"] if k == NODES - 1 else a["Q"]), r["q"][k + 1]
        if turns is not None:
            H[x, x] = turns[k + 1] @ H[x, x] @ turns[k + 1].T
            g[x] = H[x, x] @ (r["X_lin"][k + 1] - a["X_ref"][k + 1])
        rows = slice(13 * k, 13 * (k + 1))
        E[rows, x], E[rows, u], e[rows] = np.eye(13), -B[k], r["b"][k]
        if k:
            E[rows, slice(at - 13, at)] = -A[k]
    lower, upper = np.full(size, -1e3), np.full(size, 1e3)
    inputs = np.concatenate([np.arange(k * (13 + n), k * (13 + n) + n) for k in range(NODES)])
    lower[inputs], upper[inputs] = low.reshape(-1), high.reshape(-1)
    shape = {"h": ca.DM(H).sparsity(), "a": ca.DM(E).sparsity()}
    solver = ca.conic("check", "qpoases", shape, {"printLevel": "none", "error_on_fail": True})
    solution = solver(h=ca.DM(H), g=g, a=ca.DM(E), lba=e, uba=e, lbx=lower, ubx=upper)
    return np.array(solution["x"]).reshape(-1)[inputs].reshape(NODES, n)


def bounds(step: BufferedFunction) -> tuple[np.ndarray, np.ndarray]:
    """Of the inputs' change (N)."""
    u = step.results["U_lin"]
    return step.arguments["u_min"] - u, step.arguments["u_max"] - u


def error_turns(reference: np.ndarray) -> np.ndarray:
    """Matrices whose transposes take dx to the coordinates of attitude_error=body, column by column: q_ref o e_i."""
    turns = np.tile(np.eye(13), (len(reference), 1, 1))
    attitudes = reference[:, 3:7] / np.linalg.norm(reference[:, 3:7], axis=1)[:, None]
    for turn, (w, *v) in zip(turns, attitudes, strict=True):
        turn[3:7, 3] = w, *v
        for i, axis in enumerate(np.eye(3)):
            turn[3:7, 4 + i] = np.r_[-np.dot(v, axis), w * axis + np.cross(v, axis)]
    return turns


@pytest.mark.parametrize("backend", ["compiled", "interpreted"])
@pytest.mark.parametrize("wide", [True, False], ids=["no bounds active", "bounds active"])
def test_attitude_error_in_the_body_frame(vehicle, rng, backend, wide):
    """The QP in plain coordinates with the cost turned, by qpOASES; and the states move as the plain model says."""
    step, make_active_set = make_solvers(vehicle, backend, "body")
    plain, _ = make_solvers(vehicle, backend, "plain")
    active_set = make_active_set(max_sweeps=60)
    for _ in range(4):
        pose(step, vehicle, rng, spread=1.0 if wide else 3.0, terminal=1.5)
        step.arguments["X_ref"][:, 3:7] += 0.2 * rng.normal(size=(NODES + 1, 4))  # another attitude at every node
        step.arguments["Q"][3:7] = rng.uniform(0.0, 3.0, 4)
        if wide:
            step.arguments["u_min"][...], step.arguments["u_max"][...] = -100, 100
        for name, array in plain.arguments.items():
            array[...] = step.arguments[name]
        step()
        plain()
        turns, (low, high) = error_turns(plain.arguments["X_ref"]), bounds(plain)
        expected = independent_solution(plain, low, high, turns)
        d_state, d_input, status = active_set.solve(low, high)
        assert status == Status.ACTIVE_SET
        answers = [(d_state, d_input)]
        if wide:
            change = (step.results[f"{name}_new"] - step.results[f"{name}_lin"] for name in "XU")
            answers.append((next(change)[1:], next(change)))
        A, B, b = blocks(plain, "A"), blocks(plain, "B"), plain.results["b"]
        for d_x, d_u in answers:
            assert np.abs(d_u - expected).max() < 1e-6
            moved = np.einsum("kij,kj->ki", A[1:], d_x[:-1])
            forward = np.concatenate([np.zeros((1, 13)), moved]) + np.einsum("kij,kj->ki", B, d_u) + b
            assert np.allclose(d_x, forward, atol=1e-9)


@pytest.mark.parametrize("terminal", [0.0, 1.0])
def test_without_active_bounds(solvers, vehicle, rng, terminal):
    step, _ = solvers
    for _ in range(5):
        pose(step, vehicle, rng, spread=0.3, terminal=terminal)
        step.arguments["u_min"][...], step.arguments["u_max"][...] = -100, 100
        step()
        assert step.results["checks"][0] < 0
        low, high = bounds(step)
        change = step.results["U_new"] - step.results["U_lin"]
        assert np.abs(change - independent_solution(step, low, high)).max() < 1e-6


@pytest.mark.parametrize("spread", [1.0, 4.0])
def test_with_active_bounds(solvers, vehicle, rng, spread):
    step, make_active_set = solvers
    active_set, active = make_active_set(max_sweeps=60), 0
    for _ in range(12):
        pose(step, vehicle, rng, spread=spread, terminal=0.0)
        step()
        low, high = bounds(step)
        active_set.reset()
        d_state, d_input, status = active_set.solve(low, high)
        assert status in (Status.ACTIVE_SET, Status.LAST_RESORT)
        assert (d_input >= low - 1e-9).all() and (d_input <= high + 1e-9).all()
        assert np.abs(d_input - independent_solution(step, low, high)).max() < 1e-6
        active += np.count_nonzero(active_set.side)
    assert active > 20


def test_last_resort_gives_the_same_answer(solvers, vehicle, rng):
    step, make_active_set = solvers
    patient, hasty = make_active_set(max_sweeps=60), make_active_set(max_sweeps=0)
    for _ in range(8):
        pose(step, vehicle, rng, spread=3.0, terminal=0.0)
        step()
        low, high = bounds(step)
        patient.reset()
        d_state, d_input, status = (
            part if isinstance(part, Status) else part.copy() for part in patient.solve(low, high)
        )
        assert status == Status.ACTIVE_SET
        last_state, last_input, status = hasty.solve(low, high)
        assert status == Status.LAST_RESORT
        assert np.allclose(last_input, d_input, atol=1e-6)
        assert np.allclose(last_state, d_state, atol=1e-6)
        assert np.array_equal(hasty.side, patient.side)


def test_a_solver_that_errs_is_not_believed(solvers, vehicle, rng):
    """DAQP's answer with one thrust moved by a millinewton: within its bounds, but not where the gradient leads."""
    step, make_active_set = solvers
    hasty = make_active_set(max_sweeps=0)
    pose(step, vehicle, rng, spread=3.0, terminal=0.0)
    step()
    low, high = bounds(step)
    assert hasty.solve(low, high)[2] == Status.LAST_RESORT
    solver, inside = hasty._daqp, int(np.argmin(np.abs(hasty.side.ravel())))

    class Erring:
        arguments, results = solver.arguments, solver.results

        def __call__(self):
            solver()
            self.results["x"][inside] += 1e-3

    hasty._daqp = Erring()
    assert hasty.solve(low, high)[2] == Status.FAILED
    assert np.all(hasty.side == 0)


def test_warm_start_needs_one_sweep(solvers, vehicle, rng):
    step, make_active_set = solvers
    active_set = make_active_set(max_sweeps=60)
    pose(step, vehicle, rng, spread=3.0, terminal=0.0)
    step()
    low, high = bounds(step)
    active_set.solve(low, high)
    active_set.solve(low, high)
    assert active_set.sweeps == 1


def test_condensing_is_the_recursion(solvers, vehicle, rng):
    """H and g are the derivatives of the cost of a forward simulation, here in plain numpy."""
    step, _ = solvers
    pose(step, vehicle, rng, spread=3.0, terminal=1.5)
    step()
    data = step.arguments | step.results
    condensed = BufferedFunction(condensed_function(step.function, NODES), data)
    condensed()
    H, g = condensed.results["H"], condensed.results["g"]
    A, B = (blocks(step, name) for name in ("A", "B"))

    def cost(d):
        d, x, value = d.reshape(NODES, -1), np.zeros(13), 0.0
        for k in range(NODES):
            value += d[k] @ (data["R"] * d[k]) / 2 + data["r"][k] @ d[k]
            x = A[k] @ x + B[k] @ d[k] + data["b"][k]
            value += x @ (data["Q_end" if k == NODES - 1 else "Q"] * x) / 2 + data["q"][k + 1] @ x
        return value

    zero, d = np.zeros(len(g)), rng.normal(size=len(g))
    assert np.allclose(H, H.T, rtol=1e-12, atol=1e-12)
    assert cost(d) - cost(zero) == pytest.approx(d @ H @ d / 2 + g @ d, rel=1e-9)
