"""Every number of remedies=auto, with its unit and its reason or source.

(Bayley & Hammersley 1946) J. R. Stat. Soc. B 8; (Kass & Raftery 1995) J. Am. Stat. Assoc. 90; (Magill 1965) IEEE Trans.
Autom. Control 10; (Willsky & Jones 1976) IEEE Trans. Autom. Control 21. "Ablation": mean error of 12 to 24 flights
without it over that with it.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BankSettings:
    """Hypotheses, and the noise models of their filters."""

    period: float = 0.01  # s, of the filters, about: a tenth of the fastest attitude dynamics
    largest_age: float = 0.09  # s, of the state: beyond it nothing is acted on
    largest_dead_time: float = 0.08  # s, of commands
    largest_lag: float = 0.064  # s, of rotors: the slowest published ones
    age_step: float = 0.005  # s, of the coarse grid: half a period
    total_step: float = 0.005  # s, likewise
    lag_step: float = 0.008  # s: dead time and lag are hard to tell apart
    fine: int = 5  # into how many the finer grid divides a step
    passes: int = 4  # of the finer grid at most, which moves while its mode is on its edge
    gyro_models: tuple[tuple[float, float], ...] = ((3e-4, 0.3), (5e-2, 0.3))
    # of a reading (rad/s) and of a walk of the torque (rad/s^2/sqrt(s)): exact and poor gyroscopes; with one, a sum of
    # age and delay was 1 ms off under a poor one, or late where its data sheet was wrong; three: 1.00
    rate_walk: float = 0.05  # rad/s/sqrt(s), white torques as of turbulence: 1.08 without
    velocity_models: tuple[float, ...] = (1e-4, 3e-3, 3e-2)  # m/s, of a given velocity: exact, filtered, raw; two: 1.08
    thrust_noise: float = 0.28  # m/s^2, of the model along the thrust: 3 % of gravity
    thrust_walk: float = 1.0  # m/s^2/sqrt(s), of a vertical disturbance
    least_turn: float = 3e-4  # rad/s, of a gyroscope against the model
    least_attitude: float = 1e-5  # rad, of an estimated attitude
    least_reading: float = 0.02  # m/s^2, of an accelerometer
    sheet_factor: float = 3.0  # by which a data sheet may be wrong: what users state differs by that much
    noise_memory: float = 5.0  # s, of measured noises
    measured_after: float = 0.5  # s, from which on a measured noise of the accelerometer counts: 50 readings
    forgetting: float = 20.0  # s, of all moments: the thrust scale moves with the battery
    settling: float = 0.1  # s, until the filters are stationary
    mean_delay: float = 0.03  # s, of the exponential prior of age plus total: delays of published vehicles
    scale_deviation: float = 0.1  # prior of the thrust scale: a vehicle is weighed
    inertia_deviation: float = 0.2  # prior of the torque scale: an inertia is estimated
    bias_deviation: float = 0.2  # m/s^2, prior of the accelerometer's bias
    rate_bias_deviation: float = 0.02  # rad/s, prior of the gyroscope's bias
    gap: float = 2.0  # missing readings in a row, from which on the line between their neighbours tells nothing
    least_information: float = 0.02  # of an innovation: models are never exact
    most_information: float = 0.5  # of one, likewise (Bayley & Hammersley 1946 for what lies in between)
    # Log Bayes factors against rates with the pose, of now, and in between, where one more number is fitted
    rates_odds: tuple[float, ...] = (0.0, 1.0, 5.0)
    floor: float = 1e-14  # of mean squared innovations, so that their logarithm is finite


@dataclass(frozen=True)
class IntervalSettings:
    """What a 95 % interval has beside the posterior: what the model of all hypotheses leaves out."""

    band: float = 1.96  # deviations
    none_odds: float = 5.0  # log Bayes factor that excludes no age, or no total, at all: very strong (Kass & Raftery)
    inexact: float = 0.03  # of a delay: messages take unlike times
    # of a lag: motors lag unlike up and down, by a third to either side (RotorS); which counts within a fifth of that
    unlike: float = 0.07
    longest_period: float = 0.05  # s, of control: readings further apart tell no delays within what is beyond it
    least_wind: float = 0.15  # m/s: an attitude off by 0.25 deg, which no data sheet states, at a drag of 0.3 1/s
    scale_share: float = 0.2  # of the thrust scale's distance from 1: by a wrong mass the drag is off as well
    untimed_noise: float = 3.0  # m/s^2, along the thrust where the time of the thrusts is not known
    speed_scale: float = 0.1  # of the thrust scale by rotor speeds, whose readings are behind low passes


@dataclass(frozen=True)
class DisturbanceSettings:
    """Walks of the disturbance filter, and what it believes."""

    reading_noise: float = 0.05  # m/s^2, least of the accelerometer against the model
    thrust_noise: float = 0.0286  # of the thrust, or the weight, along it: rotors follow their map within 3 %
    walk_factors: tuple[float, ...] = (0.1, 1.0)  # slow and fast: 1.20 with one
    wind_walk: float = 1.5  # m/s/sqrt(s), of a gust (Dryden, low altitude, moderate)
    wind_initial: tuple[float, ...] = (4.0, 4.0, 1.0)  # m/s: over ground a mean wind is level; never beyond it later
    scale_walk: float = 0.005  # 1/sqrt(s), of a battery; more, and a drag that turns with the path is taken for a scale
    scale_initial: float = 0.05  # of a vehicle that is weighed
    unseen: float = 1.0  # s, time constant of a force that no reading shows: it may have been of the heading then
    surprise: float = 4.0  # deviations of an innovation, from which on it is less and less learned as a scale
    scale_limits: tuple[float, ...] = (-0.5, 1.0)  # of the scale's distance from 1
    force_walk: float = 3.0  # m/s^2/sqrt(s), of a drag that turns with the path
    force_initial: float = 3.0  # m/s^2
    force_walk_beside_wind: tuple[float, ...] = (
        0.0,
        0.0,
        1.0,
    )  # m/s^2/sqrt(s), body: what a wind leaves is of the thrust
    force_initial_beside_wind: tuple[float, ...] = (0.0, 0.0, 0.3)  # m/s^2
    most_force: float = 15.0  # m/s^2: more than 1.5 times the weight is no disturbance
    most_force_bandwidth: float = 40.0  # rad/s: the accelerometer's reading has the own thrust in it, a loop
    noise_memory: float = 2.0  # s, of the mean squared innovations
    torque_bandwidths: tuple[float, ...] = (3.0, 15.0)  # rad/s, below that of the attitude loop
    torque_behind: float = 1.0  # rad, of a bandwidth by which age, delays and period put a torque behind
    sheet_factor: float = 3.0  # by which a stated noise may be wrong
    rate_noise: float = 1e-3  # rad/s, least of the gyroscope against the model
    evidence_on: float = 8.0  # log likelihood ratio from which a disturbance acts: very strong (Kass & Raftery 1995)
    unknown_timing: float = 0.03  # s, most that the uncertainty of a delay counts for the noise of the thrust
    timed: float = 0.01  # s, of it up to which thrusts are compared with readings: a late one looks like a force
    torque_timed: float = 0.005  # s, likewise torques with rates: the attitude is the faster loop
    slope_memory: float = 10.0  # control periods, of how thrusts change
    least_drag_bandwidth: float = 1.0  # rad/s, of the wind that the model's drag tells; below it a force is estimated
    tilt_to_acceleration: float = 12.0  # m/s^2 per rad: thrust over mass in a turn


@dataclass(frozen=True)
class SpeedSettings:
    """The disturbance filter where rotor speeds tell the thrusts."""

    least_rate: float = 100.0  # readings a second
    force_walk: float = 1.5  # m/s^2/sqrt(s)
    most_force: float = 50.0  # m/s^2
    most_force_bandwidth: float = 100.0  # rad/s: measured thrusts are no loop
    evidence_on: float = 3.0  # log likelihood ratio from which a disturbance acts: strong, since thrusts are measured
    scale_initial: float = 0.3  # of a mass and a thrust coefficient that nobody measured
    air_walk: float = 0.01  # 1/sqrt(s), of the scale of the model's air
    air_initial: float = 1.0
    air_limits: tuple[float, ...] = (-1.0, 4.0)  # of the air scale's distance from 1


@dataclass(frozen=True)
class Grid:
    """A horizon of the MPC."""

    first_node: float  # s
    horizon: float  # s
    position_weight: float  # least of an MPC of usual weights, and ..
    input_weight: float = 0.0  # .. likewise of the commands


@dataclass(frozen=True)
class DecisionSettings:
    """From the posterior to what is acted on."""

    pace: float = 0.1  # share by which evidence grows from one posterior to the next ..
    soonest: float = 0.02  # s, at least ..
    latest: float = 0.5  # s, and at most
    checks: float = 0.1  # s, between looks
    begins: float = 0.02  # s, of evidence for the first posterior
    rounding: float = 0.01  # of a control period, by which times may be off in single precision after 1000 s
    early: float = 0.6  # s, of looks every `soonest`: a push or a late pose is found by then
    few_readings: float = 4.0  # of the bank: fewer fit any delay by chance, and the softest grid flies
    age_odds: float = 5.0  # log Bayes factor against no age: very strong (Kass & Raftery 1995)
    between: float = 0.015  # s, of an age that needs twice as much: how a force goes between readings is not known
    total_odds: float = 2.0  # log Bayes factor against no dead time and lag: positive
    least_age: float = 0.001  # s, worth a prediction
    least_change: float = 0.0005  # s, of age and total, worth another plan
    inexact: float = 0.08  # of what is predicted over: what happens meanwhile is not known
    least_lag: float = 0.003  # s, below which a lag is not inverted: it would amplify noise
    next_period: float = 0.25  # of a period, by which rotor speeds of the one before are later at least: motors lag
    large_noise: float = 0.002  # m, of the estimated position, which a stiff controller would amplify
    soft_noise: float = 0.012  # m, likewise, which any but the controller's own horizon would: 1.5 at 30 mm
    # s, largest sum of age, total and control period under any but the controller's own: a hover at 21 Hz behind 66 and
    # 33 ms was lost
    soft_sum: float = 0.14
    stiff_total: float = 0.015  # s, largest total under the stiffest grid
    stiff_timing: float = 0.004  # s, largest timing uncertainty under it
    middle_timing: float = 0.008  # s, likewise under the one before it
    at_limit: float = 0.999  # share of the range of a thrust from which on it is at its limit
    saturation_memory: float = 0.3  # s, of commands in a look at how many are at a limit
    corners_memory: float = 5.0  # s, of looks: a path that saturates rotors does so again
    saturates: float = 0.12  # share of these at a limit, from which on the controller's own horizon flies
    ahead: float = 0.8  # s, that of these horizons, within which a path ..
    steep: float = 0.83  # .. may ask for this share of the vehicle's level acceleration: more, and it has a jump
    largest_lead: float = 2.0  # gain of an inverted lag on a change of thrust; the rest of the lag is predicted: 1.12
    most_inverted: float = 0.03  # s, of a lag: what that gain is at 50 Hz; slower, commands went from limit to limit
    largest_wait: float = 0.1  # s, over which an MPC predicts
    samples: int = 4  # of the reference in a control period, so that an MPC may ask for later ones
    # Beside the controller's own, the softest: 1.64 with that alone; one more between the last two brings 0.99, and 1.4
    # times the change of a command
    grids: tuple[Grid, ...] = (
        Grid(0.06, 0.8, 40.0),
        Grid(0.05, 0.8, 100.0, 1.0),  # without the weight of commands 0.42 of a noisy hover is at a limit
        Grid(0.02, 0.8, 200.0),  # a horizon of 0.6 s is too short for corners
    )


@dataclass(frozen=True)
class PathSettings:
    """What a law is given a path whose velocity jumps, and of a force."""

    samples: int = 2  # of the reference in a control period
    turning: float = 0.9  # of all rotors' thrust, for a force and what the path takes; the rest turns the vehicle
    share: float = 0.9  # of the vehicle's acceleration, for an offset from the path
    steepest: float = 2.6  # tangent of the tilt for it
    brakes: float = 0.8  # share of the acceleration that brakes
    back: float = 5.0  # 1/s, of an offset from a path that jumped: a position loop's
    turns: float = 20.0  # 1/s, of its acceleration: an attitude loop's
    looks: float = 0.4  # s, how far ahead a jump is seen
    early: float = 1.0  # of |jump| / acceleration, how long before it the offset begins
    ended: float = 1e-6  # s; m, m/s, m/s^2: an offset that has died out


@dataclass(frozen=True)
class ReportSettings:
    """What `show --beliefs` compares with the truth."""

    settled: float = 20.0  # time constants, after which nothing is left of a lag of the thrusts
    recent: float = 4.0  # time constants of a low pass, after which 2 % of a step are left
    last: float = 2.0  # s, over which the scale of the thrust is taken
    rounded: float = 0.02  # of a band, below which a value is none
    height: float = 1e-9  # of an axis, at least


# Half of a band from which on a quantity was not identifiable; of a force in weights of the vehicle
LIMITS = {"ms": 5.0, "m/s": 2.0, "N": 0.25, "1": 0.05}
NEVER = 1e30  # a log odds, or a sum of squares, beyond all others, also in single precision
TINY = 1e-12  # so that nothing is divided by zero
QUANTILES = 0.025, 0.975  # ends of a 95 % interval
REPORT = ReportSettings()
BANK, INTERVAL, DISTURBANCE, SPEEDS = BankSettings(), IntervalSettings(), DisturbanceSettings(), SpeedSettings()
DECISION, PATH = DecisionSettings(), PathSettings()
