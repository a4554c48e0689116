"""The page's figures over what was swept: chosen as those of the sweep, every panel shown or said, bounded work."""

from __future__ import annotations

import re

import pytest

from quadexp.log.store import read_metadata
from quadexp.report.frame import SweepFrame
from quadexp.report.page import make_report
from quadexp.report.page.source import read_comparison
from quadexp.report.page.swept import swept_figures
from quadexp.report.view import automatic
from tests.report.results import make_results, many_results
from tests.report.sweeps import noise, swept

TWO = ["controller=nominal_mpc,perfect_mpc", "controller.nodes=5,10,20", "truth.mass=1,1.1,1.2", "seed=0,1"]


def error(config):
    lost = (config.controller.name, config.controller.nodes, config.seed) == ("nominal_mpc", 5, 1)
    return None if lost else 0.2 / config.controller.nodes * config.truth.mass * (1 + 0.1 * noise(config.seed))


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    folder = tmp_path_factory.mktemp("swept")
    root = swept(folder / "two", TWO, error)
    made = make_report(root, folder / "two.html", figures=folder / "paper")
    return root, made, made["path"].read_text(encoding="utf-8")


def section(text):
    found = re.search(r'<section id="swept".*?</section>', text, re.DOTALL)
    return found[0] if found else ""


def test_two_keys_are_lines_in_panels_and_a_map_for_every_quantity(two):
    root, made, text = two
    views = automatic(SweepFrame.read(root))
    assert [view.kind for view in views] == ["lines", "heat"] and made["left_out"] == []
    tabs = re.findall(r'data-metric="(\w+)">(.*?)(?=<div data-metric|</section>)', section(text), re.DOTALL)
    assert [name for name, _ in tabs] == ["mean_error", "rmse", "max_error", "success"]
    for _, body in tabs:
        assert body.count("<figure") == body.count("<svg") == 2
        for title in ("mass 1<", "mass 1.1<", "mass 1.2<", "nominal_mpc", "perfect_mpc", "controller.nodes"):
            assert title in body, "every panel is shown"
    assert "1/2" in tabs[0][1] and "were not completed" in tabs[0][1]
    assert 'id="speed"' not in text, "one speed is no axis"
    names = {name for name in made["figures"] if "against" in name or "map" in name}
    assert names == {"mean_error_against_nodes", "mean_error_map_of_nodes_and_mass", "error_against_time"}


def test_lines_are_in_the_colours_of_the_theme_and_maps_on_white(two):
    lines, maps = re.findall(r"<figure.*?</figure>", section(two[2]), re.DOTALL)[:2]
    assert "var(--series-grey-0)" in lines and "var(--ink)" in lines and 'class="plate"' not in lines
    assert not re.search(r"#(?:000000|5f6773)", lines), "no colour of paper is left"
    assert maps.startswith('<figure class="plate"') and "var(--" not in maps


def test_the_speed_is_a_key_like_the_others(tmp_path):
    root = make_results(tmp_path / "speeds", controllers=("nominal_mpc", "perfect_mpc"), lost=False)
    made = swept_figures(read_comparison(root))
    assert [view.x.key for view in made.views] == ["trajectory.speed"] and len(made.tabs) == 4


@pytest.mark.parametrize(
    ("asked", "kind", "x"),
    [
        (["controller=nominal_mpc,perfect_mpc", "seed=0,1"], "lines", "controller"),
        (["world=clean,outdoor_breeze", "controller=nominal_mpc,perfect_mpc"], "lines", "world"),
        (["controller.nodes=5,10", "vehicle.mass=1,2", "plant.lift=0,0.1"], "parallel", ""),
    ],
)
def test_it_is_what_quadexp_plot_draws_without_keys(tmp_path, asked, kind, x):
    root = swept(tmp_path / "r", asked, lambda config: 0.01 * (1 + noise(config.seed, repr(config))))
    made = swept_figures(read_comparison(root))
    assert made.tabs and made.left == [] and made.views[0].kind == kind and x in ("", made.views[0].x.key)


def test_what_has_too_many_marks_is_a_picture_and_what_has_no_room_is_said(two, monkeypatch):
    comparison = read_comparison(two[0])
    monkeypatch.setattr("quadexp.report.page.swept.TABLED", ())  # the mean error and success
    monkeypatch.setattr("quadexp.report.page.sheet.LARGEST_DRAWING", 1000)
    made = swept_figures(comparison)
    assert all("data:image/png" in figure and "<svg" not in figure for _, _, own in made.tabs for figure in own)
    monkeypatch.setattr("quadexp.report.page.swept.BUDGET", len(made.tabs[0][2][0]) + 10)
    less = swept_figures(comparison)
    assert [len(own) for _, _, own in less.tabs] == [1] and len(less.left) == 2
    assert less.left[0] == "mean error (mm) map of nodes and mass, which `quadexp plot` draws"


def test_five_thousand_flights_are_sampled_where_a_picture_shows_no_more_and_tables_are_complete(tmp_path, monkeypatch):
    """The work is bounded: so many files are read, whatever the number of flights."""
    root, read = many_results(tmp_path / "many", 1, seeds=1275), []

    def counted(reader):
        return lambda path, *words, **options: read.append(path) or reader(path, *words, **options)

    for place in ("frame.read_metadata", "page.source.read_record", "page.source.read_flight"):
        room, _, name = place.rpartition(".")
        module = __import__(f"quadexp.report.{room}", fromlist=[name])
        monkeypatch.setattr(module, name, counted(getattr(module, name)))
    made = make_report(root, tmp_path / "page.html")
    text = made["path"].read_text(encoding="utf-8")
    assert len(read) < 1000 and made["bytes"] < 2_000_000
    assert text.count("1275 of 1275") >= 4 and "5100 flights" in text, "every flight is in the tables"
    said = "settings of flights beyond 464 of 5100, evenly chosen"
    assert said in made["left_out"] and text.count(said) == 2
    assert read_metadata(root / "results.parquet")["kind"] == "results"
