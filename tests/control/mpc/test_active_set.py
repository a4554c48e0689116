"""The subproblem's solution against an independent QP solver, with and without active bounds, on both back ends."""

import casadi as ca
import numpy as np
import pytest

from benchmarks.step import make_residual as benchmark_residual
from benchmarks.stress import SITUATIONS, pinched, stress_vehicle
from quadexp.compile.backend import compiler
from quadexp.control.mpc.active_set import ActiveSet, InterpretedSolver, Status
from quadexp.control.mpc.mpc import ModelPredictiveController, stages_of
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.mpc.step import Step
from tests.models.residuals import make_residual
from tests.states import random_state, with_rotor_count

NODES = 8
EXACT = 1e-8  # N, from qpOASES


@pytest.fixture(scope="module", params=["compiled", "interpreted"])
def solvers(request, vehicle):
    """The step, and the solver that reads what it leaves behind."""
    return make_solvers(vehicle, request.param, "plain")


def make_solvers(vehicle, backend: str, attitude_error: str, nodes: int = NODES) -> tuple[Step, ActiveSet]:
    if backend == "compiled" and compiler() is None:
        pytest.skip("no C compiler")
    residual = make_residual("linear_drag", vehicle)
    step = Step(stages_of(vehicle, residual, backend, attitude_error=attitude_error), nodes)
    return step, ActiveSet(step)


def change(step: Step, active_set: ActiveSet) -> tuple[np.ndarray, np.ndarray]:
    """dX (N, 13), dU (N, n) of the last solve."""
    return active_set.X_new[1:] - step.results["X_lin"][1:], active_set.U_new - step.results["U_lin"]


def pose(step: Step, vehicle, rng, *, spread: float, terminal: float) -> None:
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
    share = rng.uniform(0.2, 2.0, (len(a["U"]), 1))
    a["Q"][...], a["R"][...] = share * settings.state_weight(), share * settings.thrust_weight(vehicle)
    a["Q_end"][...] = terminal * settings.state_weight()
    a["u_min"][...], a["u_max"][...] = 0.0, 6.0
    a["dt"][...], a["shift"][...] = 0.1, 0.2


def independent_solution(step: Step, low: np.ndarray, high: np.ndarray, turns=None) -> np.ndarray:
    """The same QP, states kept as variables, by qpOASES: no Riccati, no condensing, another solver.

    step: one in plain coordinates. turns: (N + 1, 13, 13), where the cost is on turns[k]' dx_k instead.
    """
    r, a = step.results, step.arguments
    A, B, b = step.dynamics
    n = B.shape[2]
    size = NODES * (13 + n)  # du_0, dx_1, du_1, dx_2, ...
    H, g, E, e = np.zeros((size, size)), np.zeros(size), np.zeros((13 * NODES, size)), np.zeros(13 * NODES)
    for k in range(NODES):
        at = k * (13 + n)
        u, x = slice(at, at + n), slice(at + n, at + n + 13)
        H[u, u], g[u] = np.diag(a["R"][k]), r["r"][k]
        H[x, x], g[x] = np.diag(a["Q_end"] if k == NODES - 1 else a["Q"][k + 1]), r["q"][k + 1]
        if turns is not None:
            H[x, x] = turns[k + 1] @ H[x, x] @ turns[k + 1].T
            g[x] = H[x, x] @ (r["X_lin"][k + 1] - a["X_ref"][k + 1])
        rows = slice(13 * k, 13 * (k + 1))
        E[rows, x], E[rows, u], e[rows] = np.eye(13), -B[k], b[k]
        if k:
            E[rows, slice(at - 13, at)] = -A[k]
    lower, upper = np.full(size, -1e3), np.full(size, 1e3)
    inputs = np.concatenate([np.arange(k * (13 + n), k * (13 + n) + n) for k in range(NODES)])
    lower[inputs], upper[inputs] = low.reshape(-1), high.reshape(-1)
    shape = {"h": ca.DM(H).sparsity(), "a": ca.DM(E).sparsity()}
    solver = ca.conic("check", "qpoases", shape, {"printLevel": "none", "error_on_fail": True})
    solution = solver(h=ca.DM(H), g=g, a=ca.DM(E), lba=e, uba=e, lbx=lower, ubx=upper)
    return np.array(solution["x"]).reshape(-1)[inputs].reshape(NODES, n)


def bounds(step: Step) -> tuple[np.ndarray, np.ndarray]:
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


def condensed(step: Step) -> tuple[np.ndarray, np.ndarray]:
    """H, g of min 1/2 d'H d + g'd over all inputs' changes, by a forward simulation of each."""
    data, (A, B, b) = step.arguments | step.results, step.dynamics
    nodes, n = data["U_lin"].shape
    maps, offset = np.zeros((13, nodes * n)), np.zeros(13)
    H, g = np.diag(data["R"].ravel()), data["r"].ravel().copy()
    for k in range(nodes):
        maps, offset = A[k] @ maps, A[k] @ offset + b[k]
        maps[:, k * n : (k + 1) * n] = B[k]
        weight = data["Q_end"] if k == nodes - 1 else data["Q"][k + 1]
        H += maps.T @ (weight[:, None] * maps)
        g += maps.T @ (weight * offset + data["q"][k + 1])
    return H, g


class Dense:
    """qpOASES on a dense problem with simple bounds."""

    def __init__(self, size: int) -> None:
        shape = {"h": ca.Sparsity.dense(size, size), "a": ca.Sparsity(0, size)}
        self._solver = ca.conic("dense", "qpoases", shape, {"printLevel": "none", "error_on_fail": True, "nWSR": 5000})

    def __call__(self, H: np.ndarray, g: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return self._solver(h=H, g=g, lbx=low.ravel(), ubx=high.ravel())["x"].full().reshape(low.shape)


@pytest.mark.parametrize("backend", ["compiled", "interpreted"])
@pytest.mark.parametrize("wide", [True, False], ids=["no bounds active", "bounds active"])
def test_attitude_error_in_the_body_frame(vehicle, rng, backend, wide):
    """The QP in plain coordinates with the cost turned, by qpOASES; and the states move as the plain model says."""
    step, active_set = make_solvers(vehicle, backend, "body")
    plain, _ = make_solvers(vehicle, backend, "plain")
    for _ in range(4):
        pose(step, vehicle, rng, spread=1.0 if wide else 3.0, terminal=1.5)
        step.arguments["X_ref"][:, 3:7] += 0.2 * rng.normal(size=(NODES + 1, 4))  # another attitude at every node
        step.arguments["Q"][:, 3:7] = rng.uniform(0.0, 3.0, 4)
        if wide:
            step.arguments["u_min"][...], step.arguments["u_max"][...] = -100, 100
        for name, array in plain.arguments.items():
            array[...] = step.arguments[name]
        step()
        plain()
        turns, (low, high) = error_turns(plain.arguments["X_ref"]), bounds(plain)
        expected = independent_solution(plain, low, high, turns)
        assert active_set.solve() == Status.ACTIVE_SET
        answers = [change(step, active_set)]
        assert active_set.turn == pytest.approx(np.linalg.norm(answers[0][0][:, 3:7], axis=1).max())
        if wide:
            alone = (step.results[f"{name}_new"] - step.results[f"{name}_lin"] for name in "XU")
            answers.append((next(alone)[1:], next(alone)))
        A, B, b = plain.dynamics
        for d_x, d_u in answers:
            assert np.abs(d_u - expected).max() < EXACT
            moved = np.einsum("kij,kj->ki", A[1:], d_x[:-1])
            forward = np.concatenate([np.zeros((1, 13)), moved]) + np.einsum("kij,kj->ki", B, d_u) + b
            assert np.allclose(d_x, forward, atol=1e-9)


@pytest.mark.parametrize("terminal", [0.0, 1.0])
def test_without_active_bounds(solvers, vehicle, rng, terminal):
    step, active_set = solvers
    for _ in range(5):
        pose(step, vehicle, rng, spread=0.3, terminal=terminal)
        step.arguments["u_min"][...], step.arguments["u_max"][...] = -100, 100
        step()
        assert step.results["checks"][0] < 0
        expected = independent_solution(step, *bounds(step))
        active_set.reset()
        assert active_set.solve() == Status.ACTIVE_SET and active_set.active == active_set.exchanges == 0
        for d_input in (step.results["U_new"] - step.results["U_lin"], change(step, active_set)[1]):
            assert np.abs(d_input - expected).max() < EXACT


@pytest.mark.parametrize("spread", [1.0, 4.0])
@pytest.mark.parametrize("terminal", [0.0, 2.0])
def test_with_active_bounds(solvers, vehicle, rng, spread, terminal):
    step, active_set = solvers
    active = 0
    for i in range(6):
        pose(step, vehicle, rng, spread=spread, terminal=terminal)
        step()
        low, high = bounds(step)
        if i % 2:
            active_set.reset()
        assert active_set.solve() == Status.ACTIVE_SET
        d_state, d_input = change(step, active_set)
        u_min, u_max = step.arguments["u_min"], step.arguments["u_max"]
        assert (active_set.U_new >= u_min).all() and (active_set.U_new <= u_max).all()
        assert np.abs(d_input - independent_solution(step, low, high)).max() < EXACT
        assert np.array_equal(active_set.side, (d_input >= high - 1e-9).astype(int) - (d_input <= low + 1e-9))
        assert active_set.active == np.count_nonzero(active_set.side)
        (A, B, b), d = step.dynamics, np.zeros(13)
        for k in range(NODES):
            d = A[k] @ d + B[k] @ d_input[k] + b[k]
            assert np.allclose(d_state[k], d, atol=1e-8)
        active += active_set.active
    assert active > 10


@pytest.mark.parametrize(
    ("backend", "rotors", "nodes"),
    [("interpreted", 4, 2), ("compiled", 5, 9), ("interpreted", 6, 7), ("compiled", 8, 5)],
)
def test_any_number_of_rotors_and_nodes(vehicle, rng, backend, rotors, nodes):
    """Bounds of their own for every rotor, one of them with no room at all and one without an upper bound."""
    vehicle = with_rotor_count(vehicle, rotors)
    step, active_set = make_solvers(vehicle, backend, "plain", nodes)
    dense, active = Dense(nodes * rotors), 0
    for _ in range(8):
        pose(step, vehicle, rng, spread=3.0, terminal=1.0)
        step.arguments["U"][:, 0] = step.arguments["u_min"][0] = step.arguments["u_max"][0] = 2.0
        step.arguments["u_min"][1], step.arguments["u_max"][1] = 1.0, np.inf
        step()
        low, high = bounds(step)
        assert active_set.solve() == Status.ACTIVE_SET
        d_input = change(step, active_set)[1]
        assert np.abs(d_input - dense(*condensed(step), low, np.minimum(high, 1e4))).max() < EXACT
        assert np.all(active_set.U_new[:, 0] == 2.0) and np.all(active_set.side[:, 0] != 0)
        active += active_set.active
    assert active > 8 * nodes


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
def test_back_ends_find_the_same(vehicle, rng):
    """From cold and from the last set, the same sides and inputs."""
    (step, active_set), (other_step, other) = (
        make_solvers(vehicle, backend, "plain") for backend in ("compiled", "interpreted")
    )
    exchanges = 0
    for i in range(30):
        pose(step, vehicle, rng, spread=4.0, terminal=float(i % 2))
        for name, array in other_step.arguments.items():
            array[...] = step.arguments[name]
        step()
        other_step()
        if i % 3 == 0:
            active_set.reset()
            other.reset()
        assert active_set.solve() == other.solve() == Status.ACTIVE_SET
        assert active_set.active == other.active
        assert np.array_equal(active_set.side, other.side)
        assert active_set.U_new == pytest.approx(other.U_new, abs=1e-9)
        assert active_set.X_new == pytest.approx(other.X_new, abs=1e-8)
        assert active_set.turn == pytest.approx(other.turn, rel=1e-6)
        exchanges += active_set.exchanges
    assert exchanges > 500


def test_a_box_of_zero_width_is_flown(solvers, vehicle, rng):
    step, active_set = solvers
    pose(step, vehicle, rng, spread=3.0, terminal=0.0)
    step.arguments["U"][...] = step.arguments["u_min"][...] = step.arguments["u_max"][...] = 3.0
    step()
    assert active_set.solve() == Status.ACTIVE_SET
    assert np.all(active_set.U_new == 3.0) and active_set.active == active_set.side.size


def test_bounds_that_only_just_touch(solvers, vehicle, rng):
    """Degenerate: every second input's bound lies exactly where the minimum without bounds is."""
    step, active_set = solvers
    for _ in range(4):
        pose(step, vehicle, rng, spread=3.0, terminal=0.0)
        step.arguments["u_min"][...], step.arguments["u_max"][...] = -1e3, 1e3
        step()
        best = step.results["U_new"].copy()
        step.arguments["u_max"][...] = best.max(axis=0)
        step.arguments["u_min"][...] = best.min(axis=0)
        assert active_set.solve() == Status.ACTIVE_SET
        assert np.abs(active_set.U_new - best).max() < EXACT


def test_warm_start_exchanges_nothing_else(solvers, vehicle, rng):
    """Started from the answer, only what is at a bound is put there; started from the opposite, the answer is found."""
    step, active_set = solvers
    pose(step, vehicle, rng, spread=3.0, terminal=0.0)
    step()
    active_set.reset()
    assert active_set.solve() == Status.ACTIVE_SET
    U, side, cold = active_set.U_new.copy(), active_set.side.copy(), active_set.exchanges
    assert active_set.solve() == Status.ACTIVE_SET
    if not isinstance(step.bounded, InterpretedSolver):
        assert active_set.exchanges == active_set.active == np.count_nonzero(side) <= cold
    assert np.abs(active_set.U_new - U).max() < EXACT
    for guess in (-side, np.ones_like(side), -np.ones_like(side), rng.integers(-1, 2, side.shape)):
        active_set.side[...] = guess
        assert active_set.solve() == Status.ACTIVE_SET
        assert np.array_equal(active_set.side, side) and np.abs(active_set.U_new - U).max() < EXACT


def spoil(step: Step, name: str, rng: np.random.Generator, value: float) -> None:
    """One number of a result, or of a part of its dynamics, in the horizon's second half."""
    columns = {"A": range(10), "B": range(10, 14), "b": range(14, 15)}
    if name in columns:
        step.results["rows"][rng.integers(NODES // 2, NODES), rng.integers(13), rng.choice(columns[name])] = value
    elif name == "factor":
        step.results[name].flat[-1] = value  # its upper half is not read
    else:
        numbers = step.results[name].reshape(-1)
        numbers[rng.integers(numbers.size // 2, numbers.size)] = value


@pytest.mark.parametrize("name", ["A", "B", "b", "q", "r", "K", "factor", "U_new"])
def test_a_number_that_is_none_fails_by_name(solvers, vehicle, rng, name):
    """And leaves no trace: the next step is solved as if it had not been."""
    step, active_set = solvers
    pose(step, vehicle, rng, spread=3.0, terminal=1.0)
    step()
    active_set.reset()
    assert active_set.solve() == Status.ACTIVE_SET
    U = active_set.U_new.copy()
    for value in (np.nan, np.inf):
        step()
        spoil(step, name, rng, value)
        assert active_set.solve() == Status.FAILED
        assert np.all(active_set.side == 0)
        step()
        assert active_set.solve() == Status.ACTIVE_SET
        assert np.array_equal(active_set.U_new, U)


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
def test_a_wrong_factorisation_is_not_believed(vehicle, rng):
    """Gains that are wrong by a little are mended by the true gradient; by much, they end in a failure by name."""
    step, active_set = make_solvers(vehicle, "compiled", "plain")
    ends = set()
    for size in (1e-6, 1e-4, 1e-2, 1.0, 100.0):
        for _ in range(2):
            pose(step, vehicle, rng, spread=3.0, terminal=1.0)
            step()
            expected = independent_solution(step, *bounds(step))
            step.results["K"] *= 1 + size * rng.normal(size=step.results["K"].shape)
            status = active_set.solve()
            ends.add((size, status))
            if status != Status.FAILED:
                assert np.abs(change(step, active_set)[1] - expected).max() < 1e-6
    assert (1e-6, Status.ACTIVE_SET) in ends and (100.0, Status.FAILED) in ends


def hostile(model: str, nodes: int, backend: str, trials: int, seed: int) -> tuple[int, float]:
    """Steps through the situations of benchmarks.stress against qpOASES: how many were compared, and the worst (N)."""
    controllers = [
        ModelPredictiveController(v, benchmark_residual(model, v)[0], MPCSettings(nodes=nodes), backend=backend)
        for v in (stress_vehicle(), pinched(stress_vehicle()))
    ]
    names = [name for name in SITUATIONS if not name.startswith("broken")]
    rng, dense, compared, worst = np.random.default_rng(seed), Dense(4 * nodes), 0, 0.0
    for trial in range(trials):
        controller = controllers[trial % 2]
        make, step = SITUATIONS[names[rng.integers(len(names))]], controller.step
        window = make(rng, controller.vehicle, nodes)
        controller.reset(*window)
        controller._cold = False
        for _ in range(4):  # the later ones with the active set of another situation
            u, record = controller.command(*window)
            if record.status == Status.FAILED:
                break
            if record.status == Status.ACTIVE_SET:
                expected = dense(*condensed(step), *bounds(step))
                worst = max(worst, np.abs(change(step, controller._active_set)[1] - expected).max())
                compared += 1
            window = make(rng, controller.vehicle, nodes)
    return compared, worst


MANY = [pytest.param("compiled", model, 400, marks=pytest.mark.slow) for model in ("none", "gp20")]


@pytest.mark.parametrize(("backend", "model", "trials"), [("compiled", "none", 12), ("interpreted", "none", 12), *MANY])
@pytest.mark.parametrize("nodes", [10, 20])
def test_hostile_subproblems(backend, model, trials, nodes):
    if backend == "compiled" and compiler() is None:
        pytest.skip("no C compiler")
    compared, worst = hostile(model, nodes, backend, trials=trials, seed=nodes if trials < 100 else 1)
    assert compared > (20 if trials < 100 else 1000) and worst < EXACT
