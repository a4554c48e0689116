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

import numpy as np

from quadexp.compile.memory import NEXT, NOW, Memory, connected, sizes_of
from quadexp.compile.symbolic import ca
from quadexp.control.base import N_BELIEF
from quadexp.control.cached_function import cached_function
from quadexp.control.control_step import Call, call
from quadexp.control.layer import NO_BELIEF
from quadexp.models.residual import Residual
from quadexp.physics.expression import Answers, limited, named_symbols
from quadexp.physics.rotation import rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.auto.settings import DISTURBANCE, INTERVAL, SPEEDS, TINY
from quadexp.plugins.auto.sources import AIR, FORCE, N_ESTIMATE, SCALE, WIND, Sources
from quadexp.plugins.remedies.observers.filters import STATED, inverse
from quadexp.plugins.remedies.sent_commands import INSTANT

WALKS = len(DISTURBANCE.walk_factors)
TORQUES = 1 + len(DISTURBANCE.torque_bandwidths)  # without a torque first
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


class DisturbanceFilter:
    """Its calls stand `before` the controller's; `start` begins a flight.

    belief: (11,), see control.base.Belief. likely: (3,), acceleration (m/s^2, world) by the force, or where none is
    assumed by the likeliest one, with what is of the scale. deviations: see DEVIATIONS. acts: (3,), whether a
    disturbance across the thrust, one along it, and a torque are assumed. given: arrays of the uncertainty of the
    commands' delay, timing, by which age and delays cannot be distinguished, `apart`, by which an age is off that acts,
    `late`, of age, dead time and lag that act, `delays` (s), and of variances that a bank has measured, lateral, noise.
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
        numbers = self._function.numel_in("theta")
        self._places = told | {"theta": theta.reshape(-1)[:numbers]}
        self._initial = np.square(known.initial)
        self.belief = np.zeros(N_BELIEF)
        self.deviations = np.zeros(len(DEVIATIONS))
        self.likely = np.zeros(3)
        self.acts = self.memory.of_now["acts"]

    def assume_nothing(self) -> None:
        """As a flight begins."""
        self.belief[...] = NO_BELIEF
        self.likely[...] = 0
        self.deviations[...] = np.nan

    def start(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """What is remembered as a flight begins in the state x, (13,)."""
        covariance = np.tile(np.diag(self._initial).ravel(), WALKS)
        return {"covariance": covariance, "rates": np.tile(x[RATE], TORQUES)}

    def before(self, known: dict[str, np.ndarray], read: np.ndarray) -> list[Call]:
        """Leaves belief, likely and deviations. known: arrays with the state x (13,), the reading (3,), thrust and
        mean, delivered then and over the last period, (n,) (N), of one time."""
        given = {**self._places, **known, "read": read}
        found = {"belief": self.belief, "deviations": self.deviations, "likely": self.likely}
        return [call(connected(self._function, given, found, self.memory))]


def disturbance_function(vehicle: Vehicle, air: ca.Function, period: float, known: Sources) -> ca.Function:
    """Memory, belief, likely and deviations after an instant; see DisturbanceFilter. noise: of the bank, variances of
    a reading across the thrust, of position and attitude. Memory: SIZES, and whether anything has been read."""
    n, s = vehicle.n_rotors, DISTURBANCE
    sizes = SIZES | {OF_ROTORS: n}
    shapes = {NOW + name: size for name, size in sizes.items()}
    shapes[f"{NOW}flown"] = 1
    shapes |= {"x": N_STATE, "reading": 3, "read": 1, "thrust": n, "mean": n}
    shapes |= {"lateral": 1, "noise": 3, "timing": 1, "apart": 1, "late": 1, "delays": 3}
    a = named_symbols(ca.SX, shapes)
    kept = {name: a[NOW + name] for name in sizes}
    # zeros that are known vanish: what neither is uncertain as a flight begins nor walks
    exists = np.array(known.initial) + known.random_walk > 0
    kept["estimate"] *= np.tile(exists, WALKS)
    kept["covariance"] *= np.tile(np.outer(exists, exists).ravel(), WALKS)
    answers = Answers(air)
    x, read = a["x"], a["read"]
    thrust, timing = a["thrust"], a["timing"]
    R, rate = rotation_matrix(x[ATTITUDE]), x[RATE]
    specific = ca.sum1(thrust) / vehicle.mass
    fading = math.exp(-period / s.noise_memory)

    # noise: of the sensors as measured, and along the thrust what the time of the thrusts leaves unknown
    change = (specific - kept["thrust"]) / period * (kept["thrust"] > 0)
    slope = kept["slope"] + (change**2 - kept["slope"]) / s.slope_memory
    tilt = s.tilt_to_acceleration**2 * ca.fmax(a["noise"][2], 0)
    measured = ca.fmax(a["lateral"], s.reading_noise**2) + tilt
    across = ca.fmax(measured, known.reading**2 * known.by_speeds)
    untimed = 0 if known.by_speeds else ca.fmin(timing, s.unknown_timing)
    misdated = untimed**2 * slope
    of_thrust = (known.thrust * ca.fmax(specific, vehicle.gravity)) ** 2
    along = of_thrust + misdated
    # no force is followed faster than most_force_bandwidth, which is q / (r sqrt(T)) of a random walk
    fastest = SPEEDS.most_force_bandwidth if known.by_speeds else s.most_force_bandwidth
    least = (max(known.random_walk[FORCE]) / fastest) ** 2 / period
    followed = ca.DM([not known.has_drag, not known.has_drag, 1])
    variance = ca.fmax(ca.vertcat(across, across, across + along), least * followed)
    N = ca.diag(variance)
    doubted = s.sheet_factor**2 * across
    doubt = ca.diag(ca.vertcat(doubted, doubted, doubted + along))

    along_body = ca.DM.eye(3) if known.has_drag else R.T  # what a wind leaves is of the thrust

    def expected(estimate: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Reading, its Jacobian by the estimate, and torque of the air."""
        scale = 1 + estimate[SCALE]
        air_scale = 1 + estimate[AIR]
        through_air = R.T @ (x[VELOCITY] - estimate[WIND])
        y, by_features = answers(ca.vertcat(through_air, rate, scale * thrust))
        lift = ca.vertcat(0, 0, specific)
        by_wind = -air_scale * (by_features[:3, :3] @ R.T)
        by_scale = lift + air_scale * (by_features[:3, 6:] @ thrust)
        H = ca.horzcat(by_wind, by_scale, along_body, y[:3])
        reading = air_scale * y[:3] + scale * lift + along_body @ estimate[FORCE]
        return reading, H, y[3:]

    # a filter for each walk
    still, _, air_torque = expected(ca.DM.zeros(N_ESTIMATE))
    most_force = SPEEDS.most_force if known.by_speeds else s.most_force
    first_wind = ca.sumsqr(ca.DM(known.initial)[WIND])
    likelihoods = [_likelihoods(a["reading"] - still, doubt)]
    squares, estimates, covariances = [], [], []
    for i, factor in enumerate(s.walk_factors):
        estimate = kept["estimate"][N_ESTIMATE * i : N_ESTIMATE * (i + 1)]
        P = kept["covariance"][N_ESTIMATE**2 * i : N_ESTIMATE**2 * (i + 1)]
        random_walk = np.array(known.random_walk)
        random_walk[WIND] *= factor
        random_walk[FORCE] *= factor
        P = ca.reshape(P, N_ESTIMATE, N_ESTIMATE) + ca.diag(random_walk**2 * period)
        y, H, _ = expected(estimate)
        innovation = a["reading"] - y
        S = H @ P @ H.T
        likelihoods.append(_likelihoods(innovation, S + doubt))
        squares += [ca.sumsqr(innovation[:2]), innovation[2] ** 2]
        information = inverse(S + N)
        surprise = ca.sqrt(innovation.T @ information @ innovation)
        trust = ca.fmin(1, s.surprise / ca.fmax(surprise, TINY))  # what sets in at once is not to be learned as a scale
        trusted = ca.diag(ca.vertcat(1, 1, 1, trust, 1, 1, 1, trust))
        K = read * (trusted @ P @ H.T @ information)
        # what a noise of the thrust, which is in y and in H, takes off the scale (observers/filters.py)
        sure = ca.fmin(1, ca.fmax(0, 1 - estimate[SCALE] / STATED))
        unsure = of_thrust if known.by_speeds else misdated
        taken = sure * unsure * (1 + estimate[SCALE]) * information[2, 2]
        estimate = estimate + read * taken * (trusted @ P[:, SCALE])
        estimate = estimate + K @ innovation
        reduction = ca.DM.eye(N_ESTIMATE) - K @ H
        P = reduction @ P @ reduction.T + K @ N @ K.T  # Joseph's form
        # where nothing tells the wind, its variance does not grow beyond the first one
        of_wind = ca.fmax(ca.trace(P[WIND, WIND]), TINY)
        shrink = ca.sqrt(ca.fmin(1, first_wind / of_wind))
        by = ca.diag(ca.vertcat(shrink, shrink, shrink, ca.DM.ones(N_ESTIMATE - 3)))
        covariances.append(ca.tril2symm(ca.tril(by @ P @ by)))  # one half is computed
        fades = ca.if_else(read, 1, math.exp(-period / s.unseen))
        force = fades * estimate[FORCE]
        force *= ca.fmin(1, most_force / ca.fmax(ca.norm_2(force), TINY))
        scale = limited(estimate[SCALE], *s.scale_limits)
        air_scale = limited(estimate[AIR], *SPEEDS.air_limits)
        estimates.append(ca.vertcat(estimate[WIND], scale, force, air_scale))
    squares = kept["squares"] + read * (fading - 1) * kept["squares"] + read * ca.vertcat(*squares)
    evidence = _summed(kept["evidence"], fading, likelihoods)
    evidence = ca.if_else(read, evidence, kept["evidence"])

    # a filter for each bandwidth of a torque
    inertia, mean = ca.DM(vehicle.inertia_matrix), a["mean"]
    if known.by_speeds:  # they are of the end of a period, in which rotors that lag were slower to begin with
        begun = ca.if_else(ca.sum1(kept[OF_ROTORS]) > 0, kept[OF_ROTORS], thrust)
        mean = mean + mean_share(period, a["delays"][2]) * (begun - thrust)
    of_rotors = ca.DM(vehicle.allocation[1:]) @ mean
    gyroscopic = ca.cross(rate, inertia @ rate)
    acting = ca.inv(inertia) @ (of_rotors + air_torque - gyroscopic)
    # both poles of each filter are at z; without a torque the rate alone
    poles = np.exp(-np.array(s.torque_bandwidths) * period)
    gains = [(1 - poles[0] ** 2, 0.0)]
    gains += [(1 - z * z, (1 - z) ** 2 / period) for z in poles]
    doubted_rate = s.sheet_factor * s.rate_noise
    rates, torques, spins = [], [], []
    for i, (of_rate, of_torque) in enumerate(gains):
        torque = kept["torque"][3 * i : 3 * i + 3]
        before = kept["rates"][3 * i : 3 * i + 3]
        predicted = before + period * (acting + torque)
        rates.append(predicted + of_rate * (rate - predicted))
        torques.append(torque + of_torque * (rate - predicted))
        spins.append(-ca.sumsqr((rate - predicted)[:2] / doubted_rate) / 2)
    torque_evidence = _summed(kept["torque_evidence"], fading, spins)
    # a compensation that is behind by more than its time constant is no longer below the attitude loop
    behind = period + ca.sum1(a["delays"])
    prompt = ca.DM(s.torque_bandwidths) * behind < s.torque_behind
    torque_evidence = torque_evidence * prompt

    # what is assumed
    models = []
    for estimate, P in zip(estimates, covariances, strict=True):
        models.append(ca.vertcat(estimate, ca.vec(P)))
    level = _likeliest(-squares[::2], models)
    lift = _likeliest(evidence[1::2], models)
    torque = _likeliest(torque_evidence, torques[1:])
    of_level, of_lift = ca.mmax(evidence[::2]), ca.mmax(evidence[1::2])
    odds = ca.vertcat(of_level, of_lift, ca.mmax(torque_evidence))
    evidence_on = SPEEDS.evidence_on if known.by_speeds else s.evidence_on
    needed = evidence_on * (1 - kept["acts"])
    if known.by_speeds:  # also where rates are of a time that is not known yet; force and scale share what they explain
        acts = (odds > needed) * ca.vertcat(1, 1, a["late"] < s.torque_timed)
        any_force = ca.mmax(acts[:2])
        acts = ca.vertcat(any_force, any_force, acts[2])
    else:
        # torques are compared with the state, whose age is distinguished from the delay of readings, and thrusts with
        # readings
        torque_timing = ca.fmax(timing, a["apart"])
        acts = (odds > needed) * ca.vertcat(1, timing < s.timed, torque_timing < s.torque_timed)
    if known.has_drag:
        wind, rest = acts[0] * level, acts[1] * lift
    else:  # force and scale share what they explain
        wind, rest = 0 * level, ca.if_else(acts[0], level, acts[1] * lift)
    force = vehicle.mass * (R @ along_body @ rest[FORCE])
    belief = ca.vertcat(force, acts[2] * (inertia @ torque), wind[WIND])
    belief = ca.vertcat(belief, 1 + rest[SCALE], 1 + rest[AIR])
    by_scale = ca.vertcat(0, 0, level[SCALE] * specific)
    likeliest = R @ (along_body @ level[FORCE] + by_scale)
    likely = ca.if_else(ca.mmax(acts[:2]), force / vehicle.mass, likeliest)

    # deviations of what is assumed, beside those of the filter what it leaves out
    def spread(of: ca.SX, number: int) -> ca.SX:
        return ca.sqrt(ca.fmax(of[N_ESTIMATE + (N_ESTIMATE + 1) * number], 0))

    scale_share = INTERVAL.speed_scale if known.by_speeds else INTERVAL.scale_share * rest[SCALE]
    scale_doubt = ca.hypot(spread(rest, SCALE), scale_share)
    lifting = (along_body @ rest[FORCE])[2]  # a force along the thrust, which a scale of it looks like
    scale_doubt = ca.hypot(scale_doubt, lifting / ca.fmax(specific, vehicle.gravity))
    scale_doubt = ca.if_else(acts[1], scale_doubt, np.nan)
    by_drag = rest[SCALE] * ca.norm_2(x[VELOCITY] - wind[WIND])
    of_untimed = ca.DM([0, 0, known.wind_untimed])
    off = ca.hypot(known.wind_offset, by_drag) + (1 - acts[1]) * of_untimed
    shown = 0 if known.has_drag else ca.fmax(acts[0], acts[1])
    noises = ca.sqrt(ca.vertcat(across, across, across + along) / variance)  # what limits the bandwidth is no noise
    winds, forces = [np.nan] * 3, []
    for i in range(3):
        if known.has_drag:
            wind_doubt = ca.hypot(spread(level, i), off[i])
            winds[i] = ca.if_else(acts[0], wind_doubt, np.nan)
        force_spread = spread(rest, FORCE.start + i) * noises[i]
        force_doubt = ca.hypot(force_spread, known.force_offset)
        forces.append(ca.if_else(shown, vehicle.mass * force_doubt, np.nan))
    force_walk = max(known.random_walk[FORCE][0], TINY)
    lag = ca.sqrt(variance[0] * period) / force_walk
    lag = ca.if_else(shown, lag, np.nan)
    deviations = ca.vertcat(*winds, *forces, lag, scale_doubt)

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
    results = {NEXT + name: ca.if_else(flown, now[name], kept[name]) for name in sizes}
    results[f"{NEXT}flown"] = 1
    results["belief"] = ca.if_else(flown, belief, ca.DM(NO_BELIEF))
    results["deviations"] = ca.if_else(flown, deviations, math.nan)
    results["likely"] = flown * likely
    return answers.function_of("disturbance", a, results)


def mean_share(period: float, lag: ca.SX) -> ca.SX:
    """Share of what a thrust was as a period (s) began in its mean over the period, the rest being what it is at the
    end: of a first-order lag (s) from the one to the other, between 0 (no lag) and 1/2."""
    slowness = ca.fmax(lag, INSTANT) / period
    rest = ca.exp(-1 / slowness)
    return (slowness * (1 - rest) - rest) / (1 - rest)


def _summed(evidence: ca.SX, fading: float, likelihoods: list[ca.SX]) -> ca.SX:
    """Evidence of each model against the first, after an instant with these log likelihoods."""
    none, *models = likelihoods
    more = ca.vertcat(*(model - none for model in models))
    return ca.fmax(fading * evidence + more, 0)


def _likelihoods(innovation: ca.SX, S: ca.SX) -> ca.SX:
    """Log likelihoods, but for a constant, of the part across the thrust and of that along it."""
    a, b = ca.horzsplit(S[0, :2])
    c, d = ca.horzsplit(S[1, :2])
    x, y, z = ca.vertsplit(innovation)
    determinant = a * d - b * c
    square = d * x**2 - (b + c) * x * y + a * y**2
    across = square / determinant + ca.log(determinant)
    along = z**2 / S[2, 2] + ca.log(S[2, 2])
    return -ca.vertcat(across, along) / 2


def _likeliest(score: ca.SX, models: list[ca.SX]) -> ca.SX:
    """The model with the largest score."""
    chosen, most = models[0], score[0]
    for i, model in enumerate(models[1:], 1):
        chosen = ca.if_else(score[i] > most, model, chosen)
        most = ca.fmax(most, score[i])
    return chosen
