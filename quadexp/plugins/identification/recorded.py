"""Residual dataset from recorded flights: measured specific force minus the thrust curve, one row per sample.

    a = f - (0, 0, sum_i a_i)        body FLU, m/s^2;   u_i = m a_i  (N)

with f the accelerometer's specific force and a_i the acceleration of a rotor by the thrust curve
(quadexp.plugins.identification.thrust_curve). The velocity in the features is relative to the air. The alternative
target "velocity" (transitions of quadexp.models.dataset) differentiates an estimated velocity and so contains the
estimator's filter and amplified noise.

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
from pathlib import Path

import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.log import store
from quadexp.log.schema import Flight, is_recorded
from quadexp.models.checkpoint import plain
from quadexp.models.dataset import ResidualDataset, by_axis, joined, transitions
from quadexp.models.residual import THRUST
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.identification.thrust_curve import ThrustCurve
from quadexp.plugins.logs.samples import QUATERNION, choose_signal, read_rows, rotor_columns

MEMORY = 10.0  # s, of the tracked scale
PRIOR = 0.5  # s


def read_recorded(path: Path) -> Flight:
    """Read a flight that may lack commanded thrusts, as a log does. Raises DataError unless time, attitude and velocity
    are finite, time increases and no sample was left out."""
    needed = ("t", *QUATERNION, "v_x", "v_y", "v_z")
    columns, record = store.read_table(path, "flight", required=needed)
    store.check_finite(columns, needed, str(path))
    store.check_attitude(columns, str(path))
    store.check_whole(record, str(path))
    store.check_order(columns["t"], str(path))
    return Flight(columns, record)


def logged_thrust(flights: Sequence[Flight], vehicle: Vehicle) -> ThrustCurve:
    """The curve of a log with logged thrust: u in N, or thrust_acceleration in m/s^2, unchanged. Of simulated flights
    with rotor speeds those, by the vehicle's thrust coefficient.

    Raises UsageError where the log has commands or rotor speeds only, which need an identified curve.
    """

    def have(signal: str) -> bool:
        return all(rotor_columns(flight, signal) for flight in flights)

    def curve(signal: str, power: float, coefficient: float) -> ThrustCurve:
        powers = np.array([power])
        return ThrustCurve(signal, powers, np.array([coefficient]), np.zeros(1), rotors=vehicle.n_rotors)

    simulated = not any(map(is_recorded, flights))
    if simulated and vehicle.thrust_coefficient is not None and have("rotor_speed"):
        return curve("rotor_speed", 2.0, vehicle.thrust_coefficient / vehicle.mass)
    if have("u"):
        return curve("u", 1.0, 1 / vehicle.mass)
    if have("thrust_acceleration"):
        return curve("thrust_acceleration", 1.0, 1.0)
    raise UsageError(
        f"collect.identified: these flights have {choose_signal(flights)}, not thrust: give the folder of"
        " `quadexp identify FLIGHT... --out models/NAME`"
    )


def force_rows(flight: Flight, vehicle: Vehicle, curve: ThrustCurve, name: str = "flight") -> dict[str, np.ndarray]:
    """Columns t, dt, v_* (body, relative to the air), w_*, a_*, u_*, thrust of one flight, (k,) each; see the module.

    Raises DataError for a column that is missing or not finite, and for another number of rotors than the vehicle's.
    """
    row = read_rows(flight, name, curve.signal, curve.delay, curve.lag)
    samples = row.samples
    rotors = curve.of_signal(samples.signal, samples.voltage)
    if rotors.shape[1] != vehicle.n_rotors:
        raise DataError(f"{name}: {rotors.shape[1]} rotors, vehicle '{vehicle.name}' has {vehicle.n_rotors}")
    collective = rotors.sum(axis=1)
    steps = np.diff(samples.time)  # to the next row within a segment, the median step at its end
    within = np.diff(samples.segment) == 0
    usual = float(np.median(steps[within])) if within.any() else 0.0
    return {
        "t": samples.time,
        "dt": np.append(np.where(within, steps, usual), usual),
        **by_axis(v=samples.velocity, w=row.rate, a=samples.force - collective[:, None] * [0.0, 0.0, 1.0]),
        **{f"u_{i}": vehicle.mass * rotor for i, rotor in enumerate(rotors.T)},
        THRUST: vehicle.mass * collective,
    }


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
    metadata = {
        "vehicle": vehicle.record,
        "frame": "sample" if target == "specific_force" else frame,
        "target": target,
        "flights": records,
        "recorded": True,
        "thrust": plain(curve),
    }
    return ResidualDataset(columns, metadata)


def tracked_scale(collective: np.ndarray, measured: np.ndarray, dt: float) -> np.ndarray:
    """g of the module before every sample of one flight, (k,); collective c, measured y: (k,) m/s^2. dt: s.

    c may be zero at first, on the ground; until it is not, g is 1."""
    from scipy.signal import lfilter

    decay = float(np.exp(-dt / MEMORY))
    first = int(np.argmax(collective != 0))
    elapsed = np.maximum(np.arange(len(collective)) - first, 0)  # samples
    prior = PRIOR / dt * (collective[first] or 1.0) ** 2 * decay**elapsed
    products = np.stack([collective * measured, collective * collective])
    above, below = lfilter([0.0, 1.0], [1.0, -decay], products, axis=1)
    return (prior + above) / (prior + below)
