"""Weights that adapt in flight: against least squares, the Riccati equation, the Lyapunov argument, and 1e5 samples."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from quadexp.compile.backend import BufferedFunction, compiler, realise
from quadexp.models.linear_drag import adapting_drag, linear_drag_acceleration, linear_drag_residual
from quadexp.plugins.aerodynamics.terms import adapting_terms
from quadexp.plugins.gaussian_process.gaussian_process import JITTER, adapting_process
from quadexp.plugins.gaussian_process.posterior import gaussian_process_residual, mean_only
from quadexp.plugins.gaussian_process.sgpr import Hyperparameters, sparse_posterior
from quadexp.plugins.neural.neural import adapting_network, neural_residual
from quadexp.plugins.remedies.online import Law, from_zero, prior_belief, update_function
from tests.models.residuals import make_residual, network

POINTS, LENGTH = np.linspace(-12, 12, 9), 4.0  # m/s, of the Gaussian processes
STILL = np.array([0, 0, 0, 1.0, 0, 0, 0, 0, 0, 0, 0, 0, 0])


class Learner:
    """update_function with numbers: one sample a call."""

    def __init__(self, vehicle, adapting, law=None, known=None, *, decay=1.0, variance=0.01, tracking=0.0, rate=0.0):
        compiled = compiler() is not None
        function = update_function(vehicle, adapting, known, law, compiled=compiled)
        self.f = BufferedFunction(realise(function, "compiled" if compiled else "interpreted"))
        self.vehicle, self.adapting, given = vehicle, adapting, self.f.arguments
        given["belief"][...] = prior_belief(adapting)
        given["decay"][...], given["variance"][...], given["tracking"][...] = decay, variance, tracking
        given["tracking_rate"][...] = rate
        if known is not None:
            given["known_theta"][...] = known.theta

    def sample(self, velocity, thrust, acceleration, error=(0, 0, 0)):
        """The residual acceleration at a body velocity and thrusts, level; error: velocity less the reference's."""
        given = self.f.arguments
        given["x"][...] = STILL
        given["x"][7:10], given["u"][...] = velocity, thrust
        given["f"][...] = np.asarray(acceleration) + [0, 0, np.sum(thrust) / self.vehicle.mass]
        given["path"][...] = np.concatenate([np.zeros(3), np.asarray(velocity) - error])
        self.f()
        given["belief"][...] = self.f.results["new_belief"]

    @property
    def blocks(self):
        return self.split(self.adapting, self.f.arguments["belief"])

    @staticmethod
    def split(adapting, belief):
        """b (h,) and P (h, h) of every block."""
        sizes = [len(block.at) for block in adapting.blocks]
        pieces = np.split(belief, np.cumsum([block.size for block in adapting.blocks])[:-1])
        return [(piece[:h], piece[h:].reshape(h, h)) for piece, h in zip(pieces, sizes, strict=True)]

    @property
    def theta(self):
        return self.f.results["theta"]


def samples(rng, count):
    """Velocities (k, 3), thrusts (k, 4) and measured accelerations (k, 3)."""
    v, u = rng.normal(0, 5, (count, 3)), rng.uniform(1, 5, (count, 4))
    y = -0.3 * v - 0.05 * v * np.abs(v) + [0.1, -0.2, 0.3] + 0.1 * rng.normal(size=(count, 3))
    return v, u, y


def designs(adapting, v, u):
    """phi R of every sample, by differences of the residual in its weights: (k, h) per block."""
    z = np.hstack([v, np.zeros_like(v), u])
    found = []
    for block in adapting.blocks:
        columns = []
        for at in block.at:
            theta = adapting.residual.theta.copy()
            theta[at] += 1.0
            other = type(adapting.residual)("", adapting.residual.function, theta)
            columns.append((other(z) - adapting.residual(z))[:, block.axis])
        found.append(np.stack(columns, axis=1) @ block.root)
    return found


def families(vehicle):
    rng = np.random.default_rng(1)
    outputs = [
        mean_only(f"a_{axis}", (f"v_{axis}",), POINTS[:, None], rng.normal(size=9), np.array([LENGTH]))
        for axis in "xyz"
    ]
    return {
        "linear_drag": adapting_drag(vehicle, linear_drag_residual(vehicle, (0.2, 0.1, 0.0)), 1.0),
        "terms": adapting_terms(vehicle, 1.0),
        "neural": adapting_network(neural_residual(vehicle, network()), network(), 1.0),
        "gaussian_process": adapting_process(gaussian_process_residual(vehicle, outputs), outputs, 2.0),
    }


FAMILIES = ("linear_drag", "terms", "neural", "gaussian_process")


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("law", ["bayes", "rls"])
def test_without_forgetting_it_is_least_squares_on_all_samples(vehicle, rng, family, law):
    """Ridge regression towards the prior, formed as one system: b = (I + X'X / r)^-1 X' (y - c) / r."""
    adapting = families(vehicle)[family]
    learner = Learner(vehicle, adapting, Law(law), variance=0.04)
    v, u, y = samples(rng, 300)
    for sample in zip(v, u, y, strict=True):
        learner.sample(*sample)
    base = adapting.residual(np.hstack([v, np.zeros_like(v), u]))
    for block, X, (b, P) in zip(adapting.blocks, designs(adapting, v, u), learner.blocks, strict=True):
        information = np.eye(X.shape[1]) + X.T @ X / 0.04
        expected = np.linalg.solve(information, X.T @ (y - base[:, :3])[:, block.axis] / 0.04)
        assert np.allclose(P, np.linalg.inv(information), atol=1e-10)
        assert np.allclose(X @ b, X @ expected, atol=1e-7)
        assert np.allclose(learner.theta[block.at], block.mean + block.root @ b, rtol=1e-12, atol=1e-12)


def test_the_prior_of_drag_is_of_one_size_at_usual_speed_and_thrust(vehicle):
    """Each weight alone, a standard deviation off its mean, adds s at 8 m/s along its axis in hover."""
    s, hover = 0.7, np.full(vehicle.n_rotors, vehicle.mass * vehicle.gravity / vehicle.n_rotors)
    adapting = adapting_drag(vehicle, linear_drag_residual(vehicle, [0.3, 0.4, 0.1], [0.1, 0.2, 0.3], 0.01), s)
    assert [block.axis for block in adapting.blocks] == [0, 1, 2]
    z = np.r_[8.0, 8.0, 8.0, np.zeros(3), hover]
    for block in adapting.blocks:
        np.testing.assert_array_equal(block.mean, adapting.residual.theta[block.at])
        for place, deviation in zip(block.at, block.root, strict=True):
            step = np.zeros(7)
            step[block.at] = deviation
            assert np.count_nonzero(step) == 1 and step[place] > 0
            added = np.array(linear_drag_acceleration(ca.DM(z), ca.DM(step))).ravel()
            assert abs(added[block.axis]) == pytest.approx(s) and np.count_nonzero(added) == 1


def test_what_is_known_is_not_learned_again(vehicle, rng):
    """Samples that a known residual explains leave the weights at zero."""
    known = linear_drag_residual(vehicle, (0.5, 0.4, 0.1), (0.1, 0, 0), -0.01)
    learner = Learner(vehicle, adapting_terms(vehicle, 1.0), known=known)
    v, u, _ = samples(rng, 50)
    for one, thrust in zip(v, u, strict=True):
        learner.sample(one, thrust, known(np.concatenate([one, np.zeros(3), thrust]))[0, :3])
    assert np.abs(learner.theta).max() < 1e-10


@pytest.mark.parametrize("law", ["bayes", "rls"])
def test_the_covariance_stays_bounded_without_excitation(vehicle, law):
    """Hovering for 20,000 samples with a memory of 50: only the offset is excited; plain forgetting overflows."""
    learner = Learner(vehicle, adapting_terms(vehicle, 1.0), Law(law), decay=np.exp(-1 / 50))
    thrust = np.full(4, vehicle.hover_thrust)
    for _ in range(20_000 if compiler() else 2000):
        learner.sample(np.zeros(3), thrust, [0.2, 0.0, -0.1])
    for b, P in learner.blocks:
        assert np.trace(P) <= len(b) * (1 + 1e-9)
        assert np.linalg.eigvalsh(P).min() > 0
        assert np.isfinite(b).all()
    assert learner.theta[2] == pytest.approx(0.2, abs=0.01)  # the offset of x
    assert learner.theta[0] == pytest.approx(0.0, abs=1e-9)  # its drag, of which nothing was seen


def test_bayes_returns_to_the_prior_without_data(vehicle, rng):
    """Samples of infinite noise: b falls by exp(-t / memory) and P returns to I."""
    learner = Learner(vehicle, adapting_terms(vehicle, 1.0), decay=1.0)
    for sample in zip(*samples(rng, 100), strict=True):
        learner.sample(*sample)
    before = [b.copy() for b, _ in learner.blocks]
    learner.f.arguments["decay"][...], learner.f.arguments["variance"][...] = np.exp(-0.02), 1e30
    for _ in range(100):
        learner.sample(np.ones(3), np.ones(4), np.zeros(3))
    for start, (b, P) in zip(before, learner.blocks, strict=True):
        assert np.allclose(b, np.exp(-2) * start, rtol=1e-9)
        assert np.allclose(np.diag(P), 1 - np.exp(-4) * (1 - np.diag(P)[0]), atol=0.2) and np.all(np.diag(P) < 1)


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize("forgetting", [0.0, 1e-3])
def test_the_covariance_of_a_gaussian_process_after_1e5_samples(vehicle, forgetting):
    """Exactly symmetric and positive definite; without forgetting that of all samples at once."""
    adapting = families(vehicle)["gaussian_process"]
    learner = Learner(vehicle, adapting, decay=np.exp(-forgetting), variance=1e-2)
    rng, sums = np.random.default_rng(3), None
    for _ in range(10):
        v, u, y = samples(rng, 10_000)
        for sample in zip(v, u, y, strict=True):
            learner.sample(*sample)
        parts = []
        for block in adapting.blocks:  # every output's feature is its own velocity
            X = np.exp(-0.5 * ((v[:, block.axis, None] - POINTS) / LENGTH) ** 2) @ block.root
            parts.append(X.T @ X)
        sums = parts if sums is None else [a + b for a, b in zip(sums, parts, strict=True)]
    for (_, P), information in zip(learner.blocks, sums, strict=True):
        assert np.array_equal(P, P.T)
        assert np.linalg.eigvalsh(P).min() > 0
        if not forgetting:
            expected = np.linalg.inv(np.eye(len(P)) + information / 1e-2)
            assert np.abs(P - expected).max() < 1e-8


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
@pytest.mark.parametrize(
    "law", [Law("composite"), Law("rls"), Law("bayes", fitc=True)], ids=["composite", "rls", "fitc"]
)
def test_the_c_code_is_the_interpreted_update(vehicle, rng, law):
    """On a belief in the middle of a flight, with all features."""
    for family, adapting in families(vehicle).items():
        forms = [update_function(vehicle, adapting, None, law, compiled=compiled) for compiled in (False, True)]
        here, there = forms[0], realise(forms[1], "compiled")
        belief = prior_belief(adapting)
        for _ in range(6):
            x = STILL + np.r_[np.zeros(7), 5 * rng.normal(size=6)]
            inputs = [x, rng.normal(size=3), rng.uniform(1, 5, 4), rng.normal(size=6), belief, [], 0.1, 0.99, 0.02, 1.5]
            found = [np.array(one) for one in here(*inputs)]
            for one, other in zip(found, there(*inputs), strict=True):
                assert np.allclose(one, np.array(other), rtol=1e-10, atol=1e-11), family
            belief = found[0].ravel()


# ---------------------------------------------------------------------------------------------- Neural-Fly's law
class Printed:
    """The law as the supplement of O'Connell et al. 2022 prints it, (17)-(19), with the opposite sign of the last term
    and no dt there, and R dt as the noise of a sample; `slips` says which of the three it makes."""

    def __init__(self, h, dt, density, slips, weight):
        self.b, self.P, self.dt, self.weight = np.zeros(h), np.eye(h), dt, weight
        self.noise = density * dt if "noise" in slips else density / dt
        sign = -1 if "sign" in slips else 1
        self.step = sign * (1 if "step" in slips else dt)

    def sample(self, phi, y, s):
        gain = self.P @ phi / (phi @ self.P @ phi + self.noise)
        self.P = self.P - np.outer(gain, phi @ self.P)
        self.b = self.b - gain * (phi @ self.b - y) + self.step * self.weight * self.P @ phi * s


def motion(t):
    """An exciting velocity, (3,) (m/s)."""
    return np.array([6 * np.sin(1.3 * t), 4 * np.cos(0.9 * t) + 2, 3 * np.sin(2.1 * t + 1)])


def exact_tracking(s, error, gain, dt):
    """s' = -K s - error over dt, exact for a held error."""
    fall = np.exp(-gain * dt)
    return fall * s - (1 - fall) / gain * error


K, DT, WEIGHT, STEPS = 3.0, 2e-3, 0.5, 1500


def lyapunov(learner_step, b_of, P_of, truth, phi_of):
    """V = c s's + sum b~' P^-1 b~ along the exact motion under a law, (k,)."""
    s, values = np.array([0.8, -0.5, 0.6]), []
    for k in range(STEPS):
        phi = phi_of(k * DT)
        wrong = np.array([p @ (b - a) for p, b, a in zip(phi, b_of(), truth, strict=True)])
        s = exact_tracking(s, wrong, K, DT)
        learner_step(k * DT, s)
        values.append(
            WEIGHT * s @ s
            + sum((b - a) @ np.linalg.solve(P, b - a) for b, P, a in zip(b_of(), P_of(), truth, strict=True))
        )
    return np.array(values)


def test_the_composite_law_makes_the_lyapunov_function_fall(vehicle):
    """V' = -2 c s'K s - b~' phi' phi b~ / r < 0; the printed form, and each of its slips, lets V rise or P be wrong."""
    adapting = adapting_terms(vehicle, 1.0)
    thrust, density = np.full(4, vehicle.hover_thrust), 300.0  # a poor accelerometer: tracking decides
    rng = np.random.default_rng(2)
    truth = [rng.normal(size=len(block.at)) for block in adapting.blocks]

    every = designs(adapting, np.stack([motion(k * DT) for k in range(STEPS)]), np.tile(thrust, (STEPS, 1)))

    def phi_of(t):
        return [X[round(t / DT)] for X in every]

    def force(t):
        return np.array([p @ a for p, a in zip(phi_of(t), truth, strict=True)])

    learner = Learner(vehicle, adapting, Law("composite"), variance=density / DT, tracking=DT * WEIGHT)
    values = lyapunov(
        lambda t, s: learner.sample(motion(t), thrust, force(t), s),
        lambda: [b.copy() for b, _ in learner.blocks],
        lambda: [P.copy() for _, P in learner.blocks],
        truth,
        phi_of,
    )
    assert np.all(np.diff(values) <= 1e-9 * values[:-1])
    assert values[-1] < 0.95 * values[0]

    def printed(slips):
        laws = [Printed(len(a), DT, density, slips, WEIGHT) for a in truth]

        def step(t, s):
            for law, phi, y, one in zip(laws, phi_of(t), force(t), s, strict=True):
                law.sample(phi, y, one)

        return lyapunov(step, lambda: [law.b for law in laws], lambda: [law.P for law in laws], truth, phi_of)

    right = printed(())
    assert np.allclose(right, values, rtol=1e-6)  # a second writing of the same law
    for slips in (("sign", "step", "noise"), ("sign", "step"), ("sign",), ("step",)):
        rises = np.diff(printed(slips)) / printed(slips)[:-1]
        assert rises.max() > 1e-4, slips


def test_the_tracking_error_is_taken_in_body_axes(vehicle, rng):
    """sigma = R' ((v - v_r) + Lambda (p - p_r)), and readings that say nothing: b = dt c sigma_i phi_i."""
    adapting, turn, rate = adapting_terms(vehicle, 1.0), Rotation.from_euler("zyx", [1.2, -0.6, 0.9]), 2.5
    learner = Learner(vehicle, adapting, Law("composite"), variance=1e30, tracking=0.1, rate=rate)
    given, (p, v, path), thrust = learner.f.arguments, rng.normal(size=(3, 6)), np.full(4, 3.0)
    p, v = p[:3], 5 * v[:3]
    given["x"][...] = np.concatenate([p, turn.as_quat(scalar_first=True), v, np.zeros(3)])
    given["u"][...], given["path"][...] = thrust, path
    learner.f()
    sigma = turn.inv().apply(v - path[3:] + rate * (p - path[:3]))
    rows = designs(adapting, turn.inv().apply(v)[None], thrust[None])
    for block, phi, (b, _) in zip(
        adapting.blocks, rows, learner.split(adapting, learner.f.results["new_belief"]), strict=True
    ):
        assert b == pytest.approx(0.1 * sigma[block.axis] * phi[0], abs=1e-9)


def test_noise_of_a_sample_is_the_density_over_the_time(vehicle):
    """P follows P' = -2 lambda P + 2 lambda I - P phi' phi P / R, whatever the rate of the samples."""
    adapting, rate, density, seconds = adapting_terms(vehicle, 1.0), 0.5, 0.05, 2.0
    thrust = np.full(4, vehicle.hover_thrust)

    def slope(t, flat):
        P, phi = flat.reshape(3, 3), designs(adapting, motion(t)[None], thrust[None])[0][0]
        return (-2 * rate * (P - np.eye(3)) - np.outer(P @ phi, P @ phi) / density).ravel()

    expected = solve_ivp(slope, (0, seconds), np.eye(3).ravel(), rtol=1e-8, atol=1e-10).y[:, -1].reshape(3, 3)
    for dt in (4e-3, 1e-3):
        learner = Learner(vehicle, adapting, Law("composite"), variance=density / dt, decay=np.exp(-rate * dt))
        for k in range(round(seconds / dt)):
            learner.sample(motion((k + 0.5) * dt), thrust, np.zeros(3))
        assert np.abs(learner.blocks[0][1] - expected).max() < 6 * dt


def test_from_zero_forgets_what_was_fitted(vehicle):
    adapting = from_zero(families(vehicle)["linear_drag"])
    z = np.random.default_rng(0).normal(size=(5, 10))
    assert not adapting.residual(z).any()
    assert make_residual("linear_drag", vehicle)(z).any()


def data(rows=800, seed=0):
    rng = np.random.default_rng(seed)
    v, u = rng.uniform(-10, 10, (rows, 3)), rng.uniform(1, 6, (rows, 4))
    a = np.sin(v / 3) - 0.02 * v * np.abs(v) + 0.05 * rng.normal(size=(rows, 3))
    a[:, 2] -= 0.02 * u.sum(axis=1)
    return v, u, a


P = {
    "a_x": (Hyperparameters(np.array([3.0]), 1.5, 0.04), ("v_x",)),
    "a_y": (Hyperparameters(np.array([2.5]), 1.5, 0.04), ("v_y",)),
    "a_z": (Hyperparameters(np.array([4.0, 6.0]), 1.5, 0.04), ("v_z", "thrust")),
}


def process(points=12):
    """Outputs with weights zero and signal variances, and the inducing points of each."""
    rng, outputs = np.random.default_rng(1), []
    for name, (p, features) in P.items():
        where = rng.uniform(-9, 9, (points, len(features)))
        where[:, 1:] = rng.uniform(5, 23, (points, len(features) - 1))
        outputs.append(mean_only(name, features, where, np.zeros(points), p.lengthscale, p.signal_variance))
    return outputs


def stream(vehicle, law, v, u, a, forgetting=0.0):
    outputs = process()
    adapting = adapting_process(gaussian_process_residual(vehicle, outputs), outputs, np.sqrt(1.5))
    learner = Learner(vehicle, adapting, law, variance=0.04, decay=1 - forgetting)
    for sample in zip(v, u, a, strict=True):
        learner.sample(*sample)
    return adapting, outputs, learner.blocks, learner.theta.copy()


def features(names, v, u):
    columns = {"v_x": v[:, 0], "v_y": v[:, 1], "v_z": v[:, 2], "thrust": u.sum(axis=1)}
    return np.stack([columns[name] for name in names], axis=1)


def kernel(a, b, p):
    return p.signal_variance * np.exp(-0.5 * (((a[:, None] - b[None]) / p.lengthscale) ** 2).sum(axis=2))


def test_the_variational_form_is_our_sgpr(vehicle):
    """Mean and covariance of the function at new points, to 1e-8, against plugins.gaussian_process.sgpr on all rows."""
    v, u, a = data()
    adapting, outputs, blocks, theta = stream(vehicle, Law(), v, u, a)
    new_v, new_u, _ = data(40, seed=9)
    predicted = type(adapting.residual)("", adapting.residual.function, theta)(
        np.hstack([new_v, np.zeros_like(new_v), new_u])
    )
    for axis, (output, block, (_, S)) in enumerate(zip(outputs, adapting.blocks, blocks, strict=True)):
        p = P[output.output][0]
        x, new = features(output.features, v, u), features(output.features, new_v, new_u)
        alpha, factor = sparse_posterior(x, a[:, axis], output.inducing, p, JITTER)
        e = kernel(new, output.inducing, p) / p.signal_variance
        assert np.abs(predicted[:, axis] - e @ alpha).max() < 1e-8
        phi = e @ block.root  # variance: s^2 - phi phi' of what the points do not determine, phi S phi' of the rest
        variance = p.signal_variance - np.sum(phi**2, axis=1) + np.einsum("ki,ij,kj->k", phi, S, phi)
        assert np.abs(variance - (p.signal_variance - np.sum((e @ factor.T) ** 2, axis=1))).max() < 1e-8


def test_fitc_is_its_equation_on_all_samples(vehicle):
    """b = (I + X' D^-1 X)^-1 X' D^-1 y, D = diag(r + k(z, z) - q(z, z)): Snelson and Ghahramani's sparse process."""
    v, u, a = data(200)
    adapting, outputs, blocks, _ = stream(vehicle, Law(fitc=True), v, u, a)
    for axis, (output, block, (b, _)) in enumerate(zip(outputs, adapting.blocks, blocks, strict=True)):
        p = P[output.output][0]
        X = kernel(features(output.features, v, u), output.inducing, p) / p.signal_variance @ block.root
        weight = 1 / (0.04 + p.signal_variance - np.sum(X**2, axis=1))
        expected = np.linalg.solve(np.eye(X.shape[1]) + (X.T * weight) @ X, (X.T * weight) @ a[:, axis])
        assert np.allclose(X @ b, X @ expected, atol=1e-8)


def test_it_follows_a_world_that_changes(vehicle):
    """After a change of sign of the air's force, the stream with forgetting is right and the one without is not."""
    v, u, a = data(600)
    changed = np.vstack([a[:300], -a[300:]])
    errors = []
    for forgetting in (0.0, 0.02):
        adapting, outputs, blocks, _ = stream(vehicle, Law(), v, u, changed, forgetting)
        p = P["a_x"][0]
        X = kernel(v[300:, :1], outputs[0].inducing, p) / p.signal_variance @ adapting.blocks[0].root
        errors.append(np.sqrt(np.mean((X @ blocks[0][0] + a[300:, 0]) ** 2)))
    assert errors[1] < 0.3 * errors[0]


def test_it_begins_at_a_checkpoint_or_at_the_prior(vehicle):
    outputs = [
        mean_only("a_x", ("v_x",), np.linspace(-5, 5, 6)[:, None], np.arange(6.0), np.array([2.0])),
        mean_only("tau_x", ("w_x",), np.linspace(-5, 5, 6)[:, None], np.arange(6.0), np.array([2.0])),
    ]
    adapting = adapting_process(gaussian_process_residual(vehicle, outputs), outputs, 1.0)
    z = np.random.default_rng(0).normal(size=(4, 10))
    assert np.array_equal(adapting.residual(z), gaussian_process_residual(vehicle, outputs)(z))
    assert len(adapting.blocks) == 1  # torques are not measured, so they do not adapt
    fresh = from_zero(adapting).residual(z)
    assert not fresh[:, 0].any() and np.array_equal(fresh[:, 3], adapting.residual(z)[:, 3])
    assert np.allclose(adapting.blocks[0].mean, np.arange(6.0)) and pytest.approx(0) == fresh[0, 1]
