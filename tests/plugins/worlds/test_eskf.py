"""The error-state Kalman filter: against another one, against analytic covariances, against its own statistics."""

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from quadexp.errors import UsageError
from quadexp.physics.state import ATTITUDE, POSITION, RATE, VELOCITY
from quadexp.plugins.worlds import error_state
from quadexp.plugins.worlds.error_state import N_KNOWN, correction, prediction
from quadexp.plugins.worlds.eskf import Navigation
from quadexp.plugins.worlds.gnss import ImuGnss
from quadexp.plugins.worlds.motion_capture import ImuMocap
from quadexp.world.effect import Clock
from tests.plugins.worlds import plain_ekf
from tests.plugins.worlds.aided_flights import GRAVITY, AidedRun, errors, full, motion, standing

DENSITIES = np.array([0.02, 2e-3, 3e-3, 2e-4])
NO_BIAS = {"accelerometer_bias_std": 0, "gyroscope_bias_std": 0, "accelerometer_bias_walk": 0, "gyroscope_bias_walk": 0}
both_sensors = pytest.mark.parametrize("make", [ImuMocap, ImuGnss])


def some_filter(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A nominal state and a covariance without any structure, of small errors."""
    rng = np.random.default_rng(seed)
    q = Rotation.random(rng=rng).as_quat(scalar_first=True)
    nominal = np.r_[rng.normal(size=3), q, 3 * rng.normal(size=3), 0.1 * rng.normal(size=6)]
    A = rng.normal(size=(15, 15)) * 0.01
    return nominal, A @ A.T


def ravel(value: ca.DM) -> np.ndarray:
    return np.array(value.full()).ravel()


def known_of(nominal: np.ndarray, P: np.ndarray) -> np.ndarray:
    return np.r_[nominal, ravel(error_state.packed(ca.DM(P)))]


@pytest.mark.parametrize("h", [0.002, 0.02])
def test_a_prediction_is_the_plain_filters(h):
    for seed in range(5):
        nominal, P = some_filter(seed)
        rng = np.random.default_rng(seed + 100)
        reading = np.r_[10 * rng.normal(size=3), 5 * rng.normal(size=3)]
        found = ravel(prediction()(known_of(nominal, P), reading, h, np.r_[GRAVITY, DENSITIES]))
        s, expected = plain_ekf.predict(plain_ekf.unpack(nominal), P, reading, h, GRAVITY, DENSITIES)
        assert np.allclose(plain_ekf.apart(plain_ekf.unpack(found[:16]), s), 0, atol=1e-12)
        assert np.allclose(full(found[None, 16:])[0], expected, rtol=1e-6, atol=1e-6 * expected.max())


def measured(name: str, x: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, object, np.ndarray]:
    """A fix, the plain filter's innovation as a function of its state, and variances."""
    R = Rotation.from_quat(x[ATTITUDE], scalar_first=True)
    if name == "pose":
        p, q = x[POSITION] + 0.01 * rng.normal(size=3), R * Rotation.from_rotvec(0.02 * rng.normal(size=3))
        fix = np.r_[p, q.as_quat(scalar_first=True)]
        return fix, lambda s: np.r_[p - s[0], (s[2].inv() * q).as_rotvec()], np.repeat([1e-4, 4e-4], 3)
    if name == "gnss":
        fix, variances = np.r_[x[POSITION], x[VELOCITY]] + 0.03 * rng.normal(size=6), np.linspace(1e-4, 6e-4, 6)
        return fix, lambda s: fix - np.r_[s[0], s[1]], variances
    # The heading of the horizontal direction of north, as the nominal attitude sees it.
    north = R.inv().apply(Rotation.from_rotvec([0, 0, 0.05]).apply([0, 1, 0]))

    def off(s: plain_ekf.Nominal) -> np.ndarray:
        seen = s[2].apply(north)
        return np.array([np.arctan2(seen[0], seen[1])])

    return north, off, np.array([9e-4])


@pytest.mark.parametrize("name", ["pose", "gnss", "heading"])
def test_a_correction_is_the_plain_filters(name):
    """One number after the other, against the joint update. The two differ by how the innovation bends: at most in the
    second order of the errors, which are of some hundredths."""
    aid = next(one for one in (*ImuMocap().aids, *ImuGnss().aids) if one.name == name)
    for seed in range(5):
        nominal, P = some_filter(seed)
        P = 1e-2 * P
        x = np.r_[nominal[:10], np.zeros(3)]
        fix, innovation, variances = measured(name, x, np.random.default_rng(seed))
        deviations = np.sqrt(variances if name != "pose" else variances[[0, 3]])
        found = ravel(correction(aid)(1, known_of(nominal, P), fix, deviations))
        s, expected = plain_ekf.update(plain_ekf.unpack(nominal), P, innovation, variances)
        change = plain_ekf.apart(plain_ekf.unpack(nominal), s)
        away = plain_ekf.apart(s, plain_ekf.unpack(found[:N_KNOWN][:16]))
        assert np.abs(away).max() < 1e-3 * np.abs(change).max()
        assert np.allclose(full(found[None, 16:])[0], expected, atol=1e-3 * np.abs(expected).max())
        assert np.array_equal(ravel(correction(aid)(0, known_of(nominal, P), fix, deviations)), known_of(nominal, P))


def test_the_covariance_turns_with_the_nominal_attitude():
    """`reset` against differences, of the error about the new nominal state; the rest is of second order."""
    nominal, P = some_filter(0)
    d = 1e-2 * np.random.default_rng(1).normal(size=15)
    s = plain_ekf.unpack(nominal)
    after = plain_ekf.moved(s, d)
    G = plain_ekf.differences(lambda e: plain_ekf.apart(after, plain_ekf.moved(s, d + e)))
    found = np.array(error_state.reset(ca.DM(P), ca.DM(d)).full())
    away = np.abs(found - G @ P @ G.T).max()
    assert away < 1e-4 * np.abs(P).max() and np.abs(P - G @ P @ G.T).max() > 10 * away


def test_a_step_of_the_covariance_has_all_of_the_imus_noise():
    """From certainty, at rest: white acceleration and rates held over h, and steps of the biases."""
    nominal, h = np.r_[np.zeros(3), 1, np.zeros(12)], 0.02
    reading = np.r_[0, 0, GRAVITY, np.zeros(3)]
    found = prediction()(known_of(nominal, np.zeros((15, 15))), reading, h, np.r_[GRAVITY, DENSITIES])
    P, (a, w, b, g) = full(ravel(found)[None, 16:])[0], DENSITIES**2 * h
    assert np.allclose(np.diag(P), np.repeat([a * h**2 / 4, a, w, b, g], 3), rtol=1e-12, atol=0)
    assert np.allclose(P[range(3), range(3, 6)], a * h / 2, rtol=1e-12, atol=0)


def steady(run: AidedRun, seconds: float) -> AidedRun:
    return run.go(standing(np.arange(0, seconds + 1e-9, 1e-3)))


def test_steady_heading_has_the_scalar_riccati_equations_variance():
    """At rest the turn about the vertical is a random walk by itself, seen at every reading: with q = s_g^2 h and
    r = s_q^2, after a fix P = (-q + sqrt(q^2 + 4 q r)) / 2; `reset` mixes in tilt, by some milliradians squared."""
    unit = dict(gyroscope_noise_density=0.01, imu_rate=100.0, **NO_BIAS)
    run = steady(AidedRun(ImuMocap(**unit, pose_dropout=0.0, pose_delay=0.0)), 3.0)
    q, r = 0.01**2 * 0.01, 5e-3**2
    assert np.isclose(run.covariance[-1][8, 8], (-q + np.sqrt(q**2 + 4 * q * r)) / 2, rtol=1e-5, atol=0)


def test_steady_height_has_the_variance_of_kalatas_tracker():
    """At rest, height is a double integrator by itself, driven by white acceleration that is held over h: Kalata 1984,
    with the tracking index L = (s_a / sqrt(h)) h^2 / s_p and the position's gain 1 - ((4 + L - sqrt(8 L + L^2)) / 4)^2.
    """
    unit = dict(accelerometer_noise_density=0.05, imu_rate=100.0, **NO_BIAS)
    run = steady(AidedRun(ImuMocap(**unit, pose_dropout=0.0, pose_delay=0.0)), 10.0)
    index = 0.05 / np.sqrt(0.01) * 0.01**2 / 1e-3
    gain = 1 - ((4 + index - np.sqrt(8 * index + index**2)) / 4) ** 2
    assert np.isclose(run.covariance[-1][2, 2], gain * 1e-3**2, rtol=1e-6, atol=0)


def test_without_fixes_the_covariance_of_height_grows_as_dead_reckoning_does():
    """P_pp(t) = P_pp + 2 P_pv t + P_vv t^2 + s_a^2 t^3 / 3 + bias: P_bb t^4 / 4, from independent first errors."""
    unit = {"accelerometer_bias_walk": 0.0}
    run = AidedRun(ImuMocap(**unit, pose_delay=0.0))
    run.go(standing(np.arange(0, 2 + 1e-9, 1e-3)), outage=(0.0, 9.0))
    t, velocity = 2.0, np.sqrt(2) * 1e-3 * 100
    expected = 1e-3**2 + (velocity * t) ** 2 + 2e-3**2 * t**3 / 3 + (0.05 * t**2 / 2) ** 2
    assert np.isclose(run.covariance[-1][2, 2], expected, rtol=1e-4, atol=0)


def test_an_outage_costs_what_the_covariance_says():
    """A second without fixes after two with: the errors at its end, of 60 runs, within the 95 % band."""
    run = AidedRun(ImuMocap(pose_delay=0.0), backend="compiled")
    states, found = motion(np.arange(0, 3 + 1e-9, 1e-3), seed=8), []
    for seed in range(60):
        run.go(states, seed, outage=(2.0, 3.0))
        found.append(run.nees(states)[-1])
        assert np.all(np.diag(run.covariance[-1])[:9] > 1.5 * np.diag(run.covariance[199])[:9])
    assert_in_band(np.array(found))


def assert_in_band(nees: np.ndarray) -> None:
    low, high = chi2.interval(0.95, 15 * len(nees))
    assert low < nees.sum() < high


@both_sensors
def test_errors_are_those_that_the_filter_believes(make):
    """NEES of 120 flights at one time, within the 95 % band of chi square with 120 x 15 degrees of freedom."""
    run, states = AidedRun(make(), backend="compiled"), motion(np.arange(0, 2 + 1e-9, 1e-3), seed=1)
    assert_in_band(np.array([run.go(states, seed).nees(states)[-1] for seed in range(120)]))


@pytest.mark.slow
@both_sensors
@pytest.mark.parametrize("path", [2, 3])
@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_errors_are_those_that_the_filter_believes_on_long_flights(make, path, lost):
    """50 flights of 20 s: at 95 of 100 times, on average, the sum is within its band; and so is the mean of all times,
    of which flights are independent."""
    keys = {"pose_dropout": lost} if make is ImuMocap else {"gnss_dropout": lost}
    run, states = AidedRun(make(**keys), backend="compiled"), motion(np.arange(0, 20 + 1e-9, 1e-3), seed=path)
    nees = np.array([run.go(states, seed).nees(states) for seed in range(50)])
    low, high = chi2.interval(0.95, 15 * 50)
    inside = (nees.sum(0) > low) & (nees.sum(0) < high)
    assert inside.mean() > 0.85
    flights = nees.mean(1)  # one number a flight
    assert abs(flights.mean() - 15) < 2.5 * flights.std(ddof=1) / np.sqrt(50)


@pytest.mark.slow
@both_sensors
def test_with_rates_that_divide_nothing(make):
    unit = {"imu_rate": 208.0}
    keys = {"pose_rate": 77.0, "pose_delay": 0.0} if make is ImuMocap else {"gnss_rate": 7.3, "gnss_delay": 0.0}
    run = AidedRun(make(**unit, **keys), period=1 / 60, steps=17, backend="compiled")
    t = np.arange(0, 5, 1 / 60 / 17)
    states = motion(t[: (len(t) - 1) // 17 * 17 + 1], seed=4)
    assert_in_band(np.array([run.go(states, seed).nees(states)[-1] for seed in range(200)]))


@both_sensors
def test_a_delay_only_delays(make):
    """With the same draws, the filter of late fixes is where that of prompt ones was, to the last digits."""
    states = motion(np.arange(0, 1 + 1e-9, 1e-3), seed=6)
    prompt, late = ({"pose_delay": d} if make is ImuMocap else {"gnss_delay": d} for d in (0.0, 0.05))
    prompt, late = (AidedRun(make(**keys)).go(states, seed=3) for keys in (prompt, late))
    assert (prompt.behind, late.behind) == (0, 10)
    assert np.allclose(late.nominal[5:], prompt.nominal[:-5], rtol=0, atol=1e-13)
    assert np.allclose(late.covariance[5:], prompt.covariance[:-5], rtol=1e-12, atol=0)
    truth = states[10::10]
    assert np.abs(late.inputs - truth)[50:, POSITION].max() < 10 * np.abs(prompt.inputs - truth)[50:, POSITION].max()


@both_sensors
@pytest.mark.parametrize(("rate", "steps"), [(200.0, 10), (300.0, 7)])
def test_without_noise_the_truth_is_told(make, rate, steps):
    """Also where the IMU's readings do not divide the steps of the plant evenly.

    Without errors of sensors only the trapezoidal rule's is left, of position, which passes for one of velocity.
    """
    unit = dict(accelerometer_noise_density=0.0, gyroscope_noise_density=0.0, imu_rate=rate, **NO_BIAS)
    keys = (
        {"pose_position_noise": 1e-9, "pose_attitude_noise": 1e-9}
        if make is ImuMocap
        else {"gnss_position_noise": (1e-9,) * 3, "gnss_velocity_noise": (1e-9,) * 3, "heading_noise": 1e-9}
    )
    states = motion(np.arange(100 * steps + 1) * 0.01 / steps, seed=7)
    run = AidedRun(make(**unit, **keys), steps=steps).go(states)
    truth = states[steps::steps]
    e = errors(np.hstack([run.inputs[:, :10], np.zeros((100, 6))]), truth, np.zeros((100, 6)))
    assert np.abs(e[:, :6]).max() < 5e-5 and np.abs(e[:, 6:]).max() < 1e-6
    last = steps - round(steps * (rate * 0.01 - 1) / (rate * 0.01))  # steps of the last reading's interval
    halfway = motion(np.arange(1, 101) * 0.01 - last * 0.005 / steps, seed=7)
    assert np.abs(run.inputs[:, RATE] - halfway[:, RATE]).max() < 1e-4


def test_at_first_the_errors_are_drawn_from_the_first_covariance():
    run, states = AidedRun(ImuGnss()), standing(np.arange(11))
    found = []
    for seed in range(100):
        run.go(states, seed)
        found.append(errors(np.r_[run.first[:10], np.zeros(6)][None], states[:1], np.zeros((1, 6)))[0, :9])
    expected = run.filter.first_deviations(GRAVITY)[:9]
    assert np.allclose(np.sqrt(np.mean(np.square(found), axis=0)), expected, rtol=0.25)
    assert np.allclose(expected, [0.0085, 0.0085, 0.015, *[0.05] * 3, *[0.05 / GRAVITY] * 2, 0.035])


@both_sensors
def test_after_standing_the_errors_are_those_of_the_covariance(make):
    """At once, of 100 flights that begin at any heading, with the biases that the sensors have anyway."""
    run, found = AidedRun(make(), Navigation()), []
    for seed in range(100):
        states = standing(np.arange(11))
        states[:, 3:7] = Rotation.from_euler("z", 0.1 * seed).as_quat(scalar_first=True)
        run.go(states, seed)
        start = run.at_first
        e = errors(start[None, :16], states[:1], run.bias_at_first[None])[0]
        found.append(e @ np.linalg.solve(full(start[None, 16:N_KNOWN])[0], e))
    assert_in_band(np.array(found))


@both_sensors
def test_standing_is_what_the_filter_itself_makes_of_standing(make):
    """The covariance of `warm_up` is that of a run at rest, but for its nominal state, which the noise tilts.

    Over eight seeds the worst entry is off by 0.4 to 4 % for that, with this one by 0.4 %.
    """
    still = {"accelerometer_bias_walk": 0.0, "gyroscope_bias_walk": 0.0}
    none = {"pose_dropout": 0.0, "pose_delay": 0.0} if make is ImuMocap else {"gnss_dropout": 0.0, "gnss_delay": 0.0}
    states = standing(np.arange(0, 5 + 1e-9, 1e-3))
    stood = AidedRun(make(**still, **none)).go(states, seed=3)
    at_once = AidedRun(make(**still, **none), Navigation(warm_up=5.0)).go(states[:11])
    first = full(at_once.at_first[None, 16:N_KNOWN])[0]
    assert np.allclose(np.diag(first), np.diag(stood.covariance[-1]), rtol=5e-3, atol=0)


def test_the_rates_told_are_without_the_gyroscopes_bias():
    run = AidedRun(ImuMocap(gyroscope_bias_std=0.05)).go(standing(np.arange(0, 3 + 1e-9, 1e-3)), seed=2)
    assert np.abs(run.bias[-1, 3:]).max() > 0.02
    assert np.abs(run.inputs[200:, RATE].mean(0)).max() < 1e-3


def test_factors_scale_what_the_filter_believes_and_nothing_else():
    settings = Navigation(process_factor=2.0, measurement_factor=3.0)
    plain, changed = (AidedRun(ImuMocap(), one).filter.believed(GRAVITY) for one in (Navigation(), settings))
    assert np.allclose(changed / plain, [1, 2, 2, 2, 2, 3, 3])


def test_rates_that_cannot_be_are_refused():
    with pytest.raises(UsageError, match=r"sensor.pose_rate=300: must be at most sensor.imu_rate=200 Hz"):
        ImuMocap(pose_rate=300.0)
    with pytest.raises(UsageError, match=r"sensor.imu_rate=2000: the plant makes 1000 integration steps a second"):
        ImuMocap(imu_rate=2000.0).readings(Clock(0.01, 10))
