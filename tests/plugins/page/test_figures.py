"""Figures are made, hold what they should, and are the same every time."""

import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.log.schema import Flight
from quadexp.plugins.check.figures import consistency_figure
from quadexp.plugins.drawing.style import save
from quadexp.plugins.identification.figures import Profile, delay_figure
from quadexp.plugins.page.flight_figures import flights_figure, tracked_paths
from tests.log.flights import straight_flight
from tests.report.results import speed_figure
from tests.report.test_tables import row


@pytest.fixture
def rows():
    errors = {"nominal_mpc": 0.2, "gp_mpc": 0.004}
    return [
        row(controller, speed=speed, seed=seed, trajectory=trajectory, error=error * speed * (1 + 0.1 * seed))
        for controller, error in errors.items()
        for trajectory in ("circle", "lemniscate")
        for speed in (4.0, 8.0)
        for seed in range(3)
    ]


def test_a_checkpoint_is_named_only_where_a_controller_has_several(rows):
    def labels(named):
        figure = speed_figure([made | {"model": named(made)} for made in rows])
        return [one.get_label() for one in figure.axes[0].containers]

    assert labels(lambda made: "models/gp" * (made["controller"] == "gp_mpc")) == ["nominal_mpc", "gp_mpc"]
    assert labels(lambda made: f"models/{made['controller'][:2]}") == ["nominal_mpc", "gp_mpc"]
    rows = [*({**made, "model": "models/a"} for made in rows), *({**made, "model": "models/b"} for made in rows[12:])]
    assert labels(lambda made: made["model"]) == ["nominal_mpc", "gp_mpc a", "gp_mpc b"]


def test_the_bar_is_the_interval_of_the_mean_and_says_so(rows):
    figure = speed_figure(rows, confidence=0.9)
    (bars,) = figure.axes[0].containers[0].lines[2]
    # 200 mm times speed, and 0, 10 and 20 % more: mean 1.1, standard deviation 0.1; t of 2 degrees at 95 % is 2.92.
    half = 2.92 * 0.1 / np.sqrt(3)
    np.testing.assert_allclose(bars.get_segments()[1][:, 1], [1600 * (1.1 - half), 1600 * (1.1 + half)], rtol=1e-3)
    assert figure.get_suptitle() == "mean over 3 seeds; bars: its 90 % interval (Student's t)"
    figure = speed_figure([made for made in rows if made["seed"] == 0])
    assert figure.get_suptitle() == "one flight each"
    assert not any(container.lines[2] for panel in figure.axes for container in panel.containers)


def test_a_wide_interval_does_not_squash_the_means(rows):
    rows = [made | {"mean_error": 0.001 if made["seed"] == 0 else 0.2} for made in rows if made["speed"] == 4]
    rows += [made | {"speed": 8.0, "mean_error": 10 * made["mean_error"]} for made in rows]
    low, _ = speed_figure(rows).axes[0].get_ylim()  # the lower limits are zero
    assert 10 < low < 200 * 2 / 3


def test_what_was_not_flown_is_not_drawn(rows):
    lost = [made | {"outcome": "lost"} for made in rows]
    with pytest.raises(UsageError, match="none of the 24 flights was completed"):
        speed_figure(lost)


def test_paths_have_a_row_a_controller_and_a_column_a_condition():
    """One colour scale; the place of a flight that was not completed says so; a single condition is in the title."""
    far, near, perfect = (straight_flight(20, (0.0, offset, 0.0)) for offset in (0.2, 0.01, 0.0))
    flights = {("a", "4 m/s"): far, ("a", "8 m/s"): far, ("b", "4 m/s"): near}
    figure = tracked_paths(flights, "circle", {("b", "8 m/s"): "lost"}, ["6 m/s"])
    panels = figure.axes[:4]
    drawn = [panel.collections[0] for panel in panels[:3]]
    assert drawn[0].norm is drawn[1].norm is drawn[2].norm
    np.testing.assert_allclose(drawn[0].get_array(), 200.0)
    titles = ["4 m/s\nmean 200 mm", "8 m/s\nmean 200 mm", "mean 10 mm", ""]
    assert [panel.get_title() for panel in panels] == titles
    assert [panel.get_ylabel() for panel in panels] == ["a\ny (m)", "", "b\ny (m)", ""]
    assert [text.get_text() for text in panels[3].texts] == ["lost"]
    assert figure.get_suptitle() == "circle\nnot drawn: 6 m/s"
    single = tracked_paths({("a", "4 m/s"): perfect, ("b", "4 m/s"): perfect}, "circle")
    assert [panel.get_title() for panel in single.axes[:2]] == ["a\nmean 0 mm", "b\nmean 0 mm"]
    assert single.get_suptitle() == "circle, 4 m/s"


def test_a_long_flight_is_a_small_file(tmp_path):
    """Its lines are pixels, its letters are not: 70 kB; as lines of SVG an hour was 29 MB."""
    flight = straight_flight(60_000)
    noise = 1e-3 * np.random.default_rng(0).standard_normal((2, len(flight)))
    for kind, off in (("", noise), ("ref_", 0 * noise)):
        circle = {f"{kind}p_x": np.cos(flight.t) + off[0], f"{kind}p_y": np.sin(flight.t) + off[1]}
        flight.columns.update(circle)
    path = save(tracked_paths({("an hour", ""): flight}), tmp_path / "hour")
    assert path.stat().st_size < 200_000 and path.read_bytes().count(b"<image") >= 2  # one is the scale


def test_flights_are_drawn_over_the_reference_with_their_errors_and_a_log_with_its_speed():
    near, far = (straight_flight(40, (0.0, offset, 0.0)) for offset in (0.01, 0.2))
    above, error = flights_figure({"near": near, "far": far}).axes
    assert [line.get_label() for line in above.lines] == ["reference", "near", "far"]
    assert [line.get_label() for line in error.lines] == ["near: mean 10 mm", "far: mean 200 mm"]
    np.testing.assert_allclose([line.get_ydata()[-1] for line in error.lines], [10, 200])
    log = Flight({name: v for name, v in near.columns.items() if not name.startswith(("ref_", "u_"))}, {})
    above, speed = flights_figure({"log": log}).axes
    np.testing.assert_allclose(speed.lines[0].get_ydata(), np.hypot.reduce(log.stack(["v_x", "v_y", "v_z"]), axis=1))
    assert len(above.lines) == 1 and len(flights_figure({"one": near}).axes) == 3  # and its rotor thrusts
    with pytest.raises(UsageError, match="empty: holds no samples"):
        flights_figure({"empty": Flight({name: v[:0] for name, v in near.columns.items()}, near.metadata)})


def test_a_log_is_drawn_against_what_its_sensors_say_of_each_other():
    figure = consistency_figure("a log", straight_flight(400), [])
    assert len(figure.axes) == 9 and figure.get_suptitle().endswith("no finding that blocks or warns")
    velocity = {line.get_label(): line.get_ydata() for line in figure.axes[0].lines}
    np.testing.assert_allclose(velocity["v"], velocity["dp/dt"], atol=1e-6)


def test_the_chosen_delay_is_drawn():
    candidates = np.linspace(0.0, 0.04, 81)
    profile = Profile("age of the state", candidates, -(((candidates - 0.012) / 0.002) ** 2) / 2, 0.012, 0.002)
    (curve,) = delay_figure([profile]).axes
    score, best = curve.lines
    assert score.get_xdata()[np.argmax(score.get_ydata())] == pytest.approx(12.0) == best.get_xdata()[0]
