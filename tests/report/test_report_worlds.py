"""Flights in a world on the page: wind, estimate, battery and rotors; and a page without worlds, which has none."""

from __future__ import annotations

import base64
import json
import re
import shutil

import numpy as np
import pytest

from quadexp.log.cell_store import CellStore
from quadexp.log.schema import Flight
from quadexp.log.store import read_table, write_flight, write_table
from quadexp.report.metrics import from_columns, to_columns
from quadexp.report.page import make_report
from quadexp.report.page.over_time import binned, power_sheets
from quadexp.report.page.replay import choose_cases, ordered_cases, pack_replay
from quadexp.report.page.sections import worlds
from quadexp.report.page.source import read_comparison
from quadexp.report.summary import summarise
from quadexp.report.text import number
from tests.log.flights import straight_flight
from tests.report.results import make_results, weather
from tests.report.test_html import Page

WHO = ("nominal_mpc", "perfect_mpc")
NAMES = {"wind": [f"wind_{i}" for i in "xyz"], "estimate": [f"est_p_{i}" for i in "xyz"]}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return make_results(
        tmp_path_factory.mktemp("worlds") / "results", controllers=WHO, lost=False, world="race", beside=weather
    )


@pytest.fixture(scope="module")
def text(results):
    return text_of(results)


def text_of(root):
    return make_report(root, root / "report.html")["path"].read_text(encoding="utf-8")


def unpacked(track, name):
    return np.frombuffer(base64.b64decode(track[name]), "<i2").reshape(-1, 3) * track[f"{name}_step"]


def test_the_packed_flights_are_the_columns(results):
    comparison = read_comparison(results)
    cases = choose_cases(comparison, [])
    packed, kept = pack_replay(comparison, cases)
    assert kept == cases and len({condition for condition, _ in cases}) == 4 and len(cases) == 24  # every seed of each
    for case, (condition, seed) in zip(packed, kept, strict=True):
        for track in case["tracks"]:
            row = next(
                r
                for r in comparison.rows
                if (r["controller"], r["trajectory"], r["speed"], r["seed"])
                == (track["label"], condition[2], condition[3], seed)
            )
            flight = comparison.flight(row)
            assert case["samples"] == len(flight) and case["step"] == pytest.approx(0.02)
            np.testing.assert_allclose(unpacked(track, "wind"), flight.stack(NAMES["wind"]), atol=1e-4)
            reference = flight.stack(["ref_p_x", "ref_p_y", "ref_p_z"])
            told = unpacked(track, "estimate") + reference
            np.testing.assert_allclose(told, flight.stack(NAMES["estimate"]), atol=1e-4)


def test_what_they_take_counts_for_the_size(results):
    comparison = read_comparison(results)
    cases = choose_cases(comparison, [])
    packed, _ = pack_replay(comparison, cases)
    texts = [
        len(value)
        for case in packed
        for part in (case, *case["tracks"])
        for name, value in part.items()
        if f"{name}_step" in part or name in ("attitude", "thrust")
    ]
    assert len(pack_replay(comparison, cases, sum(texts))[1]) == len(cases)
    assert len(pack_replay(comparison, cases, sum(texts) - 1)[1]) == len(cases) - 1


def test_an_estimate_that_is_the_truth_and_still_air_are_not_packed(tmp_path):
    def nothing(flight):
        return {f"wind_{i}": np.zeros_like(flight.t) for i in "xyz"} | {f"est_p_{i}": flight[f"p_{i}"] for i in "xyz"}

    root = make_results(tmp_path / "results", controllers=WHO, lost=False, world="wind=constant", beside=nothing)
    comparison = read_comparison(root)
    packed, _ = pack_replay(comparison, choose_cases(comparison, []))
    assert not any(name in track for case in packed for track in case["tracks"] for name in NAMES)
    assert 'id="power"' not in text_of(root)


def test_battery_and_rotors_have_one_panel_each(text):
    section = re.search(r'<section id="power".*?</section>', text, re.DOTALL)[0]
    panels = re.findall(r'aria-label="(Battery voltage|Rotor speed), circle at 8 m/s, seed 0"', section)
    assert panels == ["Battery voltage", "Rotor speed"]
    assert re.search(r"Charge left at the end: perfect_mpc 70.0\W%, nominal_mpc 70.0\W%", section)
    assert "Arrow: the wind" in text and "Ring and dotted line" in text
    page = Page(text)
    assert page.open == [] and len(page.ids) == len(set(page.ids))


def test_the_flights_of_the_panels_are_those_of_the_first_case(results):
    comparison = read_comparison(results)
    (one,) = power_sheets(comparison)
    assert one.title == "circle at 8 m/s, seed 0"
    assert ordered_cases(comparison)[0][0][2:4] == ("circle", 8.0)
    assert set(one.labels) == set(WHO)


def test_bins_hold_every_sample():
    t, values = np.arange(1001) * 0.02, np.random.default_rng(0).normal(size=(1001, 4))
    at, low, mean, high = binned(t, values, 7)
    assert low.min() == values.min() and high.max() == values.max() and (low < mean).all() and (mean < high).all()
    sizes = [143] * 7
    assert np.average(mean, weights=sizes) == pytest.approx(values.mean()) and at[0] == pytest.approx(t[:143].mean())


def test_a_page_of_clean_flights_has_none_of_it(text, tmp_path):
    page = text_of(make_results(tmp_path / "results", controllers=WHO, lost=False))
    assert "Arrow: the wind" not in page and "Ring and dotted line" not in page
    cases = json.loads(re.search(r'id="replay-data">(.*?)</script>', page, re.DOTALL)[1])
    assert not any(
        name.startswith(("wind", "estimate")) for case in cases for track in case["tracks"] for name in track
    )
    sections = [re.findall(r'<section id="(\w+)"', one) for one in (page, text)]
    assert "power" in sections[1] and sections[0] == [name for name in sections[1] if name != "power"]


def test_worlds_stand_beside_each_other_success_first(tmp_path):
    """Two worlds of the same flights, one with wind and a wrong estimate: the numbers are those of each by itself."""

    def off(flight):
        wind = {f"wind_{i}": np.full(len(flight), 4.0 * (i == "x")) for i in "xyz"}
        return wind | {f"est_p_{i}": flight[f"p_{i}"] + 0.03 * (i == "z") for i in "xyz"}

    roots = [
        make_results(tmp_path / "clean", controllers=WHO, lost=False),
        make_results(tmp_path / "race", controllers=WHO, lost=False, world="race", beside=off),
    ]
    tables = [read_table(root / "results.parquet", "results") for root in roots]
    rows = [from_columns(columns) for columns, _ in tables]
    for one in rows[1]:  # the flights of both lie in one folder
        old = CellStore(roots[1]).path(one["key"])
        one["key"] = f"{'f' * 8}{one['key'][8:]}"
        new = CellStore(roots[0]).path(one["key"])
        new.parent.mkdir(exist_ok=True, parents=True)
        shutil.copy(old, new)
    rows[1][0]["outcome"] = "lost"
    write_table(roots[0] / "results.parquet", to_columns(rows[0] + rows[1]), tables[0][1] | {"grids": []}, "results")
    shutil.rmtree(roots[1])
    comparison = read_comparison(roots[0])
    (table,) = worlds(comparison).blocks[0].tables
    clean, race = table.lines
    assert (clean[0].text, race[0].text) == ("simplified, torrente", "simplified/race, torrente")
    assert (clean[1].small, race[1].small) == ([], ["wind 4.0 m/s, most 4.0 m/s", "told 30.0 mm off (rms)"])
    lost = rows[1][0]["controller"]
    for head, first, second in zip(table.heads[2:], clean[2:], race[2:], strict=True):
        assert first.text == number(1e3 * comparison.geometric_mean(head.text))
        assert second.lost == ("23 of 24 completed" if head.text == lost else "")
        assert second.small == (() if head.text == lost else ("24 of 24 completed",))
    page = text_of(roots[0])
    assert len(Page(page).tables["worlds"]) == 3 and Page(page).open == []


def test_figures_for_paper(results, tmp_path):
    made = make_report(results, tmp_path / "report.html", figures=tmp_path / "figures")
    assert "power_circle_at_8_m_s__seed_0" in made["figures"]


@pytest.mark.parametrize(
    ("world", "config", "line"),
    [
        ("clean", {"sensor": {"name": "perfect"}}, "world       clean"),
        ("wind=dryden", {"wind": {"name": "dryden"}, "sensor": {"name": "perfect"}}, "world       wind=dryden"),
        (
            "race",
            {"link": {"name": "onboard"}, "estimator": {"name": "late_noisy"}, "sensor": {"name": "perfect"}},
            "world       race: link=onboard, estimator=late_noisy",
        ),
        (None, {}, None),
    ],
)
def test_show_names_the_world_and_its_parts(tmp_path, world, config, line):
    flight = straight_flight(5)
    row = dict.fromkeys(("mean_error", "rmse", "max_error", "attitude_rmse", "duration", "peak_speed"), 0.0)
    row |= {f"solve_time_{name}": 0.0 for name in ("median", "p99", "max")} | {"saturated_share": 0.0, "seed": 0}
    row |= {"controller": "c", "trajectory": "circle", "speed": 8.0, "plant": "p", "outcome": "ok", "backend": "b"}
    metadata = {"row": row | {"model": ""}, "config": config} | ({"world": world} if world else {})
    made = summarise(write_flight(tmp_path / "a.parquet", Flight(flight.columns, metadata)))
    found = [one for one in made["lines"] if one.startswith("world ")]
    assert found == ([line] if line else [])
    assert made["world"]["name"] == world
