"""Colours can be read and told apart, by readers with and without colour vision, in both themes."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from quadexp.report.page.sheet import SHAPES, TOKENS, VARIABLES
from quadexp.report.style import HUES, LOOKS, MARKERS, MOST_VARIANTS, shaded

# Linear sRGB as seen without one kind of cone: Machado, Oliveira, Fernandes 2009 (IEEE TVCG 15(6)), severity 1.
VISIONS = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}
SERIES = [name for name in TOKENS if name.startswith("series-")]
HUE_SERIES = [f"series-{hue}-0" for hue in HUES]


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


@pytest.mark.parametrize("theme", [0, 1])
def test_contrast(theme):
    grounds = [TOKENS[name][theme] for name in ("ground", "panel", "wash")]
    least = dict.fromkeys(("ink", "muted", "accent", "alarm"), 4.5) | dict.fromkeys(SERIES, 3.0)
    for name, ratio in least.items():
        assert min(contrast(TOKENS[name][theme], ground) for ground in grounds) >= ratio, name


@pytest.mark.parametrize("theme", [0, 1])
@pytest.mark.parametrize("vision", VISIONS)
def test_series_can_be_told_apart(theme, vision):
    seen = {name: lab(np.array(VISIONS[vision]) @ linear(TOKENS[name][theme])) for name in HUE_SERIES}
    for a, b in combinations(HUE_SERIES, 2):
        assert np.linalg.norm(seen[a] - seen[b]) > 10, (a, b)  # 2 is a just noticeable difference


@pytest.mark.parametrize("theme", [0, 1])
@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("hue", HUES)
def test_shades_of_variants_can_be_told_apart(hue, vision, theme):
    shades = [shaded(hue, shade, dark=bool(theme)) for shade in range(MOST_VARIANTS)]
    seen = [lab(np.array(VISIONS[vision]) @ linear(colour)) for colour in shades]
    assert min(np.linalg.norm(a - b) for a, b in combinations(seen, 2)) > 6


def test_every_marker_has_a_shape_and_every_look_a_colour_on_the_page():
    assert set(SHAPES) == set(MARKERS) and len(set(SHAPES.values())) == len(MARKERS)
    assert {f"series-{hue}-0" for hue, _, _ in LOOKS.values()} <= set(SERIES)


def test_every_colour_of_paper_is_one_variable_of_the_theme():
    assert {VARIABLES[light] for light, _ in TOKENS.values()} == {f"var(--{name})" for name in TOKENS}
