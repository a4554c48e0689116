"""Flights in wind: what is learned depends on the velocity relative to the air alone.

A flight in air that moves steadily is the flight in still air as a passing observer sees it (Galilei): p + W t, v + W,
and everything else the same. So every model fitted to the two must be the same, and so must every prediction.
"""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError
from quadexp.experiment.build import build_vehicle
from quadexp.experiment.collect import collect_dataset
from quadexp.experiment.evaluate import fly_one
from quadexp.log.schema import Flight
from quadexp.log.store import read_flight
from quadexp.models.dataset import read_dataset, residual_dataset, transitions
from quadexp.models.linear_drag import fit_linear_drag
from quadexp.parts.compose import compose
from quadexp.physics.rotation import air_velocity
from quadexp.physics.state import STATE_COLUMNS
from quadexp.plugins.identification.predictors import predictors
from quadexp.plugins.identification.validation import Track, rollout_errors
from quadexp.plugins.identification.vehicle_model import FitSettings, fit_vehicle_model
from quadexp.plugins.logs.samples import gather, read_rows
from quadexp.plugins.papers.lei_li.blade_element import identify_flight
from tests.models.test_dataset import VEHICLE
from tests.plugins.identification.test_recorded import VEHICLE as RECORDED_VEHICLE
from tests.plugins.identification.test_recorded import recorded_flight
from tests.slow import slow

WIND = np.array([5.0, -3.0, 1.0])  # m/s, world


def in_wind(flight: Flight, wind: np.ndarray = WIND) -> Flight:
    """The same flight in air that moves with `wind`, seen from the ground."""
    columns = dict(flight.columns)
    for i, axis in enumerate("xyz"):
        for name in ("p", "ref_p"):
            if f"{name}_{axis}" in columns:
                columns[f"{name}_{axis}"] = columns[f"{name}_{axis}"] + wind[i] * flight.t
        columns[f"v_{axis}"] = columns[f"v_{axis}"] + wind[i]
        columns[f"wind_{axis}"] = np.full(len(flight), wind[i])
    return replace(flight, columns=columns)


def test_the_air_velocity_is_that_of_scipy_s_rotation(rng):
    q, v, wind = rng.normal(size=(20, 4)), rng.normal(size=(20, 3)), rng.normal(size=(20, 3))
    expected = Rotation.from_quat(q, scalar_first=True).inv().apply(v - wind)
    assert air_velocity(q, v, wind) == pytest.approx(expected, abs=1e-14)
    assert air_velocity(q, v) == pytest.approx(Rotation.from_quat(q, scalar_first=True).inv().apply(v), abs=1e-14)
    for k in range(3):
        assert air_velocity(q[k], v[k], wind[k]) == pytest.approx(expected[k], abs=1e-14)
        assert np.array(air_velocity(ca.DM(q[k]), ca.DM(v[k]), ca.DM(wind[k]))).ravel() == pytest.approx(expected[k])


@pytest.mark.parametrize("frame", ["midpoint", "start"])
@pytest.mark.parametrize("seed", [0, 1])
def test_linear_drag_is_the_truth_in_a_flight_integrated_in_wind(frame, seed):
    """Newton-Euler in numpy with drag on R'(v - wind), turned in the middle; D = 0.654 N s/m over 1.2 kg."""
    drag, rng = np.array([0.654, 0.654, 0.3]), np.random.default_rng(seed)
    dt, x, rows = 0.01, np.r_[np.zeros(3), 0.9, 0.2, -0.3, 0.25, 8.0, -5.0, 3.0, 0.5, -0.8, 0.3], []
    x[3:7] /= np.linalg.norm(x[3:7])
    for k in range(300):
        wind = WIND * (1 if k < 150 else -0.5)
        u = VEHICLE.hover_thrust * (1 + 0.02 * rng.uniform(-1, 1, 4))
        rows.append(np.r_[k * dt, x, u, wind, k >= 150])

        def slope(_, x, u=u, wind=wind):
            body, w, inertia = Rotation.from_quat(x[3:7], scalar_first=True), x[10:], VEHICLE.inertia_matrix
            wrench = VEHICLE.allocation @ u
            force = np.array([0, 0, wrench[0]]) - drag * body.inv().apply(x[7:10] - wind)
            q_dot = 0.5 * np.r_[-x[4:7] @ w, x[3] * w + np.cross(x[4:7], w)]
            turn = np.linalg.solve(inertia, wrench[1:] - np.cross(w, inertia @ w))
            return np.r_[x[7:10], q_dot, body.apply(force / VEHICLE.mass) - [0, 0, 9.81], turn]

        x = solve_ivp(slope, (0, dt), x, rtol=1e-9, atol=1e-10).y[:, -1]
    names = ["t", *STATE_COLUMNS, *(f"u_{i}" for i in range(4)), "wind_x", "wind_y", "wind_z", "segment"]
    flight = Flight(dict(zip(names, np.array(rows).T.copy(), strict=True)), {})
    fitted = fit_linear_drag(residual_dataset([flight], VEHICLE, frame=frame), thrust=False, loss="squares")
    assert VEHICLE.mass * fitted.drag == pytest.approx(drag, rel=2e-3 if frame == "midpoint" else 5e-2)


def test_transitions_do_not_depend_on_the_frame_that_moves_along():
    flight = fly_one(compose(["trajectory=circle", "controller=nominal_mpc", "trajectory.acceleration=4"]))
    vehicle = build_vehicle(compose([]).vehicle)
    still, moved = (transitions(one, vehicle) for one in (flight, in_wind(flight)))
    for name, values in still.items():
        assert moved[name] == pytest.approx(values, abs=1e-9 if name[0] in "vw" else 1e-7), name
    gone = in_wind(flight)
    gone.columns["wind_y"][7] = np.nan
    with pytest.raises(DataError, match="column 'wind_y' holds nan in row 7"):
        transitions(gone, vehicle)


def test_blade_element_coefficients_are_the_same():
    bench = ["vehicle=lei_li", "plant=blade_element", "sensor=lei_li", "trajectory=rectangle", "trajectory.duration=20"]
    config = compose([*bench, "controller=oracle_feedback"])
    flight, vehicle = fly_one(config), build_vehicle(config.vehicle)
    still, moved = (identify_flight(one, vehicle) for one in (flight, in_wind(flight)))
    assert moved.raw[-1] == pytest.approx(still.raw[-1], rel=1e-7)


def test_recorded_flights_are_scored_alike():
    """Vehicle model, its predictions and their open-loop errors, in still air and in wind."""
    flights = [recorded_flight(seed, RECORDED_VEHICLE, duration=15) for seed in range(2)]
    found = []
    for group in (flights, [in_wind(flight) for flight in flights]):
        assert gather(group, "motor_command", ["a", "b"]).velocity[5] == pytest.approx(
            gather(flights, "motor_command", ["a", "b"]).velocity[5], abs=1e-9
        )
        model = fit_vehicle_model(group, RECORDED_VEHICLE, FitSettings(powers=(1,), kinds=("linear",)))
        row, drag = read_rows(group[0], "flight", "motor_command"), predictors(model, "x", RECORDED_VEHICLE, None)[1]
        track = Track(row, drag)
        errors = [
            rollout_errors([track], [0.1, 0.5], tracked=False, vehicle=whole)[1]["position"]
            for whole in (None, RECORDED_VEHICLE)
        ]
        found.append(errors)
    assert found[1] == pytest.approx(found[0], rel=1e-5)


@pytest.mark.parametrize(
    "wind",
    [
        ["wind=constant", "wind.velocity=[4,-3,1]"],
        ["wind=dryden", "wind.velocity=[3,3,0]", "wind.intensity=[1,1,0.6]"],
        *slow(["wind=gust", "wind.velocity=[1,2,0]", "wind.amplitude=[6,-2,1]"]),
    ],
    ids=lambda wind: wind[0],
)
def test_drag_collected_in_a_wind_is_that_of_still_air(tmp_path, wind):
    """The plant's own 0.3 N s/m over 1 kg, from flights with their wind; without its columns it is not."""
    plant = ["plant.quadratic_drag=[0,0,0]", "plant.motor_loss=0"]
    config = compose([*plant, "collect.duration=15", "collect.speed_max=6", *wind])
    collect_dataset(config, tmp_path / "rows.parquet", save_flights=tmp_path / "flights")
    found = fit_linear_drag(read_dataset(tmp_path / "rows.parquet"))
    assert found.drag == pytest.approx([0.3, 0.3, 0.0], abs=2e-3)
    assert np.abs(found.intercept[:2]).max() < 5e-3
    told = []
    for file in sorted((tmp_path / "flights").glob("*.parquet")):
        flight = read_flight(file)
        assert np.abs(flight.wind).max() > 1
        columns = {name: values for name, values in flight.columns.items() if not name.startswith("wind_")}
        told.append(replace(flight, columns=columns))
    untold = fit_linear_drag(residual_dataset(told, build_vehicle(config.vehicle)))
    assert np.abs(untold.intercept[:2]).max() > 0.2


def test_an_identified_vehicle_is_validated_in_gusts_by_the_wind_of_its_flights():
    """Drag of the plant from flights in gusts; half a second ahead another flight is predicted better with its wind."""
    plant = ["plant.quadratic_drag=[0,0,0]", "plant.motor_loss=0", "wind=gust", "wind.amplitude=[6,-3,1]"]
    configs = [
        compose(
            [*plant, "trajectory=random", "trajectory.speed=5", f"trajectory.seed={seed}", f"wind.onset={1 + seed}"]
        )
        for seed in range(3)
    ]
    vehicle, flights = build_vehicle(configs[0].vehicle), [fly_one(config) for config in configs]
    model = fit_vehicle_model(flights[:2], vehicle, FitSettings(powers=(1,), kinds=("linear",)))
    assert model.linear_drag.drag[:2] == pytest.approx([0.3, 0.3], abs=2e-3)
    columns = {name: values for name, values in flights[2].columns.items() if not name.startswith("wind_")}
    errors = []
    for flight in (flights[2], replace(flights[2], columns=columns)):
        drag = predictors(model, "x", vehicle, None)[1]
        track = Track(read_rows(flight, "flight", model.thrust.signal), drag)
        (rollout,) = rollout_errors([track], [0.5], tracked=False)
        errors.append(rollout["velocity"])
    assert errors[0] < 0.1 * errors[1]
