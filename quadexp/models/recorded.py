"""Residual dataset from recorded flights: measured specific force minus the thrust curve, one row per sample.

    a = f - (0, 0, sum_i a_i)        body FLU, m/s^2;   u_i = m a_i  (N)

with f the accelerometer's specific force and a_i the acceleration of a rotor by the thrust curve
(quadexp.models.thrust_curve). The velocity in the features is relative to the air. The alternative target "velocity"
(transitions of quadexp.models.dataset) differentiates an estimated velocity and so contains the estimator's filter and
amplified noise.

A used battery, another propeller or a warmer motor changes the thrust of a command by a few per cent from flight to
flight, and no function of the velocity can predict that:

    a_z = e_f T / m + acceleration of the air        e_f: of flight f; T / m: the thrust curve's acceleration, m/s^2

A regression over several flights would attribute e_f to whatever differs between them (speed, mean thrust) and be wrong
on the next one; and e_f alone would take the lift of the faster flight for a fuller battery. So both are one mixed
model
(Laird & Ware 1982),

    a_z = (e + e_f) T / m + l V_h^2 - d v_z - q |v_z| v_z,    e_f ~ N(0, s^2),    V_h^2 = v_x^2 + v_y^2

by expectation and maximisation of s and of the noise, which is correlated over the samples. Models are fitted to
recorded flights after every flight's e_f has been brought to their mean (`with_common_scale`), and the spread of e_f is
added to the predicted variance.

On a new flight e is unknown at take-off and can be tracked from the accelerometer (`tracked_scale`):

    f_z - a_z(v) = g c + e        g_k = (p r^k + sum_{j<k} r^{k-j} c_j y_j) / (p r^k + sum_{j<k} r^{k-j} c_j^2)

with c the thrust curve's collective acceleration, y the measured one, r = exp(-dt / memory). g_k uses samples before k
only, so that such a prediction could be made in flight. It starts at 1 with prior weight p, that of half a second of
data. The memory is long (10 s): a short one would reproduce the last residual rather than a scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.log.schema import Flight
from quadexp.models.checkpoint import plain
from quadexp.models.dataset import ResidualDataset, by_axis, joined, transitions
from quadexp.models.regression import autocorrelation_time
from quadexp.models.residual import THRUST, VELOCITY
from quadexp.models.samples import choose_signal, read_rows, rotor_columns
from quadexp.models.thrust_curve import ThrustCurve
from quadexp.physics.vehicle import Vehicle

MEMORY = 10.0  # s, of the tracked scale
PRIOR = 0.5  # s
ROUNDS = 60  # of expectation and maximisation
THRUST_SIGNALS = ("u", "thrust_acceleration")  # in units of force or acceleration, usable without a thrust curve


def is_recorded(flight: Flight) -> bool:
    """Whether the flight comes from a log, not from a simulated plant."""
    return bool(flight.metadata.get("recorded", False))


def logged_thrust(flights: Sequence[Flight], vehicle: Vehicle) -> ThrustCurve:
    """The curve of a log with logged thrust: u in N, or thrust_acceleration in m/s^2, unchanged. Of simulated flights
    with rotor speeds those, by the vehicle's thrust coefficient.

    Raises UsageError where the log has commands or rotor speeds only, which need an identified curve.
    """
    k, simulated = vehicle.thrust_coefficient, not any(map(is_recorded, flights))
    if simulated and k is not None and all(rotor_columns(flight, "rotor_speed") for flight in flights):
        scale = k / vehicle.mass
        return ThrustCurve("rotor_speed", np.array([2.0]), np.array([scale]), np.zeros(1), rotors=vehicle.n_rotors)
    signals = [name for name in THRUST_SIGNALS if all(rotor_columns(flight, name) for flight in flights)]
    if not signals:
        raise UsageError(
            f"collect.identified: these flights have {choose_signal(flights)}, not thrust: give the folder of"
            " `quadexp identify FLIGHT... --out models/NAME`"
        )
    scale = 1 / vehicle.mass if signals[0] == "u" else 1.0
    return ThrustCurve(signals[0], np.array([1.0]), np.array([scale]), np.zeros(1), rotors=vehicle.n_rotors)


def force_rows(flight: Flight, vehicle: Vehicle, curve: ThrustCurve, name: str = "flight") -> dict[str, np.ndarray]:
    """Columns t, dt, v_* (body, relative to the air), w_*, a_*, u_*, thrust of one flight, (k,) each; see the module.

    Raises DataError for a column that is missing or not finite, and for another number of rotors than the vehicle's.
    """
    row = read_rows(flight, name, curve.signal, curve.delay, curve.lag)
    samples = row.samples
    rotors = curve.of_signal(samples.signal, samples.voltage)
    if rotors.shape[1] != vehicle.n_rotors:
        raise DataError(f"{name}: {rotors.shape[1]} rotors, vehicle '{vehicle.name}' has {vehicle.n_rotors}")
    residual = samples.force.copy()
    residual[:, 2] -= rotors.sum(axis=1)
    steps = np.diff(samples.time)  # to the next row within a segment, the median step at its end
    together = samples.segment[1:] == samples.segment[:-1]
    usual = float(np.median(steps[together])) if together.any() else 0.0
    columns = {"t": samples.time, "dt": np.append(np.where(together, steps, usual), usual)}
    columns |= by_axis(v=samples.velocity, w=row.rate, a=residual)
    columns |= {f"u_{i}": vehicle.mass * rotors[:, i] for i in range(vehicle.n_rotors)}
    return columns | {THRUST: vehicle.mass * rotors.sum(axis=1)}


def recorded_dataset(
    flights: Sequence[Flight], vehicle: Vehicle, curve: ThrustCurve, *, target: str = "specific_force",
    frame: str = "midpoint", names: Sequence[str] | None = None,
) -> ResidualDataset:  # fmt: skip
    """The rows of many flights in one table, each row with its flight.

    names: see quadexp.models.dataset.joined. The metadata also contain the target, and the thrust curve, with which a
    model can predict other flights. Raises DataError as the functions above do.
    """

    def table_of(flight: Flight, name: str) -> dict[str, np.ndarray]:
        if target == "specific_force":
            return force_rows(flight, vehicle, curve, name)
        thrust = vehicle.mass * curve.rotor_acceleration(flight)  # transitions under the curve's thrusts
        commanded = {f"u_{i}": u for i, u in enumerate(thrust.T)}
        return transitions(replace(flight, columns=dict(flight.columns) | commanded), vehicle, frame=frame)

    columns, records = joined(flights, vehicle, names, table_of)
    for record, flight in zip(records, flights, strict=True):
        record |= {"left_out": len(flight) - record["rows"], "seed": None}
    metadata: dict[str, Any] = {"vehicle": vehicle.record, "frame": "sample" if target == "specific_force" else frame}
    metadata |= {"target": target, "flights": records, "recorded": True, "thrust": plain(curve)}
    return ResidualDataset(columns, metadata)


class CommonScale(NamedTuple):
    """dataset: rows with one thrust scale on all flights. errors: e_f by flight index. level: mean T / m, m/s^2."""

    dataset: ResidualDataset
    errors: dict[int, float]
    level: float

    @property
    def variance(self) -> float:
        """Variance of a_z on a new flight due to the spread of e_f, (m/s^2)^2; 0 with one flight."""
        values = list(self.errors.values())
        return float(np.var(values, ddof=1)) * self.level**2 if len(values) > 1 else 0.0


def has_thrust_scale(dataset: ResidualDataset) -> bool:
    """Whether the rows come from recorded flights under a thrust curve, whose scale may differ between flights."""
    return bool(dataset.metadata.get("recorded")) and "mass" in (dataset.metadata.get("vehicle") or {})


def with_common_scale(dataset: ResidualDataset) -> CommonScale:
    """Bring e_f to its mean over the flights, where these have one; see the module."""
    if not has_thrust_scale(dataset):
        return CommonScale(dataset, {}, 0.0)
    mass = dataset.metadata["vehicle"]["mass"]
    acceleration = dataset.matrix([THRUST])[:, 0] / mass
    a_z = dataset.matrix(["a_z"])[:, 0].copy()
    indices, flight = np.unique(dataset.columns["flight"], return_inverse=True)
    scales = _scales_of_flights(a_z, acceleration, dataset.matrix(VELOCITY), flight)
    a_z -= (scales - scales.mean())[flight] * acceleration
    columns = dict(dataset.columns) | {"a_z": a_z}
    errors = {int(index): float(scale) for index, scale in zip(indices, scales, strict=True)}
    return CommonScale(ResidualDataset(columns, dataset.metadata), errors, float(acceleration.mean()))


def _scales_of_flights(a_z: np.ndarray, thrust: np.ndarray, velocity: np.ndarray, flight: np.ndarray) -> np.ndarray:
    """e + e_f, (flights,), of the mixed model. a_z, thrust (T / m): (k,); velocity: (k, 3) body; flight: (k,) index."""
    count = int(flight.max()) + 1
    v_z = velocity[:, 2]
    air = np.column_stack([velocity[:, 0] ** 2 + velocity[:, 1] ** 2, v_z, np.abs(v_z) * v_z])
    air = air[:, air.any(axis=0)]
    each = np.zeros((len(a_z), count))
    each[np.arange(len(a_z)), flight] = thrust
    design = np.column_stack([thrust, air, each])
    size = np.sqrt(np.mean(design**2, axis=0)) + 1e-12
    size[-count:] = size[0]  # a scale of one flight is compared with that of all
    design = design / size
    fixed = design.shape[1] - count
    normal, mixed = design.T @ design, design.T @ a_z
    alone = np.linalg.lstsq(design, a_z, rcond=None)[0]
    together = max(autocorrelation_time((a_z - design @ alone)[flight == index]) for index in range(count))
    noise, spread = float(np.mean((a_z - design @ alone) ** 2)) + 1e-12, float(np.mean(alone[fixed:] ** 2)) + 1e-12
    for _ in range(ROUNDS):
        precision = normal / (noise * together)
        precision[np.arange(fixed, len(precision)), np.arange(fixed, len(precision))] += 1 / spread
        covariance = np.linalg.pinv(precision, hermitian=True)
        found = covariance @ mixed / (noise * together)
        noise = float(np.mean((a_z - design @ found) ** 2)) + 1e-12
        spread = float(np.mean(found[fixed:] ** 2 + np.diag(covariance)[fixed:])) + 1e-12
    return (found[0] + found[fixed:]) / size[0]


def tracked_scale(collective: np.ndarray, measured: np.ndarray, dt: float) -> np.ndarray:
    """g of the module before every sample of one flight, (k,); collective c, measured y: (k,) m/s^2. dt: s."""
    from scipy.signal import lfilter

    decay = float(np.exp(-dt / MEMORY))
    prior = PRIOR / dt * collective[0] ** 2 * decay ** np.arange(len(collective))
    past = lfilter([0.0, 1.0], [1.0, -decay], np.stack([collective * measured, collective * collective]), axis=1)
    return (prior + past[0]) / (prior + past[1])
