"""A controller looks the same in every figure, and can be told from the others; logarithmic axes have plain numbers."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import combinations

import numpy as np
import pytest
from matplotlib.figure import Figure

from quadexp.report.page.source import read_comparison
from quadexp.report.style import KNOWN, LOOKS, MOST_VARIANTS, looks, plain_log, shaded
from tests.report.results import ERRORS, make_results, speed_figure
from tests.report.test_palette import VISIONS, contrast, lab, linear
from tests.report.test_tables import row

FLIERS = [name for name in KNOWN if "_" in name]
MODELS = [name for name in KNOWN if "_" not in name]


def test_a_controller_looks_the_same_in_any_company():
    together = looks(FLIERS)
    for name in FLIERS:
        for others in (["nominal_mpc"], FLIERS[::-1], ["own_mpc", "geometric"]):
            assert looks([*others, name])[name] == together[name]


@pytest.mark.parametrize("names", [FLIERS, MODELS])
@pytest.mark.parametrize("vision", VISIONS)
def test_no_two_can_be_mistaken(names, vision):
    seen = {name: lab(np.array(VISIONS[vision]) @ linear(KNOWN[name][0])) for name in names}
    for a, b in combinations(names, 2):
        assert KNOWN[a][1] != KNOWN[b][1], (a, b)
        assert np.linalg.norm(seen[a] - seen[b]) > 10, (a, b)  # 2 is a just noticeable difference
    assert all(contrast(KNOWN[name][0], "#ffffff") > 2 for name in names)  # large marks, beside a shape of their own


def test_variants_share_a_colour_and_the_plain_one_is_on_the_usual_plant():
    labels = ["nominal_mpc @ideal", "nominal_mpc @simplified", "gp_mpc a @simplified", "gp_mpc b @simplified"]
    worn = looks(labels)
    assert list(worn) == labels
    assert [worn[label].filled for label in labels] == [False, True, True, False]
    assert worn["nominal_mpc @ideal"].hue == worn["nominal_mpc @simplified"].hue == LOOKS["nominal_mpc"][0]
    assert worn["nominal_mpc @simplified"].colour == KNOWN["nominal_mpc"][0] == shaded("grey")
    assert worn["gp_mpc a @simplified"].colour != worn["gp_mpc b @simplified"].colour
    assert worn["gp_mpc a @simplified"].dash != worn["gp_mpc b @simplified"].dash


@pytest.mark.parametrize("count", [2, MOST_VARIANTS, MOST_VARIANTS + 1, 12, 30])
def test_no_two_variants_look_the_same(count):
    labels = ["nominal_mpc", "perfect_mpc", *(f"gp_mpc nodes={n}" for n in range(count))]
    worn = looks(labels)
    assert len({(look.colour, look.marker, look.filled) for look in worn.values()}) == len(labels)
    if count <= 5:
        assert len({look.colour for look in worn.values()}) == len(labels)


def test_strangers_wear_what_nobody_wears():
    worn = looks(["nominal_mpc", "gp_mpc", "one_mpc", "two_mpc"])
    assert len({look.colour for look in worn.values()}) == len({look.marker for look in worn.values()}) == 4


@pytest.mark.parametrize(
    "name", ["geometric", "pid", "dfbc", "neural_mpc", "gp_mpc+wind", "gp_mpc+wind+strapdown", "my_mpc", "my_mpc+l1"]
)
def test_a_name_without_a_colour_of_its_own_looks_the_same_in_any_usual_company(name):
    """Also in another process: a look depends on the name, not on its place nor on Python's hash."""
    usual = ["nominal_mpc", "linear_drag_mpc", "gp_mpc", "perfect_mpc"]
    alone = looks([name])[name]
    assert looks([*usual, name])[name] == looks([name, *usual[::-1]])[name] == alone
    code = f"from quadexp.report.style import looks; print(looks(['nominal_mpc', {name!r}])[{name!r}])"
    again = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env={**os.environ})
    assert again.stdout.strip() == str(alone), again.stderr


def test_remedies_are_told_apart_and_keep_the_hue_of_their_controller():
    names = ["none", "wind", "wind+strapdown", "l1", "indi", "delay", "l1+indi", "wind+delay", "belief"]
    labels = ["nominal_mpc", "gp_mpc", *(f"gp_mpc+{name}" for name in names[1:]), "nominal_mpc+wind", "pid", "dfbc"]
    worn = looks(labels)
    assert len({(look.colour, look.marker, look.filled) for look in worn.values()}) == len(labels)
    assert {worn[f"gp_mpc+{name}"].hue for name in names[1:]} == {"blue"} and worn["nominal_mpc+wind"].hue == "grey"
    assert worn["gp_mpc"].filled and not worn["gp_mpc+wind"].filled


def test_two_that_share_a_hue_stand_beside_each_other_in_two_shades():
    worn = looks(["static_feedback", "neural_mpc"])
    assert worn["static_feedback"].hue == worn["neural_mpc"].hue
    assert worn["static_feedback"].colour != worn["neural_mpc"].colour


@pytest.mark.parametrize("better", ["gp_mpc", "linear_drag_mpc"])
def test_on_the_page_rank_decides_no_colour_and_figures_have_the_same(tmp_path, monkeypatch, better):
    monkeypatch.setattr("tests.report.results.SEEDS", range(10))
    monkeypatch.setitem(ERRORS, better, 0.0004)  # the least error of all, of one or the other
    comparison = read_comparison(make_results(tmp_path / "results", lost=False))
    assert comparison.verdict.best and comparison.verdict.least == better
    assert {label: (look.hue, look.marker) for label, look in comparison.look.items()} == {
        label: LOOKS[label][:2] for label in comparison.look
    }
    panel = speed_figure(comparison.rows).axes[0]
    drawn = {one.get_label(): (one.lines[0].get_color(), one.lines[0].get_marker()) for one in panel.containers}
    assert drawn == {label: (look.colour, look.marker) for label, look in comparison.look.items()}


@pytest.mark.parametrize(
    "limits, ticks",
    [((0.05, 900), [0.1, 1, 10, 100]), ((3, 90), [5, 10, 20, 50]), ((4, 9), [4, 5, 6, 8]), ((5.3, 5.31), [4, 5, 6, 8])],
)
def test_logarithmic_axes_have_plain_numbers(limits, ticks):
    figure = Figure()
    panel = figure.subplots()
    panel.set_yscale("log")
    panel.set_ylim(*limits)
    plain_log(panel.yaxis)
    np.testing.assert_allclose(panel.yaxis.get_majorticklocs(), ticks)
    figure.draw_without_rendering()
    assert [text.get_text() for text in panel.yaxis.get_majorticklabels()] == [f"{tick:g}" for tick in ticks]


def test_speeds_that_are_close_are_not_printed_over_one_another():
    rows = [row("gp_mpc", speed=speed) for speed in (2.0, 5.0, 10.0, 11.9, 12.0, 15.0, 20.0)]
    panel = speed_figure(rows).axes[0]
    assert list(panel.get_xticks()) == [2, 5, 10, 11.9, 15, 20]
    assert len(panel.lines[0].get_xdata()) == 7
