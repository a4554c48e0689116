"""The ladder of worlds: means by world and controller, drawn where every flight completed."""

import pytest

from quadexp.plugins import papers
from quadexp.plugins.papers import ladder
from quadexp.plugins.papers.ladder import means_by_place, means_figure, overview
from quadexp.report.metrics import METRICS

ERRORS = {"clean": (0.2, 0.001), "only_late_estimate": (0.21, 0.04), "wind=constant": (0.4, 0.28)}  # m
CONTROLLERS = ("nominal_mpc", "perfect_mpc")


@pytest.fixture
def rows():
    """Flights of two controllers in three worlds, three seeds each, with known errors."""
    return [
        result(f"simplified/{world}" if world != "clean" else "simplified", controller, seed, error * (1 + 0.1 * seed))
        for world, errors in ERRORS.items()
        for controller, error in zip(CONTROLLERS, errors, strict=True)
        for seed in range(3)
    ]


def result(plant, controller, seed, error):
    named = {"plant": plant, "vehicle": "torrente", "trajectory": "circle", "controller": controller, "model": ""}
    metrics = dict.fromkeys(METRICS, 0.0) | {"mean_error": error, "rmse": error, "max_error": error}
    return {**named, "speed": 8.0, "variant": "", "seed": seed, "outcome": "ok", "cause": "", **metrics}


def test_means_over_seeds_by_world_and_controller(rows):
    assert [place for place, _, _ in means_by_place(rows, "world").places] == list(ERRORS)
    for line, (world, errors) in zip(overview(rows).rows, ERRORS.items(), strict=True):
        means = [f"{1e3 * error * 1.1:.3g}" for error in errors]
        assert list(line) == [world, "circle", "8", *means]


def test_a_flight_that_is_lost_has_no_marker_and_is_named(rows):
    hurt = [dict(row) for row in rows]
    victim = next(row for row in hurt if row["controller"] == "perfect_mpc" and row["plant"].endswith("late_estimate"))
    victim["outcome"] = "lost"
    (line,) = (line for line in overview(hurt).rows if line[0] == "only_late_estimate")
    assert line[-1] == "1 of 3 lost"
    panel = means_figure(means_by_place(hurt, "world")).axes[0]
    drawn = {one.get_label(): len(one.lines[0].get_xdata()) for one in panel.containers}
    assert drawn == {"nominal_mpc": 3, "perfect_mpc": 2} and [text.get_text() for text in panel.texts] == ["2/3"]


def test_files(rows, tmp_path):
    files = papers.write(ladder, rows, tmp_path)
    assert (tmp_path / "ladder.md").read_text().count("\n| ") >= 4 and files["figure_ladder"].endswith("ladder.svg")
    assert (tmp_path / "figures" / "ladder.png").stat().st_size > 5_000
