"""Recursive least squares: the paper's update by hand in its own frame, batch least squares, and what it finds."""

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.physics.rotor import BladeCoefficients
from quadexp.plugins.papers.lei_li.rls import AXES, RLSSettings
from tests import paper
from tests.models.air_data import air_data
from tests.plugins.papers.estimator import Estimator

TRUE = np.array([0.22, 3.32, 0.01, 0.01, 0.02])
HALF = BladeCoefficients.from_parameters(TRUE / 2)


@pytest.fixture(scope="module")
def data():
    return air_data()


def run(estimator: Estimator, data, force=None) -> Estimator:
    force = data.specific_force if force is None else force
    for sample in zip(data.velocity, data.rotor_speed, force, strict=True):
        estimator.update(*sample)
    return estimator


def by_hand(V, w, y, theta, P, C_la, A=0.5, B=1 / 6):
    """(23)-(26) as the specification has them: phi_1..phi_4, FRD, one axis after the other; V_I from C_la in use."""
    r, c, th, rho = paper.R, paper.C, paper.TH, paper.RHO
    V_h = np.hypot(V[0], V[1])
    u = np.array([paper.induced(w_i, V_h, V[2], C_la, A) for w_i in w]) - V[2]
    phi_1 = rho * c * r**2 * w.sum() / 2
    phi_2 = -B * rho * c * r * th * u.sum() + rho * c * (u**2 / w).sum() / 2
    phi_3 = (
        rho * c * r**3 * th * (w**2).sum() / 3 - rho * c * r**2 * (u * w).sum() / 2 + 4 * A * rho * c * r * th * V_h**2
    )
    phi_4 = rho * paper.S * np.linalg.norm(V) / 2
    rows = [
        np.array([-V[0] * phi_1, -V[0] * phi_2, -V[0] * phi_4]) / paper.M,
        np.array([-V[1] * phi_1, -V[1] * phi_2, -V[1] * phi_4]) / paper.M,
        np.array([-phi_3, -V[2] * phi_4]) / paper.M,
    ]
    new_theta, new_P = [], []
    for axis, Phi in enumerate(rows):
        error = y[axis] - Phi @ theta[axis]
        K = P[axis] @ Phi / (Phi @ P[axis] @ Phi + 1)
        new_theta.append(theta[axis] + K * error)
        new_P.append((np.eye(len(Phi)) - np.outer(K, Phi)) @ P[axis])
    total = abs(V[0]) + abs(V[1])
    beta = abs(V[0]) / total if total > 0 else 0.5
    x, y_, z = new_theta
    return new_theta, new_P, np.array([beta * x[0] + (1 - beta) * y_[0], z[0], x[2], y_[2], z[1]])


def test_updates_equal_a_hand_written_one(lei_li, data, rng):
    """Thirty updates with noise, from the paper's start: P_0 = 50 I, half of the true values."""
    estimator = Estimator(lei_li, HALF, RLSSettings(clip=False))
    start = HALF.parameters()
    theta, P, used = [start[list(at)] for at in AXES.values()], [50 * np.eye(len(at)) for at in AXES.values()], start
    for k in range(0, 300, 10):
        force = data.specific_force[k] + rng.normal(0, 0.05, 3)
        V, w = paper.flip(data.velocity[k]), data.rotor_speed[k]
        theta, P, used = by_hand(V, w, paper.flip(force), theta, P, used[1])
        found = estimator.update(data.velocity[k], w, force)
        assert found == pytest.approx(used, rel=1e-9, abs=1e-12)
        for mine, other in zip(estimator.axis_theta, theta, strict=True):
            assert mine == pytest.approx(other, rel=1e-9, abs=1e-12)
        for mine, other in zip(estimator.covariance, P, strict=True):
            assert mine == pytest.approx(other, rel=1e-8, abs=1e-9)


def test_combination_at_rest(lei_li):
    """beta_x = 0.5 at 0/0; hover tells of C_la alone, V_I being solved with its first value."""
    estimator = Estimator(lei_li, HALF, RLSSettings(clip=False))
    theta = estimator.update(np.zeros(3), np.full(4, 527.0), np.array([0, 0, 9.7]))
    assert estimator.weight == 0.5
    assert theta[[0, 2, 3, 4]] == pytest.approx(HALF.parameters()[[0, 2, 3, 4]])
    assert theta[1] > HALF.lift_slope


def test_forgetting_weighs_a_sample_by_its_age(lei_li, data, rng):
    """Well excited, the estimate is that of samples with the weight lambda^age: what the resetting to P_0 adds to the
    information is a share of 1e-4."""
    forget = 0.98
    estimator = Estimator(lei_li, HALF, RLSSettings.scaled(forgetting=forget, noise=0.01))
    P_0, rows, readings = estimator.covariance[2], [], []
    for velocity, w, force in zip(data.velocity, data.rotor_speed, data.specific_force, strict=True):
        readings.append(force + rng.normal(0, 0.01, 3))
        estimator.update(velocity, w, readings[-1])
        rows.append(estimator.regressors[2, [1, 4]])
    age = np.sqrt(forget) ** np.arange(len(rows))[::-1]
    lift, _ = np.linalg.lstsq(np.array(rows) * age[:, None], np.array(readings)[:, 2] * age, rcond=None)[0]
    assert estimator.axis_theta[2][0] == pytest.approx(lift, rel=1e-3)
    assert (np.linalg.eigvalsh(P_0 - estimator.covariance[2]) > 0).all()


@pytest.mark.parametrize("forgetting", [0.5, 0.8, 0.98, 1.0])
def test_the_covariance_stays_within_the_first_one_without_excitation(lei_li, rng, forgetting):
    """Hover for 5,000 samples, with noise in everything that is measured: P is symmetric, positive and at most P_0."""
    estimator = Estimator(lei_li, HALF, RLSSettings(forgetting=forgetting))
    prior, hover = estimator.covariance, np.full(4, np.sqrt(lei_li.hover_thrust / lei_li.static_thrust_coefficient))
    noise = rng.normal(size=(5_000, 10))
    for one in noise:
        estimator.update(1e-3 * one[:3], hover + 0.1 * one[3:7], np.array([0, 0, lei_li.gravity]) + 0.05 * one[7:])
    for P, P_0 in zip(estimator.covariance, prior, strict=True):
        assert np.linalg.eigvalsh(P).min() > 0 and np.allclose(P, P.T, rtol=1e-12)
        assert np.linalg.eigvalsh(P_0 - P).min() > -1e-9 * P_0.max()
    assert estimator.raw[1] == pytest.approx(TRUE[1], rel=0.1) and np.isfinite(estimator.raw).all()


@pytest.mark.parametrize("gauss_newton", [False, True])
def test_finds_the_truth_without_noise(lei_li, data, gauss_newton):
    """V_I solved with the current estimate: self-consistent, so the truth is where it ends; slowly for C_Dz."""
    settings = RLSSettings.scaled(noise=1e-4, relative_std=1.0, gauss_newton=gauss_newton)
    estimator = run(Estimator(lei_li, HALF, settings), data)
    for _ in range(3):
        run(estimator, data)
    assert estimator.theta[:4] == pytest.approx(TRUE[:4], rel=5e-3, abs=5e-4)
    assert estimator.theta[4] == pytest.approx(TRUE[4], rel=0.02 if gauss_newton else 0.5)


def test_gauss_newton_follows_the_induced_velocity(lei_li, data):
    """Its gain is the derivative of the whole prediction, V_I(C_la) included: here by differences."""
    estimator = Estimator(lei_li, HALF, RLSSettings(gauss_newton=True, clip=False))
    v, w, force = data.velocity[7], data.rotor_speed[7], data.specific_force[7]

    def predicted(C_la):
        return -paper.point(paper.flip(v), w, C_la=C_la, C_d0=0.11, C_D=TRUE[2:] / 2).F[2] / paper.M

    slope = (predicted(1.66 + 1e-5) - predicted(1.66 - 1e-5)) / 2e-5
    estimator.update(v, w, force)
    Phi = np.array([slope, estimator.regressors[2, 4]])
    gain = 50 * Phi / (50 * Phi @ Phi + 1)
    assert estimator.axis_theta[2] == pytest.approx([1.66, 0.01] + gain * (force[2] - predicted(1.66)), rel=1e-7)


def test_gauss_newton_removes_the_bias(lei_li, data, rng):
    """With the partial derivative C_Dz comes out too large, whatever the accelerometer's bias."""
    force = data.specific_force + rng.normal(0, 0.05, data.specific_force.shape)
    plain, whole = (
        run(Estimator(lei_li, HALF, RLSSettings(gauss_newton=option)), data, force) for option in (False, True)
    )
    assert abs(whole.raw[4] - 0.02) < abs(plain.raw[4] - 0.02)
    assert whole.raw[1] == pytest.approx(3.32, rel=2e-3)


def test_standard_error_is_the_spread(lei_li, data):
    """Over repeated noise the estimates scatter by what is claimed."""
    found = []
    for seed in range(30):
        force = data.specific_force + np.random.default_rng(seed).normal(0, 0.05, data.specific_force.shape)
        found.append(run(Estimator(lei_li, HALF, RLSSettings.scaled(relative_std=2.0, gauss_newton=True)), data, force))
    spread = np.array([estimator.raw for estimator in found]).std(0)
    assert spread == pytest.approx(found[0].standard_error(), rel=0.45)


class TestSafety:
    def test_used_values_are_clipped_and_counted(self, lei_li, data, rng):
        force = data.specific_force + rng.normal(0, 5.0, data.specific_force.shape)
        clipped, free = (Estimator(lei_li, HALF, RLSSettings(clip=clip)) for clip in (True, False))
        outside = np.zeros(5, int)
        for sample in zip(data.velocity, data.rotor_speed, force, strict=True):
            theta = clipped.update(*sample)
            assert np.all(theta >= clipped.lower) and np.all(theta <= clipped.upper)
            assert np.array_equal(theta, np.clip(clipped.raw, clipped.lower, clipped.upper))
            outside += clipped.raw != theta
        assert np.array_equal(clipped.clips, outside) and outside.sum() > 0
        run(free, data, force)
        assert np.array_equal(free.theta, free.raw) and free.clips.sum() == 0

    def test_bounds(self, lei_li):
        estimator = Estimator(lei_li, HALF)
        assert estimator.lower == pytest.approx([0.055, 0.83, 0, 0, 0])
        assert estimator.upper == pytest.approx([0.44, 6.64, 0.2, 0.2, 0.2])

    def test_reset_begins_anew(self, lei_li, data):
        estimator = Estimator(lei_li, HALF)
        first = run(estimator, data).raw
        estimator.reset()
        assert np.array_equal(estimator.theta, HALF.parameters()) and estimator.clips.sum() == 0
        assert np.array_equal(run(estimator, data).raw, first)

    def test_standing_rotors_tell_nothing(self, lei_li):
        estimator = Estimator(lei_li, HALF)
        assert np.array_equal(
            estimator.update(np.ones(3), np.array([500, 0, 500, 500.0]), np.ones(3)), HALF.parameters()
        )
        assert (estimator.samples, estimator.skipped) == (0, 1)

    def test_settings_are_checked(self, lei_li):
        for wrong in ({"forgetting": 1.2}, {"covariance": 0.0}, {"lift_weight": 2.0}):
            with pytest.raises(UsageError, match=f"rls.{next(iter(wrong))}"):
                RLSSettings(**wrong)


def test_compiled_equals_interpreted(lei_li, data):
    one, two = (run(Estimator(lei_li, HALF, backend=backend), data) for backend in ("interpreted", "auto"))
    assert two.raw == pytest.approx(one.raw, rel=1e-9)
