"""The drag fit is least squares, and its standard errors say how far off it is."""

import numpy as np
import pytest
from scipy.optimize import minimize

from quadexp.errors import DataError
from quadexp.models.dataset import ResidualDataset
from quadexp.models.linear_drag import fit_linear_drag
from tests.models.synthetic import synthetic_dataset

DRAG, INTERCEPT, GAIN = np.array([0.31, 0.27, 0.12]), np.array([0.1, -0.2, 0.05]), -0.02


def linear_rows(rows=600, seed=0, flights=6, noise=lambda v: 0.3, shared=0.0) -> ResidualDataset:
    """Rows of exactly linear drag; noise: its standard deviation given the velocity; shared: the same for a flight."""
    rng = np.random.default_rng(seed)
    v, thrust = rng.uniform(-10, 10, (rows, 3)), rng.uniform(5, 30, rows)
    flight = np.arange(rows) * flights // rows
    a = -DRAG * v + INTERCEPT + noise(v) * rng.normal(size=(rows, 3)) + shared * rng.normal(size=(flights, 3))[flight]
    a[:, 2] += GAIN * thrust
    columns = {f"v_{axis}": v[:, i] for i, axis in enumerate("xyz")} | {"thrust": thrust, "flight": flight}
    columns |= {f"a_{axis}": a[:, i] for i, axis in enumerate("xyz")}
    return ResidualDataset(columns, {})


def test_equals_the_normal_equations():
    rows = linear_rows(noise=lambda v: 0.05 + 0.1 * np.abs(v))
    fit = fit_linear_drag(rows, loss="squares")
    x = np.column_stack([-rows.columns["v_z"], rows.columns["thrust"], np.ones(600)])
    y = rows.columns["a_z"]
    beta = np.linalg.solve(x.T @ x, x.T @ y)
    e = y - x @ beta
    np.testing.assert_allclose([fit.drag[2], fit.thrust_gain, fit.intercept[2]], beta, rtol=1e-10)
    np.testing.assert_allclose(fit.r_squared[2], 1 - np.sum(e**2) / np.sum((y - y.mean()) ** 2), rtol=1e-10)
    np.testing.assert_allclose(fit.acceleration(rows)[:, 2], x @ beta, rtol=1e-10)
    np.testing.assert_allclose(fit.parameters, np.concatenate([fit.drag, fit.intercept, [fit.thrust_gain]]))


def test_published_model_has_no_intercept_and_no_thrust():
    rows = linear_rows()
    fit = fit_linear_drag(rows, intercept=False, thrust=False, loss="squares")
    v, a = rows.matrix(["v_x", "v_y", "v_z"]), rows.matrix(["a_x", "a_y", "a_z"])
    np.testing.assert_allclose(fit.drag, -np.sum(v * a, axis=0) / np.sum(v * v, axis=0))
    assert not fit.intercept.any() and not fit.intercept_error.any() and fit.thrust_gain == 0


def test_huber_is_the_minimum_of_its_loss():
    """At the fit's own scale no other coefficients give a smaller Huber loss: scipy's minimiser agrees."""
    rows = linear_rows(noise=lambda v: 0.05 + 0.1 * np.abs(v))
    fit = fit_linear_drag(rows)
    x = np.column_stack([-rows.columns["v_x"], np.ones(600)])
    y = rows.columns["a_x"]
    limit = 1.345 * 1.4826 * np.median(np.abs(y - x @ [fit.drag[0], fit.intercept[0]]))

    def loss(beta):
        e = np.abs(y - x @ beta)
        return np.sum(np.where(e <= limit, e**2 / 2, limit * (e - limit / 2)))

    best = minimize(loss, [0.0, 0.0], method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-14, "maxiter": 4000})
    np.testing.assert_allclose([fit.drag[0], fit.intercept[0]], best.x, atol=1e-7)


TRUE = np.concatenate([DRAG, INTERCEPT, [GAIN]])


def coverage(seeds: int, **options) -> float:
    """Share of true coefficients inside the 95 % intervals over the seeds (7 coefficients each)."""
    fits = [fit_linear_drag(linear_rows(seed=seed, **options)) for seed in range(seeds)]
    return float(np.mean([np.abs(fit.parameters - TRUE) < fit.half_width for fit in fits]))


def test_intervals_over_flights_cover_where_rows_of_a_flight_err_alike():
    assert 0.93 < coverage(seeds=80, rows=300, flights=15, shared=0.5) < 0.98


@pytest.mark.parametrize(
    ("loss", "flights"), [pytest.param("huber", 12, marks=pytest.mark.slow), ("squares", 12), ("huber", 5)]
)
def test_intervals_cover_the_best_line_where_the_drag_is_not_linear(loss, flights):
    """Linear and quadratic drag, flights of very different speeds: the truth is what very many flights give."""
    many = synthetic_dataset(rows=800 * 150, flights=800, seed=10_000)
    truth = fit_linear_drag(many, loss=loss, intervals=False).parameters
    inside = []
    for seed in range(60):
        data = synthetic_dataset(rows=flights * 150, flights=flights, seed=seed)
        fit = fit_linear_drag(data, loss=loss)
        inside.append(np.abs(fit.parameters - truth) < fit.half_width)
    # 180 drag coefficients: one standard deviation of a share of 0.95 is 0.016, of all that a share below 0.9 is 3 away
    assert np.mean([held[:3] for held in inside]) > 0.9 and np.mean(inside) > 0.92


def test_is_the_jackknife_over_flights():
    """Every flight left out in turn, with the whole fit done anew."""
    rows = linear_rows(flights=8, noise=lambda v: 0.05 + 0.1 * np.abs(v))
    fit, flight = fit_linear_drag(rows), rows.columns["flight"]
    others = [fit_linear_drag(rows.rows(flight != g), intervals=False).parameters for g in range(8)]
    errors = np.sqrt(7 / 8 * np.sum((np.array(others) - fit.parameters) ** 2, axis=0))
    found = np.concatenate([fit.drag_error, fit.intercept_error, [fit.thrust_gain_error]])
    np.testing.assert_allclose(found, errors, rtol=1e-4)
    assert np.all((fit.freedom >= 1) & (fit.freedom <= 7))
    assert str(fit).endswith("(95 % interval over 8 flights)") and "+-" not in str(fit)


def test_one_flight_has_no_interval_and_says_so():
    fit = fit_linear_drag(linear_rows(flights=1))
    assert np.isnan(fit.half_width).all() and "[" not in str(fit)
    assert "no interval: one flight does not show how flights differ" in str(fit)


def test_what_one_flight_alone_tells_has_no_interval():
    """Two flights, of which one hovers: without the other no drag can be given."""
    rows = linear_rows(flights=2)
    still = {name: np.where(rows.columns["flight"] == 1, 0.0, rows.columns[name]) for name in ("v_x", "v_y", "v_z")}
    fit = fit_linear_drag(ResidualDataset(dict(rows.columns) | still, {}))
    assert np.isnan(fit.half_width).all() and "without one of its flights" in str(fit)


def test_few_or_idle_rows_are_refused():
    with pytest.raises(DataError, match="4 samples for 3 coefficients, at least 5"):
        fit_linear_drag(linear_rows(rows=4, flights=1))
    assert np.isfinite(fit_linear_drag(linear_rows(rows=5, flights=1)).parameters).all()
    idle = linear_rows()
    still = ResidualDataset(dict(idle.columns) | {"v_z": np.full(600, 1.0)}, {})
    with pytest.raises(DataError, match="a_z: v_z, intercept cannot be distinguished"):
        fit_linear_drag(still)


def test_far_from_the_origin_the_fit_keeps_its_digits():
    rows = linear_rows(noise=lambda v: 0.0)
    np.testing.assert_allclose(fit_linear_drag(rows).drag, DRAG, rtol=1e-11)
