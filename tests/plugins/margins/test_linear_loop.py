"""The linear loop: analytic cases, the bare MPC's former margins, and flights at hover on both sides of a margin."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from quadexp.experiment.evaluate import build_loop
from quadexp.experiment.rollout import SampledReference, fly
from quadexp.parts.compose import compose
from quadexp.plugins.margins.linear_loop import LinearLoop, Phase
from quadexp.plugins.margins.loop_margins import SLOW, hover_loop, margins
from quadexp.reference.hover import Hover
from quadexp.world.streams import Silence
from quadexp.world.world import World


# ------------------------------------------------------------------------------------------------------ analytic cases
def saturated_count(period: float, *constants: float) -> tuple[np.ndarray, np.ndarray]:
    """A double integrator behind first-order lags of some time constants, with an input held for a period."""
    F = np.zeros((3 + len(constants), 3 + len(constants)))
    F[0, 1], F[1, 2] = 1.0, 1.0
    for i, constant in enumerate(constants, 2):
        F[i, i], F[i, i + 1] = -1 / constant, 1 / constant
    whole = expm(period * F)
    return whole[:-1, :-1], whole[:-1, -1:]


def pd_loop(kp: float, kd: float, period: float) -> LinearLoop:
    A, B = saturated_count(period)
    return LinearLoop([Phase(A, B, -np.array([[kp, kd]]))], period, np.ones(2, bool), np.zeros(2, bool))


def test_margins_of_a_double_integrator_under_pd_control():
    """s^2 (1 + tau s) + kd s + kp is stable for tau < kd / kp; with kp = w^2 and kd = 2 d w the gain is 1 at
    w sqrt(2 d^2 + sqrt(4 d^4 + 1)), where atan(kd w / kp) of phase are left. A held command is T / 2 late."""
    kp, kd, period = 9.0, 4.2, 1e-3
    known = margins(pd_loop(kp, kd, period))
    d2 = (kd / (2 * math.sqrt(kp))) ** 2
    crossing = math.sqrt(kp * (2 * d2 + math.sqrt(4 * d2**2 + 1)))
    assert known["delay"] == pytest.approx(math.atan(kd * crossing / kp) / crossing - period / 2, rel=2e-3)
    assert known["lag"] == pytest.approx(kd / kp - period / 2, rel=3e-3)
    assert known["growth"] == pytest.approx(-kd / 2, rel=5e-3)


def test_numbers_that_are_always_equal_are_one():
    """Commands that a filter, a prediction and an MPC keep each for itself were 86 of 206 numbers, and a margin cost
    half the flight. The loop is the same."""
    A, B = saturated_count(0.05)
    own, copies, kept = 2, 3, 5
    size = own + copies * kept
    whole, drive, gain = np.zeros((size, size)), np.zeros((size, 1)), np.zeros((1, size))
    whole[:own, :own], drive[:own], gain[0, :own] = A, B, [-9.0, -4.2]
    for first in range(own, size, kept):  # the last commands, the newest first, each copy with another weight
        whole[first + 1 : first + kept, first : first + kept - 1] = np.eye(kept - 1)
        drive[first], gain[0, first + kept - 1] = 1.0, 0.01 * first
    several = LinearLoop([Phase(whole, drive, gain)], 0.05, np.arange(size) < own, np.zeros(size, bool))
    left = [*range(own + kept)]
    gain[0, own + kept - 1] = gain[0, own + kept - 1 :: kept].sum()
    single = Phase(whole[np.ix_(left, left)], drive[left], gain[:, left])
    once = LinearLoop([single], 0.05, np.arange(len(left)) < own, np.zeros(len(left), bool))
    assert len(several.phases[0].A) == len(once.phases[0].A) == own + kept
    for late in ({}, {"delay": 0.03}, {"lag": 0.02}):
        assert several.growth(**late) == pytest.approx(once.growth(**late), rel=1e-9)


@pytest.mark.parametrize("period", [0.05, 0.2])
def test_delays_and_lags_of_a_sampled_loop_are_exact(period):
    """Against the same loop written out: two commands act in a period, one after the other; a lag is a state."""
    kp, kd = 9.0, 4.2
    loop, K = pd_loop(kp, kd, period), np.array([[kp, kd]])

    def late(delay: float) -> float:
        whole, rest = divmod(delay, period)
        whole = int(whole)
        (A1, B1), (A2, B2) = saturated_count(rest), saturated_count(period - rest)
        M = np.zeros((4 + whole, 4 + whole))[: 3 + whole, : 3 + whole]
        M[:2, :2] = A2 @ A1
        commands = np.vstack([np.hstack([-K, np.zeros((1, 1 + whole))]), np.eye(3 + whole)[2:]])
        M[:2] += A2 @ B1 @ commands[whole + 1 : whole + 2] + B2 @ commands[whole : whole + 1]
        M[2:] = commands[: 1 + whole]
        return math.log(np.abs(np.linalg.eigvals(M)).max()) / period

    def lagging(lag: float) -> float:
        A, B = saturated_count(period, lag)
        return math.log(np.abs(np.linalg.eigvals(A - B @ np.hstack([K, [[0.0]]]))).max()) / period

    for time in (0.3 * period, period, 1.7 * period, 3.2 * period):
        assert loop.growth(delay=time) == pytest.approx(late(time), abs=1e-6)
    for time in (0.1 * period, period, 5 * period):
        assert loop.growth(lag=time) == pytest.approx(lagging(time), rel=2e-3, abs=2e-3)
    known = margins(loop)
    assert late(0.99 * known["delay"]) < 0 < late(1.01 * known["delay"])
    assert lagging(0.99 * known["lag"]) < 0 < lagging(1.01 * known["lag"])


def test_a_loop_at_two_rates_is_that_of_the_slow_one():
    """A command that is computed at every third instant and held is a loop at a third of the rate."""
    kp, kd, period = 9.0, 4.2, 0.03
    A, B = saturated_count(period)
    K, z = -np.array([[kp, kd]]), np.zeros
    body = np.block([[A, z((2, 1))], [z((1, 2)), np.eye(1)]])  # what is held is remembered
    first = Phase(
        np.vstack([body[:2], np.hstack([K, z((1, 1))])]), np.vstack([B, z((1, 1))]), np.hstack([K, z((1, 1))])
    )
    other = Phase(body, np.vstack([B, z((1, 1))]), np.array([[0.0, 0.0, 1.0]]))
    smooth, direct = np.array([True, True, False]), np.zeros(3, bool)
    fast, slow = LinearLoop([first, other, other], period, smooth, direct), pd_loop(kp, kd, 3 * period)
    assert fast.growth() == pytest.approx(slow.growth(), rel=1e-9)
    one, other = margins(fast), margins(slow)
    assert one["delay"] == pytest.approx(other["delay"], rel=2e-3)
    assert one["lag"] == pytest.approx(other["lag"], rel=1e-2)


def test_what_is_not_between_command_and_command_is_no_part_of_the_loop():
    """An integrator of the position that nobody reads, and one that the command drives and nobody reads, do not count;
    nor does a covariance that grows by itself."""
    kp, kd, period = 9.0, 4.2, 0.05
    A, B = saturated_count(period)
    A, B = np.block([[A, np.zeros((2, 2))], [np.eye(2), 1.5 * np.eye(2)]]), np.vstack([B, [[1.0], [0.0]]])
    C = np.array([[-kp, -kd, 0.0, 0.0]])
    loop = LinearLoop([Phase(A, B, C)], period, np.array([True, True, False, False]), np.zeros(4, bool))
    assert len(loop.phases[0].A) == 2 and loop.growth() == pytest.approx(pd_loop(kp, kd, period).growth(), rel=1e-9)


# ------------------------------------------------------------------------------------------------- loops that are flown
def flown(*words: str):
    """Plant and controller of a hover, whatever its loop is like."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("quadexp.plugins.margins.loop_margins.instability", lambda *_: "")
        return build_loop(compose(["trajectory=hover", *words]), None)


@pytest.mark.parametrize(
    ("settings", "delay", "lag"),
    [
        ("first_node=0.02", 16.83, 44.63), ("first_node=0.04", 33.13, 66.50), ("first_node=0.06", 46.18, 78.97),
        ("first_node=0.08", 56.79, 86.70), ("first_node=0.0", 66.62, 93.47),
    ],
)  # fmt: skip
def test_the_bare_mpc_has_the_margins_that_another_program_found(settings, delay, lag):
    """In ms; that one discretised the controller's own model exactly."""
    loop = flown("controller=nominal_mpc", "plant=ideal", f"controller.{settings}")
    known = margins(hover_loop(loop.controller, loop.plant))
    assert 1e3 * known["delay"] == pytest.approx(delay, rel=2e-3) and 1e3 * known["lag"] == pytest.approx(lag, rel=2e-3)


def test_the_loop_of_auto_is_the_one_that_it_flies_once_the_delays_are_found():
    """With the sums from which they are found a law had 2,297 states, more than are linearised."""
    loop = flown("controller=geometric", "remedies=auto", "plant=ideal")
    ((A, *_), *_) = hover_loop(loop.controller, loop.plant).phases
    assert len(A) == 12


NOISELESS = "estimator.position_noise=0 estimator.velocity_noise=0 estimator.attitude_noise=0 estimator.rate_noise=0"
# Controller x compensation x vehicle x world x rate. Motors lag as much up as down: otherwise nothing is linear at
# rest.
COMBINATIONS = {
    "published": "controller=nominal_mpc",
    "observer": "controller=nominal_mpc observer=disturbance",
    "indi": "controller=nominal_mpc rate_loop=indi",
    "strapdown": "controller=nominal_mpc horizon=robust estimator=late estimator.delay=0.03 delay=strapdown"
    " delay.time=0.03 estimator.gyro=fresh",
    "geometric": "controller=geometric",
    "states": "controller=nominal_mpc horizon=robust motor=states controller.dead_time=0.01 actuator=lag_30ms"
    " link=latency",
    "precise": "controller=nominal_mpc horizon=precise",
    "stiff": "controller=nominal_mpc horizon=stiff",
    "dead_time": "controller=nominal_mpc horizon=robust controller.dead_time=0.02 link=latency link.latency=0.02",
    "lead": "controller=nominal_mpc horizon=robust motor=lead actuator=lag_30ms",
    "offset_free": "controller=nominal_mpc remedies=offset_free",
    "wind": "controller=perfect_mpc remedies=wind",
    "told": "controller=perfect_mpc horizon=robust motor=states observer=wind observer.targets=false delay=prediction"
    f" controller.dead_time=0.01 delay.time=0.01 world=everything wind=none battery=none {NOISELESS}",
    "everything": f"controller=nominal_mpc world=everything wind=none battery=none {NOISELESS}",
    "race": f"controller=nominal_mpc world=race battery=none link.jitter=0 {NOISELESS}"
    " actuator.time_constant_down=0.0125",
    "scales_indi": "controller=nominal_mpc observer=disturbance observer.force_bandwidth=100 observer.force_limit=50"
    " observer.torque_bandwidth=0 observer.scale_walk=0.005 observer.air_walk=0.01 rate_loop=indi rate_loop.cutoff=30",
    "l1": "controller=nominal_mpc adaptive=l1",
    "prediction": "controller=nominal_mpc horizon=robust estimator=late estimator.delay=0.03 delay=prediction"
    " delay.time=0.03",
    "late": "controller=nominal_mpc horizon=robust estimator=late estimator.delay=0.03",
    "rate_100": "controller=nominal_mpc controller.rate=100",
    "rate_25": "controller=nominal_mpc controller.rate=25",
    "geometric_indi": "controller=geometric rate_loop=indi",
    "geometric_observer": "controller=geometric observer=disturbance",
    "geometric_l1": "controller=geometric adaptive=l1",
    "geometric_prediction": "controller=geometric estimator=late delay=prediction observer=disturbance",
    "dfbc": "controller=dfbc",
    "pid": "controller=pid",
    "blade_element": "vehicle=lei_li plant=blade_element controller=nominal_mpc plant.motor_lag=0.04 horizon=robust",
    "rls_mpc": "vehicle=lei_li plant=blade_element controller=rls_mpc",
    "hummingbird": "vehicle=hummingbird controller=nominal_mpc",
    "crazyflie": "vehicle=crazyflie controller=nominal_mpc",
}
QUICK = 6  # of them in every run of the tests


def grows(words: list[str]) -> bool:
    """Whether the difference of two flights, which begin a little apart, grows; there is no noise."""
    loop, states, duration = flown(*words), [], 5.0
    for sign in (1, -1):
        start = np.eye(13)[3] + 1e-7 * sign * np.array([2, 1.3, 1, 0, 2, 1.1, -1, 0, 0, 0, 0, 0, 0])
        reference = SampledReference(Hover(position=(0, 0, 0), duration=duration), loop.controller)
        flight = fly(loop.plant, loop.controller, reference, Silence(), start=start, lost_distance=50.0)
        states.append(flight.state)
    apart = np.abs(states[0] - states[1])[:, np.arange(13) != 3].max(axis=1)
    quarter = len(apart) // 4
    far = apart.max() > 1e3 * apart[0]  # and may have come to a limit since
    return bool(far or apart[-quarter:].max() > apart[quarter : 2 * quarter].max())


@pytest.mark.parametrize("kind", ["delay", "lag"])
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (i >= QUICK)) for i, name in enumerate(COMBINATIONS)]
)
def test_flights_decay_below_a_margin_and_grow_above(name, kind):
    """10 % on both sides, with everything that is in the loop."""
    words = COMBINATIONS[name].split()
    loop = flown(*words)
    plant = loop.plant
    if kind == "lag" and (getattr(plant, "loop_lag", 0.0) or name in ("blade_element", "scales_indi")):
        pytest.skip("motors have one lag, and this observer refuses those of an unknown one")
    known = margins(hover_loop(loop.controller, plant))
    assert known["growth"] <= SLOW and known[kind] > 0
    effects = plant.effects if isinstance(plant, World) else ()
    link = sum(effect.loop_delay for effect in effects if effect.stage == "link")
    for share in (0.9, 1.1):
        time = share * known[kind]
        more = [f"link.latency={link + time}"] + ["link=latency"] * (not link)
        if kind == "lag":
            more = ["actuator=lag_30ms", f"actuator.time_constant_up={time}", f"actuator.time_constant_down={time}"]
        assert grows([*words, *more]) == (share > 1), (share, known)
