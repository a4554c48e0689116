"""The disturbance filter: against an extended Kalman filter written out, and on readings of known disturbances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quadexp.control.control_step import run
from quadexp.models.residual import no_residual
from quadexp.parts.sensor_spec import SensorSpec, Stated
from quadexp.physics.state import RATE
from quadexp.plugins.auto.disturbance import DEVIATIONS, DisturbanceFilter
from quadexp.plugins.auto.settings import DISTURBANCE, SPEEDS
from quadexp.plugins.auto.sources import FORCE, N_ESTIMATE, SCALE, sources, speeds_tell

PERIOD, NOISE = 0.02, 0.05


class Watched:
    """A filter of a vehicle without drag in hover, given exact thrusts."""

    def __init__(self, vehicle, *, by_speeds=False, timing=0.0):
        model = no_residual(vehicle)
        known = sources(vehicle, SensorSpec(accelerometer=Stated(NOISE)), 0.0, by_speeds=by_speeds)
        told = {"lateral": np.array([NOISE**2]), "noise": np.zeros(3)}
        told |= {"timing": np.array([timing]), "apart": np.zeros(1)}
        self.about = told
        self.filter = DisturbanceFilter(vehicle, model, model.theta, PERIOD, "interpreted", known, told)
        hover = np.full(vehicle.n_rotors, vehicle.hover_thrust)
        self.inputs = {"x": np.eye(13)[3].copy(), "reading": np.zeros(3), "thrust": hover, "mean": hover.copy()}
        self.read, self.k = np.zeros(1), 0
        self.calls = self.filter.before(self.inputs, self.read)
        self.filter.memory.begin(self.filter.start(self.inputs["x"]))
        self.vehicle = vehicle

    def step(self, acceleration, read=True):
        """One instant in which this acts beside the thrust (m/s^2); its belief of the force (N)."""
        self.inputs["reading"][:] = np.array([0.0, 0.0, self.vehicle.gravity]) + acceleration
        self.read[0] = read
        run(self.calls, self.k)
        self.filter.memory.commit()
        self.k += 1
        return self.filter.belief[:3].copy()


def test_nothing_is_believed_of_noise_and_a_push_at_once(vehicle, rng):
    watched = Watched(vehicle)
    for _ in range(200):
        assert not watched.step(rng.normal(0, NOISE, 3)).any()
    push = np.array([1.5, -1.0, 0.0])
    for _ in range(10):
        force = watched.step(push + rng.normal(0, NOISE, 3))
    assert watched.filter.acts[0] == 1 and force[:2] == pytest.approx(vehicle.mass * push[:2], rel=0.1)
    for _ in range(300):
        force = watched.step(rng.normal(0, NOISE, 3))
    assert watched.filter.acts[0] == 0 and not force.any()  # and not for longer than it lasts


def test_a_push_after_long_is_found_as_soon_as_an_early_one(vehicle):
    """Evidence of a quiet past does not count."""
    instants = []
    for quiet in (50, 3000):
        watched, generator = Watched(vehicle), np.random.default_rng(4)
        for _ in range(quiet):
            watched.step(generator.normal(0, NOISE, 3))
        pushed = range(50)
        instants.append(next(i for i in pushed if watched.step(np.array([1.0, 0.0, 0.0])).any()))
    assert instants[0] == instants[1] <= 3


def test_a_missing_reading_is_a_prediction_without_an_update(vehicle):
    """In which a force fades: held, it was of the heading that was flown last, and an accelerometer that ended at 8 s
    made geometric 2.2 times worse than without."""
    watched = Watched(vehicle)
    for _ in range(50):
        before = watched.step(np.array([1.0, 0.0, 0.0]))
    for i in range(1, 26):
        faded = before * np.exp(-i * PERIOD / DISTURBANCE.unseen)
        assert watched.step(np.array([9.0, 9.0, 9.0]), read=False) == pytest.approx(faded)
    spread = watched.filter.deviations[DEVIATIONS.index("force_x_sd")]
    watched.step(np.array([1.0, 0.0, 0.0]))
    assert watched.filter.deviations[DEVIATIONS.index("force_x_sd")] < spread  # which grew meanwhile


def test_a_force_along_the_thrust_needs_a_known_time_of_the_thrusts(vehicle):
    for timing, found in ((2 * DISTURBANCE.timed, False), (0.0, True)):
        watched = Watched(vehicle, timing=timing)
        for _ in range(60):
            force = watched.step(np.array([0.0, 0.0, -2.0]))
        assert (force[2] < -1.0 * vehicle.mass) == found == bool(watched.filter.acts[1])


def test_a_noise_of_thrust_grows_with_the_thrust(vehicle, rng):
    """A perfect model was corrected on the fast half of a lemniscate: rotors that are off by 3 % of their thrust were a
    force at 2.3 times the weight, and the error twice that of the slow half."""
    watched = Watched(vehicle)
    thrust = 2.3
    for name in ("thrust", "mean"):
        watched.inputs[name][:] = thrust * vehicle.hover_thrust
    for _ in range(400):
        off = 0.03 * thrust * rng.normal() * vehicle.gravity
        watched.step(np.array([0.0, 0.0, (thrust - 1) * vehicle.gravity + off]))
        assert not watched.filter.acts[1]


def test_a_torque_needs_age_and_delays_that_are_told_apart(vehicle):
    """Two of 96 wider draws were lost by a torque that swung with the vehicle: of 44 ms of age 6 were assumed."""
    for apart, found in ((2 * DISTURBANCE.torque_timed, False), (0.0, True)):
        watched = Watched(vehicle)
        watched.about["apart"][0] = apart
        for k in range(60):
            watched.inputs["x"][RATE] = 0.02 * k, 0.0, 0.0  # 1 rad/s^2 that no command asks for
            watched.step(np.zeros(3))
        assert bool(watched.filter.acts[2]) == found


def test_the_force_is_that_of_an_extended_kalman_filter(vehicle, rng):
    """Written out for the faster walk, without gates: the model has no drag, so that it is linear in hover."""
    vehicle = replace(vehicle, thrust_coefficient=1e-6)
    watched = Watched(vehicle, by_speeds=True)  # assumed from the first reading on
    initial = [*[DISTURBANCE.force_initial] * 3, SPEEDS.scale_initial]
    walk = np.diag([*[SPEEDS.force_walk**2] * 3, DISTURBANCE.scale_walk**2]) * PERIOD
    P, estimate = np.diag(np.square(initial)), np.zeros(4)
    H = np.hstack([np.eye(3), [[0.0], [0.0], [vehicle.gravity]]])
    least = (SPEEDS.force_walk / SPEEDS.most_force_bandwidth) ** 2 / PERIOD
    N = np.eye(3) * max(NOISE**2, least)
    for _ in range(40):
        acceleration = np.array([0.3, -0.2, 0.1]) + rng.normal(0, NOISE, 3)
        watched.step(acceleration)
        P = P + walk
        S = H @ P @ H.T + N
        innovation = acceleration - H @ estimate
        assert innovation @ np.linalg.solve(S, innovation) < DISTURBANCE.surprise**2
        K = P @ H.T @ np.linalg.inv(S)
        estimate, P = estimate + K @ innovation, (np.eye(4) - K @ H) @ P
    fast = watched.filter.memory.of_now["estimate"][N_ESTIMATE:]
    assert fast[FORCE] == pytest.approx(estimate[:3], rel=1e-6) and fast[SCALE] == pytest.approx(estimate[3], rel=1e-6)


def test_rotor_speeds_tell_where_they_come_often_enough(vehicle):
    vehicle = replace(vehicle, thrust_coefficient=1e-6)
    assert speeds_tell(vehicle, SensorSpec(rotor_speed=Stated(0.02, delay=0.01)))
    for other in (SensorSpec(), SensorSpec(rotor_speed=Stated(rate=SPEEDS.least_rate / 4))):
        assert not speeds_tell(vehicle, other)
