"""A controller looks the same in every figure, and can be told from the others; logarithmic axes have plain numbers."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from matplotlib.figure import Figure

from quadexp.report.figures import error_against_speed
from quadexp.report.page.palette import MARKERS
from quadexp.report.page.palette import looks as page_looks
from quadexp.report.style import KNOWN, MOST_VARIANTS, looks, plain_log
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
    assert worn["nominal_mpc @ideal"].colour == worn["nominal_mpc @simplified"].colour == KNOWN["nominal_mpc"][0]
    assert worn["gp_mpc a @simplified"].dash != worn["gp_mpc b @simplified"].dash


def test_many_variants_have_colours_of_their_own():
    labels = [f"gp_mpc nodes={n}" for n in range(MOST_VARIANTS + 1)]
    assert len({look.colour for look in looks(labels).values()}) == len(labels)


def test_strangers_wear_what_nobody_wears():
    worn = looks(["nominal_mpc", "gp_mpc", "one_mpc", "two_mpc"])
    assert len({look.colour for look in worn.values()}) == len({look.marker for look in worn.values()}) == 4


def test_the_page_uses_the_same_markers():
    worn = page_looks(["perfect_mpc", "gp_mpc", "own_mpc", "nominal_mpc", "gp_mpc b"], "nominal_mpc", "gp_mpc", [])
    for name in ("perfect_mpc", "gp_mpc", "nominal_mpc"):
        assert MARKERS[worn[name].shape] == KNOWN[name][1]
    assert len({look.shape for look in worn.values()}) == 5


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
    panel = error_against_speed(rows).axes[0]
    assert list(panel.get_xticks()) == [2, 5, 10, 11.9, 15, 20]
    assert len(panel.lines[0].get_xdata()) == 7
