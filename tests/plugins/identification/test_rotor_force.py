"""Force from rotor speeds: the constants of a flown blade element, its verdict, and nothing beyond the mean outside."""

from dataclasses import replace

import numpy as np
import pytest

from quadexp import requests
from quadexp.experiment.build import build_vehicle
from quadexp.models.base import AXIS, outside
from quadexp.models.checkpoint import load_model, plain, save_model
from quadexp.models.dataset import ResidualDataset, read_dataset
from quadexp.models.verdict import split_by_flight, verdict, verdict_lines
from quadexp.parts.compose import compose
from quadexp.plugins.aerodynamics.coefficients import BladeCoefficients
from quadexp.plugins.identification.rotor_force import RotorForce, fit_mean
from tests.plugins.aerodynamics.test_terms import lumped_coefficients

FLOWN = [
    "vehicle=lei_li", "plant=blade_element", "plant.method=rk4", "plant.step=2.5e-3", "controller=geometric",
    "collect.speed_max=6",
]  # fmt: skip
SMALL = RotorForce(inducing=15, max_rows=500, max_iterations=15)


def flown(folder, seed: int, seconds: float = 60.0) -> ResidualDataset:
    """Rows of flights in the blade-element plant, their thrust by the logged rotor speeds."""
    flights = folder / "flights"
    requests.collect(
        [*FLOWN, f"seed={seed}", f"collect.duration={seconds}"], folder / "a.parquet", save_flights=flights
    )
    words = ["vehicle=lei_li", "collect.target=specific_force"]
    requests.collect(words, folder / "b.parquet", flights=sorted(flights.glob("*.parquet")))
    return read_dataset(folder / "b.parquet")


def noisy(rows: ResidualDataset, seed: int, noise: float = 0.05) -> ResidualDataset:
    rng = np.random.default_rng(seed)
    readings = {name: rows.columns[name] + noise * rng.standard_normal(rows.n_rows) for name in AXIS}
    return rows._replace(columns=dict(rows.columns) | readings)


@pytest.fixture(scope="module")
def vehicle():
    return build_vehicle(compose(["vehicle=lei_li"]).vehicle)


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    return flown(tmp_path_factory.mktemp("flown"), 5)


@pytest.fixture(scope="module")
def split(rows):
    return split_by_flight(noisy(rows, 1), 0.4)


@pytest.fixture(scope="module")
def fitted(split):
    return SMALL.fit(split[0])


def truth_of(vehicle) -> dict:
    blade = BladeCoefficients(lift_slope=3.32, profile_drag=0.22, body_drag=(0.01, 0.01, 0.02))  # conf/plant
    return lumped_coefficients(vehicle.rotor, blade, vehicle.mass, vehicle.thrust_coefficient)


def test_the_constants_of_the_plant_are_inside_their_intervals(rows, vehicle):
    """Three draws of the accelerometer's noise; 14 constants, of which 95 % should be inside."""
    truth, inside = truth_of(vehicle), []
    for seed in range(3):
        mean = fit_mean(noisy(rows, seed), vehicle.rotor.radius)
        for row in mean.model.records():
            wanted, half = truth.get((row["axis"], row["term"]), 0.0), row["high"] - row["value"]
            assert abs(row["value"] - wanted) < 2.5 * half, row
            inside.append(abs(row["value"] - wanted) < half)
    assert np.mean(inside) >= 0.85


@pytest.mark.slow
@pytest.mark.parametrize("seed", [21, 22, 23])
def test_so_they_are_on_other_flights(tmp_path, vehicle, seed):
    truth, data = truth_of(vehicle), flown(tmp_path, seed)
    for row in fit_mean(noisy(data, seed), vehicle.rotor.radius).model.records():
        wanted, half = truth.get((row["axis"], row["term"]), 0.0), row["high"] - row["value"]
        assert abs(row["value"] - wanted) < 2.5 * half, row


def test_it_beats_drag_and_says_beside_what(fitted, split):
    report = verdict(fitted, *split)
    assert {row["model"] for row in report["beside"]} == {"its blade element alone", "GP of velocity"}
    by_name = {row["model"]: row["rms"] for row in report["identified"]}
    assert by_name["this fit"] < 0.5 * min(by_name["linear drag"], by_name["quadratic"])
    assert by_name["this fit"] <= 1.01 * by_name["blade element"]
    text = "\n".join(verdict_lines(report))
    assert "beside its blade element alone" in text and "beside GP of velocity" in text


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_outside_the_range_of_any_feature_it_is_its_mean(fitted, split, seed):
    """Exactly, so it is never worse; and within it is not the mean."""
    rng = np.random.default_rng(seed)
    train = split[0]
    assert fitted.outputs
    assert np.abs(fitted.acceleration(train) - fitted.mean.acceleration(train)).max() > 1e-4
    columns = {
        name: np.array(column, float)
        for name, column in train.rows(np.arange(200)).columns.items()
        if name != "flight_name"
    }
    name = fitted.features[rng.integers(len(fitted.features))]
    low, high = (float(fitted.edges[fitted.features.index(name), end]) for end in (0, 3))
    columns[name] = np.where(rng.random(200) < 0.5, low - rng.random(200), high + rng.random(200))
    far = ResidualDataset(columns, train.metadata)
    assert outside({name: [low, high]}, far)["any"].all()
    assert np.array_equal(fitted.acceleration(far), fitted.mean.acceleration(far))


def test_what_flies_is_what_is_predicted(fitted, split, vehicle):
    data = split[1].rows(np.arange(0, split[1].n_rows, 40))
    residual = fitted.residual(vehicle)
    z = data.matrix(fitted.features)
    np.testing.assert_allclose(residual(z)[:, :3], fitted.acceleration(data), atol=1e-9)
    for point in z[:5]:  # the derivative, by differences
        slope = np.array(residual.function(point, residual.theta)[1])
        for i in range(len(point)):
            step = 1e-6 * np.eye(len(point))[i]
            ends = residual(np.stack([point - step, point + step]))
            assert slope[:, i] == pytest.approx((ends[1] - ends[0]) / 2e-6, abs=2e-5)


def test_a_checkpoint_is_the_model(fitted, split, tmp_path):
    loaded = load_model(save_model(tmp_path / "model", fitted))
    assert plain(loaded) == plain(fitted)
    assert np.array_equal(loaded.acceleration(split[1]), fitted.acceleration(split[1]))


def test_a_log_without_rotor_speeds_says_so_and_has_the_mean(split):
    thrust = dict(split[0].metadata["thrust"]) | {"signal": "motor_command"}
    data = split[0]._replace(metadata=dict(split[0].metadata) | {"thrust": thrust})
    model = replace(SMALL, rotor_radius=0.12).fit(data)
    assert not model.outputs
    assert "no rotor speeds; its thrust is that of motor_command" in model.summary
    np.testing.assert_array_equal(model.acceleration(data), model.mean.acceleration(data))
