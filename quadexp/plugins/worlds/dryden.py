"""Continuous turbulence after Dryden in the low-altitude form of MIL-F-8785C (3.7.3 and 3.7.5).

One-sided spectra over the angular frequency w (rad/s) for T = L / V, scale length over airspeed; integral sigma^2:

    along the wind          Phi_u = sigma_u^2 2 T_u / pi / (1 + (T_u w)^2)
    across, and vertical    Phi_v = sigma_v^2 T_v / pi (1 + 3 (T_v w)^2) / (1 + (T_v w)^2)^2       (m/s)^2 / (rad/s)

Forming filters with white noise xi, in states without a unit whose stationary covariance P does not depend on T:

    T z_1' = -z_1 + sqrt(2 T) xi,   T z_2' = z_1 - z_2         P = [1, 1/2; 1/2, 1/2]
    u = sigma_u z_1,   v = sigma_v (sqrt(3) z_1 + (1 - sqrt(3)) z_2) / sqrt(2)

They begin in P and are solved exactly over a step h, so that P holds at any step and any airspeed, constant or not:

    z(t + h) = F z + sqrt(Q) n,   F = exp(-s) [1, 0; s, 1],   Q = P - F P F',   s = h / T,   n standard normal

Axes, fixed in the world for a flight: "along" is the horizontal direction of the mean wind (world x where there is
none), "across" is horizontal and 90 degrees to the left of it, "vertical" is up. The air is frozen while the vehicle
passes at the airspeed V.

The filters are advanced every TICK of 0.5 ms, and their wind is held in between, at times that depend on no control
period and no integration step; V is that of the beginning of the control period. Held values have the asked intensity
exactly. They are half a TICK late, 0.25 ms, which is what an accelerometer sees of a gust beside all other sensors: a
wind held for 5 ms would look like readings that are 2.5 ms older than they are.

Scale lengths and intensities at the altitude h, both in feet, for 10 ft <= h <= 1000 ft and the wind W_20 at 20 ft:

    L_w = h,   L_u = L_v = h / (0.177 + 0.000823 h)^1.2
    sigma_w = 0.1 W_20,   sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4
"""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.parts.settings import Triple, key, keyed
from quadexp.physics.expression import Expression, limited, split, symbols
from quadexp.physics.state import VELOCITY
from quadexp.physics.vehicle import Vehicle
from quadexp.world.constant_wind import MeanWind
from quadexp.world.effect import Clock, Moment, Sizes, Start
from quadexp.world.streams import NEVER, TICK, Ticking

FOOT = 0.3048  # m
N_FILTER = 5  # states [along z_1; across z_1, z_2; vertical z_1, z_2]
N_NOISE = 5  # numbers per step
N_PARAMETERS = 20  # of the function below
TRANSVERSE = (math.sqrt(1.5), (1 - math.sqrt(3)) / math.sqrt(2))  # of z_1 and z_2
IN_TIME = 1e-9  # s, by which an integration step may begin before the wind that it takes
SMALL = 0.1  # s up to which moments are summed as series
TERMS = 10  # that reach rounding there


def scale_lengths(altitude: float) -> np.ndarray:
    """L along, across and vertical, (3,) (m), at an altitude (m)."""
    feet = altitude / FOOT
    horizontal = altitude / (0.177 + 0.000823 * feet) ** 1.2
    return np.array([horizontal, horizontal, altitude])


def intensities(altitude: float, wind_at_6m: float) -> np.ndarray:
    """Standard deviations along, across and vertical, (3,) (m/s), at an altitude (m), by the wind at 20 ft (m/s)."""
    vertical = 0.1 * wind_at_6m
    horizontal = vertical / (0.177 + 0.000823 * altitude / FOOT) ** 0.4
    return np.array([horizontal, horizontal, vertical])


def axes(mean_wind: np.ndarray) -> np.ndarray:
    """World directions of along, across and vertical as columns, (3, 3), for a mean wind (3,), world (m/s)."""
    speed = math.hypot(mean_wind[0], mean_wind[1])
    if not speed:
        return np.eye(3)
    x = mean_wind[0] / speed
    y = mean_wind[1] / speed
    return np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])


def stationary(noise: np.ndarray) -> np.ndarray:
    """Filter states (5,) drawn from their stationary distribution, by standard-normal numbers (5,)."""
    along, *transverse = noise
    half = math.sqrt(0.5)
    pairs = []
    for z, n in (transverse[:2], transverse[2:]):
        pairs.append((z, z / 2 + half * half * n))
    return np.array([along, *pairs[0], *pairs[1]])


def transition(time_scale: Expression, step: Expression) -> tuple[Expression, Expression]:
    """F and root of all filters over a step (s), (5, 5) each; time_scale T = L / V, (3,) (s).

    Their states (5,) are then F filters + root noise, of noise (5,) standard normal.
    """
    s = [step / time_scale[i] for i in range(3)]
    F = [ca.exp(-s[0])]
    roots = [ca.sqrt(-ca.expm1(-2 * s[0]))]
    for each in s[1:]:
        decay = ca.exp(-each)
        root_11, root_21, root_22 = _root(each)
        F.append(ca.blockcat([[decay, 0], [decay * each, decay]]))
        roots.append(ca.blockcat([[root_11, 0], [root_21, root_22]]))
    return ca.diagcat(*F), ca.diagcat(*roots)


def turbulence(filters: Expression, intensity: Expression) -> Expression:
    """Velocity of the air along, across and vertical, (3,) (m/s); filters (5,); intensity sigma (3,) (m/s)."""
    across, vertical = (TRANSVERSE[0] * filters[i] + TRANSVERSE[1] * filters[i + 1] for i in (1, 3))
    return intensity * ca.vertcat(filters[0], across, vertical)


@keyed
class Dryden(MeanWind):
    """A mean wind and turbulence after Dryden.

    Inner: filter states (5,); the wind with which the control period begins and what each of its
    ticks adds (3, 1 + k), world (m/s), column by column, and when each tick is (k,) (s).

    parameters: mean wind (3,), world (m/s); axes (9,), column by column; intensity (3,) (m/s); scale lengths (3,) (m);
    least and largest airspeed at which the turbulence passes (m/s).
    """

    intensity: Triple | None = key(
        None, "standard deviations along the wind, across, vertical; null: by altitude and wind_at_6m", "[0, 50]", "m/s"
    )
    wind_at_6m: float | None = key(
        None, "wind speed 6 m over the ground that sets the intensity; null: that of the mean wind", "[0, 50]", "m/s"
    )
    altitude: float = key(
        6.096, "height over the ground that sets scale lengths, and intensities by wind_at_6m", "[3.048, 304.8]", "m"
    )
    length: Triple | None = key(
        None, "scale lengths along, across and vertical; null: by altitude", "[0.01, 10000]", "m"
    )
    airspeed: float | None = key(
        None, "at which turbulence passes; null: the vehicle's own through the mean wind", "[0.01, 100]", "m/s"
    )
    airspeed_min: float = key(
        1.0, "least airspeed of the vehicle that is used", "[0.01, 100]", "m/s", when="airspeed=null"
    )

    def check_together(self) -> None:
        if self.intensity is not None and self.wind_at_6m is not None:
            raise UsageError(
                f"wind.wind_at_6m={self.wind_at_6m:g}: wind.intensity is given too; one of the two sets the intensity"
            )

    stage = "wind"

    def sizes(self, clock: Clock, vehicle: Vehicle) -> Sizes:
        ticks = Ticking(N_NOISE, TICK, clock.period)
        return Sizes(N_FILTER + 3 + 4 * ticks.slots, N_PARAMETERS, (ticks,))

    def _lengths(self) -> np.ndarray:
        if self.length is None:
            return scale_lengths(self.altitude)
        return np.array(self.length)

    def start(self, rng: np.random.Generator, start: Start) -> tuple[Any, Any]:
        """The filters begin in their stationary distribution."""
        mean = np.array(self.velocity)
        intensity: Any = self.intensity
        if intensity is None:
            at_6m = self.wind_at_6m
            if at_6m is None:
                at_6m = math.hypot(*self.velocity[:2])
            intensity = intensities(self.altitude, at_6m)
        speeds = (self.airspeed_min, math.inf)
        if self.airspeed is not None:
            speeds = (self.airspeed, self.airspeed)
        parameters = np.concatenate([mean, axes(mean).ravel(order="F"), intensity, self._lengths(), speeds])
        filters = stationary(rng.standard_normal(N_NOISE))
        first = _blown()(filters, parameters).full().ravel()
        slots = Ticking(N_NOISE, TICK, start.clock.period).slots
        inner = np.concatenate([filters, first, np.zeros(4 * slots)])
        return inner, parameters

    def begin(self, at: Moment) -> Expression:
        """The winds of the period."""
        mean = at.parameters[:3]
        length = at.parameters[15:18]
        limits = at.parameters[18:20]
        airspeed = limited(ca.sqrt(ca.sumsqr(at.x[VELOCITY] - mean)), limits[0], limits[1])
        F, root = transition(length / airspeed, TICK)
        filters = at.inner[:N_FILTER]
        before = filters
        winds = [_velocity(filters, at.parameters)]
        times = []
        for slot in ca.vertsplit(at.draws, 1 + N_NOISE):
            time, noise = split(slot, (1, N_NOISE))
            before = filters
            filters = F @ filters + root @ noise
            winds.append(_velocity(filters, at.parameters))
            times.append(time)
        filters = ca.if_else(times[-1] < NEVER, filters, before)  # a period may have one tick less than there are slots
        added = [after - before for before, after in pairwise(winds)]
        return ca.vertcat(filters, winds[0], *added, *times)

    def wind(self, at: Moment) -> Expression:
        """The last that holds when the step begins."""
        count = (at.inner.numel() - N_FILTER - 3) // 4
        first, *added = ca.vertsplit(at.inner[N_FILTER:-count], 3)
        times = ca.vertsplit(at.inner[-count:])
        change = 0
        for time, more in zip(times, added, strict=True):
            change += (at.t >= time - IN_TIME) * more
        return first + change


@cache
def _blown() -> ca.Function:
    filters, parameters = symbols(ca.SX, filters=N_FILTER, parameters=N_PARAMETERS)
    return ca.Function("blown", [filters, parameters], [_velocity(filters, parameters)])


def _velocity(filters: Expression, parameters: Expression) -> Expression:
    """The wind (3,), world (m/s), of the filters (5,) and the parameters of Dryden."""
    mean = parameters[:3]
    directions = parameters[3:12]
    intensity = parameters[12:15]
    return mean + ca.reshape(directions, 3, 3) @ turbulence(filters, intensity)


def _root(s: Expression) -> tuple[Expression, Expression, Expression]:
    """Cholesky factor of Q of the pair z_1, z_2: entries 11, 21, 22."""
    root_11 = ca.sqrt(_moment(0, s))
    root_21 = _moment(1, s) / root_11
    return root_11, root_21, ca.sqrt(_moment(2, s) - root_21**2)


def _moment(k: int, s: Expression) -> Expression:
    """2 int_0^s r^k exp(-2 r) dr to a relative accuracy near rounding, for k = 0, 1, 2.

    Small s: the series exp(-2 s) s^(k+1) sum_j 2 k! (2 s)^j / (k + 1 + j)!, whose terms do not cancel.
    """
    total = 0
    for j in reversed(range(TERMS)):
        total = 2 * math.factorial(k) * 2**j / math.factorial(k + 1 + j) + s * total
    series = ca.exp(-2 * s) * s ** (k + 1) * total
    polynomial = sum((2 * s) ** j / math.factorial(j) for j in range(k + 1))
    closed = math.factorial(k) / 2**k * (1 - ca.exp(-2 * s) * polynomial)
    return ca.if_else(s < SMALL, series, closed)
