"""The residual target is the force that was added to a rigid body, to the order in dt that the frame promises."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError, UsageError
from quadexp.log.schema import Flight
from quadexp.models.dataset import ResidualDataset, residual_dataset, transitions
from quadexp.physics.state import STATE_COLUMNS
from quadexp.physics.vehicle import Vehicle

VEHICLE = Vehicle(
    name="test",
    mass=1.2,
    inertia=((0.03, 0.001, 0.0), (0.001, 0.025, 0.0), (0.0, 0.0, 0.05)),
    rotor_position=((0.17, 0.17, 0.0), (-0.17, 0.17, 0.0), (-0.17, -0.17, 0.0), (0.17, -0.17, 0.0)),
    rotor_spin=(-1.0, 1.0, -1.0, 1.0),
    torque_coefficient=0.013,
    thrust_min=0.0,
    thrust_max=20.0,
    rate_max=20.0,
)


def simulate(
    dt: float, steps: int = 20, *, force=lambda v, w: np.zeros(3), torque=lambda v, w: np.zeros(3),
    vehicle: Vehicle = VEHICLE, seed: int = 0,
) -> Flight:  # fmt: skip
    """A flight of the rigid body with a body force (N) and torque (N m) of (v_body, w), by an independent integrator.

    Newton-Euler written out in numpy here; the rotors' thrust changes every dt.
    """
    rng = np.random.default_rng(seed)
    inertia = vehicle.inertia_matrix

    def derivative(_, x, u):
        w, body = x[10:], Rotation.from_quat(x[3:7], scalar_first=True)
        v = body.inv().apply(x[7:10])
        wrench = vehicle.allocation @ u
        acceleration = body.apply([0, 0, wrench[0] / vehicle.mass] + force(v, w) / vehicle.mass)
        q = x[3:7]
        q_dot = 0.5 * np.array([-q[1:] @ w, *(q[0] * w + np.cross(q[1:], w))])
        w_dot = np.linalg.solve(inertia, wrench[1:] + torque(v, w) - np.cross(w, inertia @ w))
        return np.concatenate([x[7:10], q_dot, acceleration + [0, 0, -9.81], w_dot])

    x = np.concatenate([np.zeros(3), [0.9, 0.2, -0.3, 0.25], [8.0, -5.0, 3.0], [2.0, -3.0, 1.0]])
    x[3:7] /= np.linalg.norm(x[3:7])
    states, inputs = [x], []
    for _ in range(steps):
        u = vehicle.hover_thrust * (1 + 0.2 * rng.uniform(-1, 1, 4))
        x = solve_ivp(derivative, (0, dt), x, args=(u,), rtol=1e-11, atol=1e-12).y[:, -1]
        states.append(x)
        inputs.append(u)
    inputs.append(inputs[-1])
    table, u = np.array(states), np.array(inputs)
    columns = {"t": dt * np.arange(steps + 1)} | {name: table[:, i] for i, name in enumerate(STATE_COLUMNS)}
    columns |= {f"u_{i}": u[:, i] for i in range(4)}
    return Flight(columns, {"vehicle": {"fingerprint": vehicle.fingerprint}})


def stacked(columns, prefix: str) -> np.ndarray:
    return np.stack([columns[f"{prefix}_{axis}"] for axis in "xyz"], axis=1)


def test_body_force_and_torque_are_recovered():
    force, torque = np.array([1.5, -0.8, 0.6]), np.array([0.004, -0.003, 0.002])
    columns = transitions(simulate(0.01, force=lambda v, w: force, torque=lambda v, w: torque), VEHICLE)
    # Turning at 4 rad/s, the mean of a rotating force over dt is short by (w dt)^2 / 24 = 7e-5 of it.
    np.testing.assert_allclose(stacked(columns, "a"), np.tile(force / VEHICLE.mass, (20, 1)), atol=3e-4)
    np.testing.assert_allclose(stacked(columns, "tau"), np.tile(torque, (20, 1)), atol=2e-6)


@pytest.mark.parametrize(("frame", "order"), [("start", 1.0), ("midpoint", 2.0)])
def test_order_in_dt(frame, order):
    """Against the drag and the damping torque that the row's own features predict, beside the gyroscopic coupling of an
    uneven inertia: first order at the start, second at the midpoint."""

    def force(v):
        return -0.3 * v - 0.08 * v * np.abs(v) - [0, 0, 0.5]

    errors = []
    for dt in (0.04, 0.02, 0.01):
        flight = simulate(dt, steps=round(0.4 / dt), force=lambda v, w: force(v), torque=lambda v, w: -0.02 * w)
        columns = transitions(flight, VEHICLE, frame=frame)
        beside = stacked(columns, "a") - force(stacked(columns, "v")) / VEHICLE.mass
        errors.append([np.std(beside), np.std(stacked(columns, "tau") + 0.02 * stacked(columns, "w"))])
    slopes = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(slopes, order, atol=0.3)


def test_features():
    flight = simulate(0.02)
    columns = transitions(flight, VEHICLE, frame="start")
    attitude = Rotation.from_quat(flight.state[:-1, 3:7], scalar_first=True)
    np.testing.assert_allclose(stacked(columns, "v"), attitude.inv().apply(flight.state[:-1, 7:10]), atol=1e-12)
    np.testing.assert_allclose(columns["thrust"], flight.input[:-1].sum(axis=1))
    np.testing.assert_allclose(columns["t"], flight.t[:-1])
    np.testing.assert_allclose(transitions(flight, VEHICLE)["t"], flight.t[:-1] + 0.01)


def test_sign_of_the_quaternion_does_not_matter():
    flight = simulate(0.02)
    flipped = {name: values.copy() for name, values in flight.columns.items()}
    for name in ("q_w", "q_x", "q_y", "q_z"):
        flipped[name][5::2] *= -1
    for name, values in transitions(flight, VEHICLE).items():
        np.testing.assert_allclose(transitions(Flight(flipped, {}), VEHICLE)[name], values, atol=1e-9)


def test_breaks_make_no_transition():
    flight = simulate(0.02)
    segment = np.zeros(21, int)
    segment[8:] = 1
    late = flight.t + np.where(np.arange(21) >= 13, 0.03, 0.0)
    columns = transitions(Flight(flight.columns | {"t": late, "segment": segment}, {}), VEHICLE, frame="start")
    np.testing.assert_allclose(columns["t"], np.delete(late[:-1], [7, 12]))
    assert len(transitions(Flight(flight.columns | {"segment": np.arange(21)}, {}), VEHICLE)["t"]) == 0


def test_flights_are_not_joined_and_rows_say_where_they_came_from():
    flights = [simulate(0.02, steps=5), simulate(0.02, steps=7, seed=1)]
    dataset = residual_dataset(flights, VEHICLE, names=["a.parquet", "b.parquet"])
    assert dataset.n_rows == 12
    assert list(dataset.columns["flight"]) == [0] * 5 + [1] * 7
    assert set(dataset.columns["flight_name"][5:]) == {"b.parquet"}
    assert [record["rows"] for record in dataset.metadata["flights"]] == [5, 7]
    assert dataset.metadata["vehicle"] == {"name": "test", "fingerprint": VEHICLE.fingerprint, "mass": 1.2}
    columns, metadata = dataset
    assert ResidualDataset(columns, metadata).sha256 == dataset.sha256


def test_simulated_rows_carry_what_a_mean_of_terms_needs():
    """gp.mean=quadratic asks for the vehicle's mass: the drag that acted comes back from rows of simulated flights."""

    def drag(v, w):
        return -(0.3 * v + 0.08 * v * np.abs(v))

    flights = [simulate(0.02, steps=80, force=drag, seed=seed) for seed in range(4)]
    dataset = residual_dataset(flights, VEHICLE)
    from quadexp.plugins.aerodynamics.terms import fit_term_mean

    mean = fit_term_mean(dataset, "quadratic")
    found, true = mean.acceleration(dataset), np.array([drag(v, None) for v in dataset.matrix(("v_x", "v_y", "v_z"))])
    assert mean.mass == 1.2
    assert np.abs(found * 1.2 - true).max() < 0.05 * np.abs(true).max()


def test_bad_flights_are_named():
    flight = simulate(0.02, steps=5)
    holed = flight.columns | {"v_y": flight.columns["v_y"].copy()}
    holed["v_y"][3] = np.nan
    with pytest.raises(DataError, match=r"b: column 'v_y' holds nan in row 3"):
        residual_dataset([flight, Flight(holed, {})], VEHICLE, names=["a", "b"])
    short = {name: values for name, values in flight.columns.items() if name != "u_2"}
    with pytest.raises(DataError, match="column 'u_2' is missing"):
        residual_dataset([Flight(short, {})], VEHICLE)
    with pytest.raises(DataError, match="hold no transition"):
        residual_dataset([Flight({name: values[:1] for name, values in flight.columns.items()}, {})], VEHICLE)
    with pytest.raises(DataError, match="hold no transition"):
        residual_dataset([], VEHICLE)
    with pytest.raises(DataError, match="flown by vehicle"):
        residual_dataset([flight], replace(VEHICLE, mass=1.3))
    with pytest.raises(DataError, match="quaternion's norm"):
        residual_dataset([Flight(flight.columns | {"q_w": np.zeros(6)}, {})], VEHICLE)
    with pytest.raises(UsageError, match="collect.frame: 'end'"):
        transitions(flight, VEHICLE, frame="end")


def test_missing_and_damaged_columns_of_a_dataset_are_named(dataset):
    with pytest.raises(DataError, match="column 'v_q' is missing; it has .*v_x"):
        dataset.matrix(["v_x", "v_q"])
    columns = dict(dataset.columns)
    del columns["thrust"]
    np.testing.assert_allclose(ResidualDataset(columns, {}).matrix(["thrust"])[:, 0], dataset.columns["thrust"])


def test_hash_sees_every_value_and_name(dataset):
    changed = dict(dataset.columns) | {"a_x": dataset.columns["a_x"].copy()}
    changed["a_x"][17] = np.nextafter(changed["a_x"][17], 1)
    assert ResidualDataset(changed, {}).sha256 != dataset.sha256
    shuffled = dict(reversed(dataset.columns.items()))
    assert ResidualDataset(shuffled, {}).sha256 == dataset.sha256
