"""Winds: gusts, Dryden's turbulence and recorded ones, as asked for; bad files in one line."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import expm, solve_continuous_lyapunov

from quadexp.errors import DataError
from quadexp.log.schema import Flight
from quadexp.log.store import write_flight
from quadexp.plugins.worlds import dryden
from quadexp.plugins.worlds.wind_record import COLUMNS, read_wind
from quadexp.world.gust import one_minus_cosine

AMPLITUDE = ca.DM([3.0, -2.0, 0.5])


@pytest.mark.parametrize(("start", "duration"), [(0.0, 2.0), (1.3, 0.4), (5.0, 11.0)])
def test_the_integral_is_half_the_amplitude_times_the_duration(start, duration):
    for axis in range(3):
        found, _ = quad(
            lambda t, axis=axis: float(one_minus_cosine(t, start, duration, AMPLITUDE)[axis]), 0, 20, limit=200,
            points=(start, start + duration),
        )  # fmt: skip
        assert found == pytest.approx(float(AMPLITUDE[axis]) * duration / 2, rel=1e-9)


def test_it_begins_and_ends_smoothly_and_peaks_in_the_middle():
    t = ca.SX.sym("t")
    gust = ca.Function("gust", [t], [one_minus_cosine(t, 1.0, 2.0, AMPLITUDE)])
    assert gust(2.0).full().ravel() == pytest.approx(AMPLITUDE.full().ravel(), rel=1e-14)
    assert gust(1.5).full().ravel() == pytest.approx(AMPLITUDE.full().ravel() / 2, rel=1e-12)
    for when in (-3.0, 0.999, 1.0, 3.0, 3.001, 50.0):
        assert np.abs(gust(when).full()).max() < 1e-12
    for edge in (1.0, 3.0):
        slope = (gust(edge + 1e-4) - gust(edge - 1e-4)) / 2e-4
        assert np.abs(slope.full()).max() < 1e-2


def filter_matrices(time_scale):
    """A and B B' of the three forming filters in one, from the transfer functions of MIL-F-8785C; output rows C.

    sqrt(2 T) / (1 + T p) and sqrt(T) (1 + sqrt(3) T p) / (1 + T p)^2, driven by white noise of density 1.
    """
    a, b, c = np.zeros((5, 5)), np.zeros((5, 3)), np.zeros((3, 5))
    a[0, 0], b[0, 0], c[0, 0] = -1 / time_scale[0], np.sqrt(2 / time_scale[0]), 1
    for axis, first in ((1, 1), (2, 3)):
        T, block = time_scale[axis], slice(first, first + 2)
        a[block, block] = np.array([[-1, 0], [1, -1]]) / T
        b[first, axis] = np.sqrt(2 / T)
        c[axis, block] = np.array([np.sqrt(3), 1 - np.sqrt(3)]) / np.sqrt(2)
    return a, b @ b.T, c


def advanced(filters, noise, time_scale, step):
    F, root = dryden.transition(time_scale, step)
    return F @ filters + root @ noise


@cache
def step_function():
    z, n, T, h = ca.SX.sym("z", 5), ca.SX.sym("n", 5), ca.SX.sym("T", 3), ca.SX.sym("h")
    out = advanced(z, n, T, h)
    return ca.Function("dryden", [z, n, T, h], [out, ca.jacobian(out, z), ca.jacobian(out, n)])


def spectra(w, time_scale, sigma):
    """Phi along, across and vertical, as printed in MIL-F-8785C, one-sided over w (rad/s)."""
    s = np.outer(time_scale, w)
    along = sigma[0] ** 2 * 2 * time_scale[0] / np.pi / (1 + s[0] ** 2)
    others = [sigma[i] ** 2 * time_scale[i] / np.pi * (1 + 3 * s[i] ** 2) / (1 + s[i] ** 2) ** 2 for i in (1, 2)]
    return np.stack([along, *others])


@pytest.mark.parametrize("step", [1e-5, 1e-3, 0.02, 0.0999, 0.1001, 0.7, 5.0])
def test_a_step_of_the_filters_is_exact(step):
    """Against the matrix exponential, and for the noise against what it has to make up for."""
    time_scale = np.array([1.0, 0.5, 2.0])
    a, drive, _ = filter_matrices(time_scale)
    P = solve_continuous_lyapunov(a, -drive)
    assert P[1:3, 1:3] == pytest.approx(np.array([[1, 0.5], [0.5, 0.5]]))
    _, F, root = (m.full() for m in step_function()(np.ones(5), np.ones(5), time_scale, step))
    assert np.abs(F - expm(a * step)).max() < 1e-14
    assert root @ root.T + F @ P @ F.T == pytest.approx(P, abs=1e-14)
    wanted = np.zeros((5, 5))  # of Q itself, which is far smaller than P for a short step
    for i, j in [(0, 0), (1, 1), (1, 2), (2, 1), (2, 2), (3, 3), (3, 4), (4, 3), (4, 4)]:
        wanted[i, j] = quad(lambda r, i=i, j=j: (expm(a * r) @ drive @ expm(a * r).T)[i, j], 0, step, epsabs=0)[0]
    assert root @ root.T == pytest.approx(wanted, rel=1e-9)


def test_the_first_states_are_drawn_from_the_stationary_distribution():
    root = np.array([dryden.stationary(row) for row in np.eye(5)]).T
    time_scale = np.array([1.0, 0.5, 2.0])
    a, drive, c = filter_matrices(time_scale)
    assert root @ root.T == pytest.approx(solve_continuous_lyapunov(a, -drive), abs=1e-14)
    z, sigma = ca.SX.sym("z", 5), np.array([1.5, 0.7, 0.3])
    out = ca.Function("c", [z], [ca.jacobian(dryden.turbulence(z, sigma), z)])(0).full()
    assert out == pytest.approx(sigma[:, None] * c)
    assert np.diag(out @ root @ root.T @ out.T) == pytest.approx(sigma**2, rel=1e-14)


SERIES, SAMPLES = 12, 50_000


@cache
def flown(step, time_scale):
    """States of the filters of independent flights, (SERIES, 5, SAMPLES)."""
    z, n = ca.SX.sym("z", 5), ca.SX.sym("n", 5)
    one = ca.Function("one", [z, n], [advanced(z, n, np.array(time_scale), step)])
    chain, rng = one.mapaccum(SAMPLES), np.random.default_rng(4)
    return np.array(
        [chain(dryden.stationary(rng.standard_normal(5)), rng.standard_normal((5, SAMPLES))) for _ in range(SERIES)]
    )


@pytest.mark.parametrize("step", [0.002, 0.01])
@pytest.mark.parametrize("sigma", [(0.5, 0.5, 0.3), (1.5, 1.0, 2.0), (4.0, 3.0, 0.1)])
def test_spectrum_and_intensity_are_those_asked_for(step, sigma):
    """Periodograms of many samples, mean over bands on both sides of the corner, within 3 % of the standard's.

    The spectrum of samples is that of the continuous process with all multiples of the sampling rate folded in.
    """
    time_scale = (0.02, 0.01, 0.015)
    states = flown(step, time_scale)
    first, second = dryden.TRANSVERSE
    pairs = [first * states[:, i] + second * states[:, i + 1] for i in (1, 3)]
    values = np.array(sigma)[:, None] * np.stack([states[:, 0], *pairs], axis=1)
    assert np.sqrt((values**2).mean(axis=(0, 2))) == pytest.approx(np.array(sigma), rel=0.03)
    f = np.fft.rfftfreq(SAMPLES, step)[1:-1]
    found = (np.abs(np.fft.rfft(values)[..., 1:-1]) ** 2).mean(axis=0) * 2 * step / SAMPLES
    edges = np.geomspace(0.008, 0.5, 7) / step
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        band = (f >= low) & (f < high)
        folded = sum(spectra(2 * np.pi * np.abs(f[band] + k / step), time_scale, sigma) for k in range(-60, 61))
        wanted = 2 * np.pi * folded.mean(axis=1)
        assert found[:, band].mean(axis=1) == pytest.approx(wanted, rel=0.03), (low, high)


def test_intensity_holds_while_the_airspeed_changes():
    """The covariance of the states stays the stationary one over steps of any time scales."""
    P = np.array([dryden.stationary(row) for row in np.eye(5)]).T
    P = P @ P.T
    held = P.copy()
    for k, step in enumerate([1e-3, 1e-3, 0.01, 0.5, 1e-4] * 20):
        T = np.array([2.0, 1.0, 0.2]) * (1 + 0.9 * np.sin(k))
        _, F, root = (m.full() for m in step_function()(np.zeros(5), np.zeros(5), T, step))
        held = F @ held @ F.T + root @ root.T
    assert held == pytest.approx(P, abs=1e-12)


def test_scale_lengths_and_intensities_of_the_standard():
    """MIL-F-8785C, figures 10 and 11: isotropic at 1000 ft with L = 1000 ft; at 20 ft by its formulas in feet."""
    assert dryden.scale_lengths(304.8) == pytest.approx([304.8] * 3)
    assert dryden.intensities(304.8, 10.0) == pytest.approx([1.0, 1.0, 1.0])
    base = 0.177 + 0.000823 * 20
    assert dryden.scale_lengths(6.096) / 0.3048 == pytest.approx([20 / base**1.2, 20 / base**1.2, 20])
    assert dryden.intensities(6.096, 10.0) == pytest.approx([base**-0.4, base**-0.4, 1.0])


def test_axes_follow_the_mean_wind():
    assert dryden.axes(np.array([0.0, 0.0, 3.0])) == pytest.approx(np.eye(3))
    turned = dryden.axes(np.array([-3.0, 4.0, 7.0]))
    assert turned[:, 0] == pytest.approx([-0.6, 0.8, 0])
    assert turned.T @ turned == pytest.approx(np.eye(3)) and np.linalg.det(turned) == pytest.approx(1)


def evaluated(record, times):
    t = ca.MX.sym("t")
    function = ca.Function("wind", [t], [record.at(t)])
    return np.array([function(when).full().ravel() for when in times])


@pytest.fixture
def rows(rng):
    t = np.cumsum(rng.uniform(0.02, 0.5, 40)) + 1.0
    return np.column_stack([t, rng.normal(size=(40, 3))])


def test_rows_are_joined_by_lines_and_held_outside(tmp_path, rows):
    file = tmp_path / "wind.csv"
    np.savetxt(file, rows, delimiter=",", header="t, wind_x, wind_y, wind_z", comments="", fmt="%.17g")
    times = np.linspace(0, rows[-1, 0] + 2, 301)
    wanted = np.stack([np.interp(times, rows[:, 0], rows[:, i]) for i in (1, 2, 3)], axis=1)
    assert evaluated(read_wind(file), times) == pytest.approx(wanted, abs=1e-12)


def test_a_flight_with_its_wind_is_a_wind_file_too(tmp_path, rows):
    """Other columns are ignored; w_x of a flight is an angular velocity and not taken for wind."""
    columns = dict(zip(COLUMNS, rows.T.copy(), strict=True)) | {"w_x": rows[:, 1] * 0 + 99}
    file = write_flight(tmp_path / "flight.parquet", Flight(columns, {}))
    assert read_wind(file).wind == pytest.approx(rows[:, 1:])


def test_one_row_is_a_constant_wind(tmp_path):
    (tmp_path / "wind.csv").write_text("# calm\nt,wind_z,wind_x,wind_y\n0,3,1,2\n")
    assert evaluated(read_wind(tmp_path / "wind.csv"), [-1.0, 0.0, 9.0]) == pytest.approx(np.array([[1, 2, 3]] * 3))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("t,w_x,w_y,w_z\n0,1,2,3\n", "no column wind_x, wind_y, wind_z"),
        ("t,wind_x,wind_y,wind_z\n", "0 rows"),
        ("t,wind_x,wind_y,wind_z\n0,1,2,3\n0,1,2,3\n", "t = 0 s in row 1 is not after 0 s"),
        ("t,wind_x,wind_y,wind_z\n0,1,2,3\n1,1,nan,3\n", "column 'wind_y' holds nan in row 1"),
        ("t,wind_x,wind_y,wind_z\n0,1,2,north\n", "not a readable CSV file with numbers"),
        ("", "not a readable CSV file"),
    ],
)
def test_a_bad_file_is_refused_in_one_line(tmp_path, text, said):
    (tmp_path / "wind.csv").write_text(text)
    with pytest.raises(DataError, match="wind.csv") as caught:
        read_wind(tmp_path / "wind.csv")
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_what_is_no_parquet_file_is_refused(tmp_path):
    (tmp_path / "wind.parquet").write_bytes(b"PAR1 nothing")
    with pytest.raises(DataError, match="wind.parquet: not a readable Parquet file"):
        read_wind(tmp_path / "wind.parquet")
