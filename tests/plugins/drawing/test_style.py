"""A controller looks the same in every figure, and can be given from the others, with and without colour vision;
logarithmic axes have plain numbers."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from quadexp.parts.options import OptionFiles
from quadexp.plugins.drawing.style import CYCLE, GLYPHS, HUES, LOOKS, MODELS, SHADES, looks, plain_log, shaded
from quadexp.plugins.page.report.source import read_comparison
from tests.report.results import ERRORS, make_results, speed_figure
from tests.report.test_tables import row

FLIERS = ["nominal_mpc", "linear_drag_mpc", "gp_mpc", "perfect_mpc", "rls_mpc", "static_feedback", "rls_feedback"]
# Linear sRGB as seen without one kind of cone: Machado, Oliveira, Fernandes 2009 (IEEE TVCG 15(6)), severity 1.
VISIONS = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}


def linear(colour):
    """Linear sRGB of "#rrggbb" (IEC 61966-2-1)."""
    values = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def contrast(a, b):
    """WCAG 2.2 contrast ratio."""
    low, high = sorted(float(linear(c) @ [0.2126, 0.7152, 0.0722]) for c in (a, b))
    return (high + 0.05) / (low + 0.05)


def lab(rgb):
    """CIE L*a*b* of linear sRGB, D65."""
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ np.clip(rgb, 0, 1)
    f = np.array([np.cbrt(v) if v > 0.008856 else 7.787 * v + 16 / 116 for v in xyz / [0.9505, 1.0, 1.089]])
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def least_difference(colours, vision):
    """The smallest distance in L*a*b* between two of them; 2 is a just noticeable difference."""
    seen = [lab(np.array(VISIONS[vision]) @ linear(colour)) for colour in colours]
    return min(np.linalg.norm(a - b) for a, b in combinations(seen, 2))


@pytest.mark.parametrize("vision", VISIONS)
def test_hues_and_shades_of_variants_can_be_told_apart(vision):
    assert least_difference(HUES.values(), vision) > 10
    for hue in HUES:
        assert least_difference([shaded(hue, shade) for shade in range(SHADES)], vision) > 6


def test_every_colour_has_contrast_on_the_grounds_of_paper_and_page():
    shades = [shaded(hue, shade) for hue in HUES for shade in range(SHADES)]
    assert min(contrast(colour, ground) for colour in shades for ground in ("#ffffff", "#fbfbf9", "#eef4f9")) >= 3.0
    assert len(set("".join(GLYPHS.values()))) == 2 * len(GLYPHS), "every marker is a letter of its own"


def test_a_controller_looks_the_same_in_any_company():
    together = looks(FLIERS)
    for name in FLIERS:
        for others in (["nominal_mpc"], FLIERS[::-1], ["own_mpc", "geometric"]):
            assert looks([*others, name])[name] == together[name]


@pytest.mark.parametrize("names", [FLIERS, [*MODELS]])
def test_no_two_can_be_mistaken(names):
    worn = [LOOKS[name] for name in names]
    assert len({look.marker for look in worn}) == len({look.hue for look in worn}) == len(names)


def test_variants_share_a_marker_and_the_first_has_the_look_itself():
    labels = ["nominal_mpc @ideal", "nominal_mpc @simplified", "gp_mpc a @simplified", "gp_mpc b @simplified"]
    worn = looks(labels)
    assert list(worn) == labels
    assert [worn[label].filled for label in labels] == [True, False, True, False]
    assert worn["nominal_mpc @ideal"].marker == worn["nominal_mpc @simplified"].marker == LOOKS["nominal_mpc"].marker
    assert worn["nominal_mpc @ideal"].colour == LOOKS["nominal_mpc"].colour == shaded("grey")
    assert worn["gp_mpc a @simplified"].colour != worn["gp_mpc b @simplified"].colour
    assert worn["gp_mpc a @simplified"].dash != worn["gp_mpc b @simplified"].dash


@pytest.mark.parametrize("count", [2, SHADES, SHADES + 1, 12, len(CYCLE) - 2])
def test_no_two_variants_look_the_same(count):
    labels = ["nominal_mpc", "perfect_mpc", *(f"gp_mpc nodes={n}" for n in range(count))]
    worn = looks(labels)
    assert len({look.colour for look in worn.values()}) == len(labels)


def test_who_states_no_look_is_told_from_everybody():
    labels = ["my_mpc", *FLIERS, "my_mpc @ideal", "their_mpc", "geometric", "my_mpc+l1"]
    worn = looks(labels)
    assert len({look.colour for look in worn.values()}) == len(labels)
    assert {name: worn[name] for name in FLIERS} == looks(FLIERS)


SHIPPED = [
    *OptionFiles().options("controller"),
    *(f"{name}+{remedy}" for name in ("nominal_mpc", "gp_mpc", "dfbc", "pid") for remedy in ("l1", "indi", "wind")),
]


@given(labels=st.lists(st.sampled_from(SHIPPED), min_size=2, max_size=len(HUES), unique=True))
def test_the_colours_of_any_selection_of_shipped_controllers_can_be_told_apart(labels):
    """As many as there are hues. Ten is four just noticeable differences; of normal vision more is asked for."""
    colours = [look.colour for look in looks(labels).values()]
    assert least_difference(colours, "normal") > 25
    assert min(least_difference(colours, vision) for vision in VISIONS) > 10


def test_remedies_are_told_apart_and_have_the_marker_of_their_controller():
    names = ["none", "wind", "wind+strapdown", "l1", "indi", "delay", "l1+indi", "wind+delay", "belief"]
    labels = ["nominal_mpc", "gp_mpc", *(f"gp_mpc+{name}" for name in names[1:]), "nominal_mpc+wind", "pid", "dfbc"]
    worn = looks(labels)
    assert len({look.colour for look in worn.values()}) == len(labels)
    assert {worn[f"gp_mpc+{name}"].marker for name in names[1:]} == {worn["gp_mpc"].marker}
    assert worn["gp_mpc"].filled and not worn["gp_mpc+wind"].filled


@pytest.mark.parametrize("better", ["gp_mpc", "linear_drag_mpc"])
def test_on_the_page_rank_decides_no_colour_and_figures_have_the_same(tmp_path, monkeypatch, better):
    monkeypatch.setattr("tests.report.results.SEEDS", range(10))
    monkeypatch.setitem(ERRORS, better, 0.0004)  # the least error of all, of one or the other
    comparison = read_comparison(make_results(tmp_path / "results", lost=False))
    assert comparison.verdict.best and comparison.verdict.least == better
    assert {label: (look.hue, look.marker) for label, look in comparison.look.items()} == {
        label: (LOOKS[label].hue, LOOKS[label].marker) for label in comparison.look
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
