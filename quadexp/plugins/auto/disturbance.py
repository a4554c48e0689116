"""Disturbance: an extended Kalman filter over [wind, thrust scale, force, air scale], and one over [rate, torque].

    w' = noise,  k' = noise,  a' = noise,  c' = noise                          w: wind, a: force over the mass
    f = (1 + c) a_air(R'(v - w), (1 + k) u) + (1 + k) T e_z / m + R' a + noise                 f: accelerometer
    omega' = J^-1 (tau - omega x J omega) + alpha + noise,   alpha' = noise                    alpha: torque over J

The air scale is estimated where rotor speeds tell the thrusts, the wind where the model has a drag that shows it, and
otherwise the force walks as fast in its place. Each filter runs for a few walks: multiple models (Magill 1965). Which
one is assumed, and whether any, is decided at every instant for the part across the thrust, that along it and the
torque apart. Any is where the log likelihood ratio of one against none, fading in noise_memory and never below zero,
so that a quiet past does not count, is above evidence_on, until it is back at zero (generalised likelihood ratio,
Willsky & Jones 1976; cumulative sum, Page 1954). Likelihoods are -(e' S^-1 e + log det S) / 2 of innovations e, S with
sheet_factor^2 of the noise, since models are never exact. The walk is the likeliest, across the thrust that with the
least mean squared innovation. A missing reading is a prediction without an update.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quadexp.compile.memory import NEXT, NOW, Memory, connected, sizes_of
from quadexp.compile.symbolic import ca
from quadexp.control.base import N_BELIEF, no_belief
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, call
from quadexp.models.residual import Residual
from quadexp.parts.sensor_spec import SensorSpec, Stated
from quadexp.physics.expression import limited, named_function, named_symbols
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.auto.settings import DISTURBANCE, INTERVAL, SPEEDS, TINY
from quadexp.plugins.remedies.observers.filters import STATED, inverse
from quadexp.plugins.remedies.sent_commands import INSTANT

WIND, SCALE, FORCE, AIR, N_ESTIMATE = slice(0, 3), 3, slice(4, 7), 7, 8
WALKS, TORQUES = len(DISTURBANCE.walk_factors), 1 + len(DISTURBANCE.torque_bandwidths)  # without a torque first
# m/s, N, s by which the force is behind, 1
DEVIATIONS = (*(f"{of}_{axis}_sd" for of in ("wind", "force") for axis in "xyz"), "force_lag", "thrust_scale_sd")
SIZES = {
    "estimate": N_ESTIMATE * WALKS,
    "covariance": N_ESTIMATE**2 * WALKS,
    "rates": 3 * TORQUES,
    "torque": 3 * TORQUES,
    "evidence": 2 * WALKS,
    "squares": 2 * WALKS,
    "torque_evidence": TORQUES - 1,
    "acts": 3,
    "thrust": 1,
    "slope": 1,
}
OF_ROTORS = "thrusts"  # the last ones by rotor speeds (N), remembered too


class Sources(NamedTuple):
    """What a disturbance is found from. has_drag: whether the model's drag tells a wind; by_speeds: whether rotor
    speeds tell the thrusts. walk, initial: deviations of each number of the estimate, a root of a second, and as a
    flight begins. reading: least noise of the accelerometer (m/s^2). thrust: noise of the model along the thrust, as a
    share of it. wind_offset, wind_untimed, force_offset: what a wind is off by for a slow error of sensors, and upward
    for thrusts of an unknown time (m/s), and what an acceleration is (m/s^2)."""

    has_drag: bool
    by_speeds: bool
    random_walk: tuple[float, ...]
    initial: tuple[float, ...]
    reading: float
    thrust: float
    wind_offset: float
    wind_untimed: float
    force_offset: float


def speeds_tell(vehicle: Vehicle, sensor_spec: SensorSpec) -> bool:
    """Whether the speeds of all rotors are given, often enough, and what thrusts they are."""
    speeds = sensor_spec.rotor_speed
    return speeds is not None and vehicle.thrust_coefficient is not None and not 0 < speeds.rate < SPEEDS.least_rate


def sources(vehicle: Vehicle, sensor_spec: SensorSpec, slope: float, *, by_speeds: bool) -> Sources:
    """slope: acceleration by wind where the vehicle hovers in a breeze (1/s); 0: no drag tells a wind."""
    s, random_walk, initial = DISTURBANCE, np.zeros(N_ESTIMATE), np.zeros(N_ESTIMATE)
    random_walk[FORCE], initial[FORCE], initial[SCALE] = s.force_walk, s.force_initial, s.scale_initial
    random_walk[SCALE] = s.scale_walk
    if by_speeds:
        random_walk[FORCE], random_walk[AIR], initial[AIR] = SPEEDS.force_walk, SPEEDS.air_walk, SPEEDS.air_initial
        initial[SCALE] = SPEEDS.scale_initial
    elif slope:
        random_walk[WIND], initial[WIND] = s.wind_walk, s.wind_initial
        random_walk[FORCE], initial[FORCE] = s.force_walk_beside_wind, s.force_initial_beside_wind
    reading = sensor_spec.accelerometer or Stated()
    tilted = sensor_spec.attitude or Stated()
    turned = sensor_spec.rotor_speed or Stated()
    offset = math.hypot(reading.drift, vehicle.gravity * tilted.drift)
    noise = math.hypot(max(reading.noise, s.reading_noise), s.tilt_to_acceleration * tilted.noise)
    thrust = 2 * turned.noise / math.sqrt(vehicle.n_rotors) if by_speeds else s.thrust_noise
    wind = (math.hypot(offset / slope, INTERVAL.least_wind), INTERVAL.untimed_noise / slope) if slope else (0.0, 0.0)
    return Sources(slope > 0, by_speeds, tuple(random_walk), tuple(initial), noise, thrust, *wind, offset)


class DisturbanceFilter:
    """Its calls stand `before` the controller's; `start` begins a flight.

    belief: (11,), see control.base.Belief. deviations: see DEVIATIONS. acts: (3,), whether a disturbance across the
    thrust, one along it, and a torque are assumed. given: arrays of the uncertainty of the commands' delay, timing, by
    which age and delays cannot be distinguished, `apart`, by which an age is off that acts, `late`, of age, dead time
    and lag that act, `delays` (s), and of variances that a bank has measured, lateral, noise.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        residual: Residual,
        theta: np.ndarray,
        period: float,
        backend: str,
        known: Sources,
        told: dict[str, np.ndarray],
    ) -> None:
        air = (residual.unscaled or residual).form(backend == "compiled")
        self._function = cached_function(backend, disturbance_function, vehicle, air, period, known)
        self.memory = Memory("Disturbance", sizes_of([self._function]))
        self._places = told.copy()
        self._places["theta"] = theta.reshape(-1)[: self._function.numel_in("theta")]
        self._initial = np.square(known.initial)
        self.belief, self.deviations = np.zeros(N_BELIEF), np.zeros(len(DEVIATIONS))
        self.acts = self.memory.of_now["acts"]

    def assume_nothing(self) -> None:
        """As a flight begins."""
        self.belief[...], self.deviations[...] = np.hstack([*no_belief()]), np.nan

    def start(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """What is remembered as a flight begins in the state x, (13,)."""
        return {"covariance": np.tile(np.diag(self._initial).ravel(), WALKS), "rates": np.tile(x[RATE], TORQUES)}

    def before(self, known: dict[str, np.ndarray], read: np.ndarray) -> list[Call]:
        """Leaves belief and deviations. known: arrays with the state x (13,), the reading (3,), thrust and mean,
        delivered then and over the last period, (n,) (N), of one time."""
        given, found = {**self._places, **known, "read": read}, {"belief": self.belief, "deviations": self.deviations}
        return [call(connected(self._function, given, found, self.memory))]


def disturbance_function(vehicle: Vehicle, air: ca.Function, period: float, known: Sources) -> ca.Function:
    """Memory, belief and deviations after an instant; see DisturbanceFilter. noise: of the bank, variances of a reading
    across the thrust, of position and attitude. Memory: SIZES, and whether anything has been read."""
    n, s = vehicle.n_rotors, DISTURBANCE
    sizes = SIZES | {OF_ROTORS: n}
    shapes = {NOW + name: size for name, size in sizes.items()} | {f"{NOW}flown": 1}
    shapes |= {"x": N_STATE, "reading": 3, "read": 1, "thrust": n, "mean": n}
    shapes |= {"lateral": 1, "noise": 3, "timing": 1, "apart": 1, "late": 1, "delays": 3, "theta": air.size1_in(1)}
    a = named_symbols(ca.MX, shapes)
    kept = {name: a[NOW + name] for name in sizes}
    x, read, thrust = a["x"], a["read"], a["thrust"]
    R, rate, specific = rotation_matrix(x[ATTITUDE]), x[RATE], ca.sum1(thrust) / vehicle.mass
    fading = math.exp(-period / s.noise_memory)

    # noise: of the sensors as measured, and along the thrust what the time of the thrusts leaves unknown
    change = (specific - kept["thrust"]) / period * (kept["thrust"] > 0)
    slope = kept["slope"] + (change**2 - kept["slope"]) / s.slope_memory
    tilt = s.tilt_to_acceleration**2 * ca.fmax(a["noise"][2], 0)
    across = ca.fmax(ca.fmax(a["lateral"], s.reading_noise**2) + tilt, known.reading**2 * known.by_speeds)
    timing = 0 if known.by_speeds else ca.fmin(a["timing"], s.unknown_timing)
    misdated = timing**2 * slope
    of_thrust = (known.thrust * ca.fmax(specific, vehicle.gravity)) ** 2
    along = of_thrust + misdated
    # no force is followed faster than most_force_bandwidth, which is q / (r sqrt(T)) of a random walk
    fastest = SPEEDS.most_force_bandwidth if known.by_speeds else s.most_force_bandwidth
    least = (max(known.random_walk[FORCE]) / fastest) ** 2 / period
    variance = ca.fmax(ca.vertcat(across, across, across + along), least * ca.DM([not known.has_drag] * 2 + [1]))
    N = ca.diag(variance)
    doubted = s.sheet_factor**2 * across
    doubt = ca.diag(ca.vertcat(doubted, doubted, doubted + along))

    along_body = ca.DM.eye(3) if known.has_drag else R.T  # what a wind leaves is of the thrust

    def expected(estimate: ca.MX) -> tuple[ca.MX, ca.MX, ca.MX]:
        """Reading, its Jacobian by the estimate, and torque of the air."""
        scale, more = 1 + estimate[SCALE], 1 + estimate[AIR]
        z = ca.vertcat(ca.mtimes(R.T, x[VELOCITY] - estimate[WIND]), rate, scale * thrust)
        y, by_z = (ca.densify(one) for one in air(z, a["theta"]))
        lift = ca.vertcat(0, 0, specific)
        by_scale = lift + more * ca.mtimes(by_z[:3, 6:], thrust)
        H = ca.horzcat(-more * ca.mtimes(by_z[:3, :3], R.T), by_scale, along_body, y[:3])
        return more * y[:3] + scale * lift + ca.mtimes(along_body, estimate[FORCE]), H, y[3:]

    still, _, air_torque = expected(ca.DM.zeros(N_ESTIMATE))
    estimates, covariances, squares, likelihoods = [], [], [], [_likelihoods(a["reading"] - still, doubt)]
    initial = ca.DM(known.initial)
    for i, factor in enumerate(s.walk_factors):
        estimate = kept["estimate"][N_ESTIMATE * i : N_ESTIMATE * (i + 1)]
        P = ca.reshape(kept["covariance"][N_ESTIMATE**2 * i : N_ESTIMATE**2 * (i + 1)], N_ESTIMATE, N_ESTIMATE)
        random_walk = np.array(known.random_walk)
        random_walk[[0, 1, 2, 4, 5, 6]] *= factor
        P = P + ca.diag(random_walk**2 * period)
        y, H, _ = expected(estimate)
        innovation, S = a["reading"] - y, ca.mtimes([H, P, H.T])
        likelihoods.append(_likelihoods(innovation, S + doubt))
        squares += [ca.sumsqr(innovation[:2]), innovation[2] ** 2]
        information = inverse(S + N)
        surprise = ca.sqrt(ca.mtimes([innovation.T, information, innovation]))
        trust = ca.fmin(1, s.surprise / ca.fmax(surprise, TINY))  # what sets in at once is not to be learned as a scale
        trusted = ca.diag(ca.vertcat(1, 1, 1, trust, 1, 1, 1, trust))
        K = read * ca.mtimes([trusted, P, H.T, information])
        # what a noise of the thrust, which is in y and in H, takes off the scale (observers/filters.py)
        sure = ca.fmin(1, ca.fmax(0, 1 - estimate[SCALE] / STATED))
        unsure = of_thrust if known.by_speeds else misdated
        taken = sure * unsure * (1 + estimate[SCALE]) * information[2, 2]
        estimate = estimate + read * taken * ca.mtimes(trusted, P[:, SCALE])
        estimate = estimate + ca.mtimes(K, innovation)
        reduction = ca.DM.eye(N_ESTIMATE) - ca.mtimes(K, H)
        P = ca.mtimes([reduction, P, reduction.T]) + ca.mtimes([K, N, K.T])  # Joseph's form
        # where nothing tells the wind, its variance does not grow beyond the first one
        shrink = ca.sqrt(ca.fmin(1, ca.sumsqr(initial[WIND]) / ca.fmax(ca.trace(P[WIND, WIND]), TINY)))
        by = ca.diag(ca.vertcat(shrink, shrink, shrink, ca.DM.ones(N_ESTIMATE - 3)))
        most = SPEEDS.most_force if known.by_speeds else s.most_force
        force = ca.if_else(read, 1, math.exp(-period / s.unseen)) * estimate[FORCE]
        force *= ca.fmin(1, most / ca.fmax(ca.norm_2(force), TINY))
        scales = (limited(estimate[SCALE], *s.scale_limits), limited(estimate[AIR], *SPEEDS.air_limits))
        estimates.append(ca.vertcat(estimate[WIND], scales[0], force, scales[1]))
        covariances.append(ca.mtimes([by, P, by]))
    squares = kept["squares"] + read * (fading - 1) * kept["squares"] + read * ca.vertcat(*squares)
    evidence = ca.if_else(read, _summed(kept["evidence"], fading, likelihoods), kept["evidence"])

    inertia, mean = ca.DM(vehicle.inertia_matrix), a["mean"]
    if known.by_speeds:  # they are of the end of a period, in which rotors that lag were slower to begin with
        begun = ca.if_else(ca.sum1(kept[OF_ROTORS]) > 0, kept[OF_ROTORS], thrust)
        mean = mean + mean_share(period, a["delays"][2]) * (begun - thrust)
    acting = ca.mtimes(ca.DM(vehicle.allocation[1:]), mean) + air_torque - ca.cross(rate, ca.mtimes(inertia, rate))
    acting = ca.mtimes(ca.inv(inertia), acting)
    poles = np.exp(
        -np.array(s.torque_bandwidths) * period
    )  # both poles of each filter; without a torque the rate alone
    gains = [(1 - poles[0] ** 2, 0.0), *((1 - z * z, (1 - z) ** 2 / period) for z in poles)]
    rates, torques, spins = [], [], []
    for i, (of_rate, of_torque) in enumerate(gains):
        torque = kept["torque"][3 * i : 3 * i + 3]
        predicted = kept["rates"][3 * i : 3 * i + 3] + period * (acting + torque)
        rates.append(predicted + of_rate * (rate - predicted))
        torques.append(torque + of_torque * (rate - predicted))
        spins.append(-ca.sumsqr((rate - predicted)[:2] / (s.sheet_factor * s.rate_noise)) / 2)
    torque_evidence = _summed(kept["torque_evidence"], fading, spins)

    # what is assumed
    found = [ca.vertcat(e, ca.vec(P)) for e, P in zip(estimates, covariances, strict=True)]
    level, lift = _likeliest(-squares[::2], found), _likeliest(evidence[1::2], found)
    # a compensation that is behind by more than its time constant is no longer below the attitude loop
    behind = period + ca.sum1(a["delays"])
    prompt = ca.DM(s.torque_bandwidths) * behind < s.torque_behind
    torque_evidence = torque_evidence * prompt
    torque = _likeliest(torque_evidence, torques[1:])
    odds = ca.vertcat(*(ca.mmax(one) for one in (evidence[::2], evidence[1::2], torque_evidence)))
    needed = s.evidence_on * (1 - kept["acts"])
    # torques are compared with the state, whose age is distinguished from the delay of readings, and thrusts with
    # readings
    timed = ca.vertcat(1, a["timing"] < s.timed, ca.fmax(a["timing"], a["apart"]) < s.torque_timed)
    if known.by_speeds:  # prompt, also where rates are of a time that is not known yet
        timed = ca.vertcat(1, 1, a["late"] < s.torque_timed)
    acts = (odds > needed) * timed
    if known.by_speeds:
        acts = ca.vertcat(1, 1, acts[2])
    if known.has_drag:
        wind, rest = acts[0] * level, acts[1] * lift
    else:  # force and scale share what they explain
        wind, rest = 0 * level, ca.if_else(acts[0], level, acts[1] * lift)
    belief = (vehicle.mass * ca.mtimes([R, along_body, rest[FORCE]]), acts[2] * ca.mtimes(inertia, torque), wind[WIND])
    belief = ca.vertcat(*belief, 1 + rest[SCALE], 1 + rest[AIR])

    def spread(of: ca.MX, number: int) -> ca.MX:
        return ca.sqrt(ca.fmax(of[N_ESTIMATE + (N_ESTIMATE + 1) * number], 0))

    scale_doubt = ca.hypot(
        spread(rest, SCALE), INTERVAL.speed_scale if known.by_speeds else INTERVAL.scale_share * rest[SCALE]
    )
    lifting = ca.mtimes(along_body, rest[FORCE])[2]  # a force along the thrust, which a scale of it looks like
    scale_doubt = ca.hypot(scale_doubt, lifting / ca.fmax(specific, vehicle.gravity))
    by_drag = rest[SCALE] * ca.norm_2(x[VELOCITY] - wind[WIND])
    off = ca.hypot(known.wind_offset, by_drag) + (1 - acts[1]) * ca.DM([0, 0, known.wind_untimed])
    winds = [
        ca.if_else(acts[0], ca.hypot(spread(level, i), off[i]), np.nan) if known.has_drag else np.nan for i in range(3)
    ]
    shown = 0 if known.has_drag else ca.fmax(acts[0], acts[1])
    # what limits the bandwidth is no noise
    noises = ca.sqrt(ca.vertcat(across, across, across + along) / variance)
    forces = [ca.hypot(spread(rest, 4 + i) * noises[i], known.force_offset) for i in range(3)]
    forces = [ca.if_else(shown, vehicle.mass * one, np.nan) for one in forces]
    lag = ca.sqrt(variance[0] * period) / max(known.random_walk[FORCE][0], TINY)
    lag = ca.if_else(shown, lag, np.nan)
    deviations = ca.vertcat(*winds, *forces, lag, ca.if_else(acts[1], scale_doubt, np.nan))
    now = {
        "estimate": ca.vertcat(*estimates),
        "covariance": ca.vertcat(*map(ca.vec, covariances)),
        "rates": ca.vertcat(*rates),
        "torque": ca.vertcat(*torques),
        "evidence": evidence,
        "squares": squares,
        "torque_evidence": torque_evidence,
        "acts": acts,
        "thrust": specific,
        "slope": slope,
        OF_ROTORS: thrust,
    }
    flown = ca.fmax(a[f"{NOW}flown"], read)
    results = {NEXT + name: ca.if_else(flown, now[name], kept[name]) for name in sizes} | {f"{NEXT}flown": ca.MX(1)}
    results["belief"] = ca.if_else(flown, belief, ca.DM(np.hstack([*no_belief()])))
    results["deviations"] = ca.if_else(flown, deviations, math.nan)
    return named_function("disturbance", a, results)


def mean_share(period: float, lag: ca.MX) -> ca.MX:
    """Share of what a thrust was as a period (s) began in its mean over the period, the rest being what it is at the
    end: of a first-order lag (s) from the one to the other, between 0 (no lag) and 1/2."""
    slowness = ca.fmax(lag, INSTANT) / period
    rest = ca.exp(-1 / slowness)
    return (slowness * (1 - rest) - rest) / (1 - rest)


def _summed(evidence: ca.MX, fading: float, likelihoods: list[ca.MX]) -> ca.MX:
    """Evidence of each model against the first, after an instant with these log likelihoods."""
    none, *models = likelihoods
    return ca.fmax(fading * evidence + ca.vertcat(*(model - none for model in models)), 0)


def _likelihoods(innovation: ca.MX, S: ca.MX) -> ca.MX:
    """Log likelihoods, but for a constant, of the part across the thrust and of that along it."""
    (a, b), (c, d) = [ca.horzsplit(S[i, :2]) for i in (0, 1)]
    x, y, z = ca.vertsplit(innovation)
    determinant = a * d - b * c
    across = (d * x**2 - (b + c) * x * y + a * y**2) / determinant + ca.log(determinant)
    return -ca.vertcat(across, z**2 / S[2, 2] + ca.log(S[2, 2])) / 2


def _likeliest(score: ca.MX, models: list[ca.MX]) -> ca.MX:
    """The model with the largest score."""
    chosen, most = models[0], score[0]
    for i, model in enumerate(models[1:], 1):
        chosen = ca.if_else(score[i] > most, model, chosen)
        most = ca.fmax(most, score[i])
    return chosen
