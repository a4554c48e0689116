"""Figures with any axes: every panel, cell and line with its number, and marks where flights are missing."""

import re
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.colors import to_hex

from quadexp.errors import UsageError
from quadexp.plugins.drawing.style import LOOKS, check_path
from quadexp.plugins.page.draw import SUFFIXES, figure_of, page_of, save_view
from quadexp.plugins.page.view import automatic, view
from quadexp.report.frame import SweepFrame
from tests.report.sweeps import noise, swept


@pytest.fixture(scope="module")
def frame(tmp_path_factory):
    """Nodes and horizons of three controllers, one of which knows neither; nominal_mpc with 5 nodes and 2 s is lost."""

    def error(config):
        nodes, horizon, name = config.controller.nodes, config.controller.horizon, config.controller.name
        if (name, nodes, horizon) == ("nominal_mpc", 5, 2.0):
            return None
        return (0.1 if name == "nominal_mpc" else 0.001) * horizon / nodes * (1 + 0.1 * noise(config.seed, nodes))

    asked = [
        "controller=nominal_mpc,perfect_mpc,rls_feedback",
        "controller.nodes=5,10,20",
        "controller.horizon=0.5,1,2",
    ]
    return SweepFrame.read(swept(tmp_path_factory.mktemp("r") / "r", [*asked, "seed=0,1"], error))


def texts(panel):
    return [text.get_text() for text in panel.texts]


def test_small_multiples_have_every_panel_and_every_line(frame):
    made = automatic(frame)[0]
    figure = figure_of(made)
    panels = [panel for panel in figure.axes if panel.axison]
    assert [panel.get_title() for panel in panels] == ["horizon 0.5 s", "horizon 1 s", "horizon 2 s"]
    for panel, horizon in zip(panels, (0.5, 1, 2), strict=True):
        drawn = {c.get_label(): c.lines[0] for c in panel.containers}
        expected = {"nominal_mpc", "perfect_mpc"}
        assert set(drawn) == expected and panel.get_xscale() == "log"
        for name, line in drawn.items():
            assert to_hex(line.get_color()) == LOOKS[name].colour
            for nodes, mean in zip(*line.get_data(), strict=True):
                assert mean == pytest.approx(1e3 * made.places[horizon, name, nodes].mean, rel=1e-12)
        assert texts(panel).count("invalid") == 3
        assert texts(panel).count("0/2") == (1 if horizon == 2 else 0)
        assert len(drawn["nominal_mpc"].get_xdata()) == (2 if horizon == 2 else 3)
    assert "2 of 36 flights were not completed" in figure.get_suptitle()
    (legend,) = figure.legends
    named = {text.get_text() for text in legend.get_texts()}
    assert named == {"nominal_mpc", "perfect_mpc", "rls_feedback (invalid)"}


def test_cells_of_a_heat_map_are_where_their_values_are(frame):
    made = view(frame, x="controller.nodes", by=["controller.horizon"], kind="heat")
    figure = figure_of(made)
    panels = [panel for panel in figure.axes if panel.get_title()]
    assert [panel.get_title() for panel in panels] == ["nominal_mpc", "perfect_mpc", "rls_feedback"]
    for panel in panels[:2]:
        (image,) = panel.images
        shown = image.get_array()
        assert [text.get_text() for text in panel.get_xticklabels()] == ["5", "10", "20"]
        assert [text.get_text() for text in panel.get_yticklabels()] == ["0.5", "1", "2"]
        for j, horizon in enumerate((0.5, 1, 2)):
            for i, nodes in enumerate((5, 10, 20)):
                point = made.places[panel.get_title(), horizon, nodes]
                written = next(text for text in panel.texts if text.get_position() == (i, j)).get_text()
                if point.is_shown:
                    assert shown[j, i] == pytest.approx(1e3 * point.mean, rel=1e-12)
                    assert float(written) == pytest.approx(1e3 * point.mean, rel=0.01)
                else:
                    assert np.ma.is_masked(shown[j, i]) and written == "0/2\nflown"
        assert image.origin == "lower"
    assert texts(panels[2]) == ["invalid"] * 9 and len(panels[2].patches) == 9


def test_names_of_ones_own_stand_at_axes_lines_panels_and_leave_the_colours(frame):
    names = {"controller.nodes": "N", "perfect_mpc": "ours", "mean_error": "error (mm)", "1": "one second"}
    figure = figure_of(replace(automatic(frame)[0].named(names), heading="Title", width=3.5))
    panel = figure.axes[1]
    assert (panel.get_xlabel(), figure.axes[0].get_ylabel(), panel.get_title()) == ("N", "error (mm)", "one second")
    assert figure.get_suptitle() == "Title" and figure.get_figwidth() == 3.5
    drawn = {line.get_label(): to_hex(line.lines[0].get_color()) for line in panel.containers}
    assert drawn == {"nominal_mpc": LOOKS["nominal_mpc"].colour, "ours": LOOKS["perfect_mpc"].colour}


def test_panels_beyond_the_room_are_said(tmp_path):
    masses = [f"{1 + 0.01 * i:.2f}" for i in range(40)]
    asked = [f"vehicle.mass={','.join(masses)}", "controller.nodes=5,10,20"]
    read = SweepFrame.read(swept(tmp_path / "r", asked, lambda config: 0.01))
    figure = figure_of(view(read, x="controller.nodes", by=[], facet=["vehicle.mass"]))
    assert sum(panel.axison for panel in figure.axes) == 36
    said = " ".join(figure.get_suptitle().split())
    assert "no room for 4 panels: mass 1.36 kg, mass 1.37 kg, mass 1.38 kg, mass 1.39 kg" in said


def test_groups_stand_side_by_side_without_lines(tmp_path):
    asked = ["wind=none,constant", "controller=nominal_mpc,perfect_mpc", "seed=0,1"]
    made = automatic(SweepFrame.read(swept(tmp_path / "r", asked, lambda config: 0.01 + 0.001 * config.seed)))[0]
    panel = figure_of(made).axes[0]
    assert [text.get_text() for text in panel.get_xticklabels()] == ["none", "constant"]
    first, second = (container.lines[0] for container in panel.containers)
    assert (
        first.get_linestyle() == "None"
        and first.get_xdata()[0] < 0 < second.get_xdata()[0] < 0.5 < first.get_xdata()[1]
    )


@pytest.mark.parametrize(("form", "kind"), [("png", "lines"), ("pdf", "heat"), ("html", "lines"), ("svg", "heat")])
def test_every_format_and_twice_the_same(frame, tmp_path, form, kind):
    made = view(frame, x="controller.nodes", by=["controller.horizon"], kind=kind)
    first = save_view(made, check_path(tmp_path / f"a.{form}", False, SUFFIXES)).read_bytes()
    begin = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml", "html": b"<!doctype"}[form]
    assert first.startswith(begin) and save_view(made, tmp_path / f"b.{form}").read_bytes() == first
    for name, wrong in ((f"a.{form}", "exists already"), ("a.jpg", "a figure is a file .png, .pdf, .svg, .html")):
        with pytest.raises(UsageError, match=wrong):
            check_path(tmp_path / name, False, SUFFIXES)


def test_a_page_holds_the_numbers_and_needs_no_network(frame):
    page = page_of(view(frame, x="controller.nodes", by=["controller.horizon"]), "a <b>")
    assert "a &lt;b&gt;" in page and page.count("<tr>") == 1 + 27
    assert not re.search(r"(?:src|href)=[\"']?(?:https?:)?//", page) and "@import" not in page


def test_nothing_that_was_completed_is_one_line_and_success_is_drawn(tmp_path):
    read = SweepFrame.read(swept(tmp_path / "r", ["controller.nodes=5,10"], lambda config: None))
    with pytest.raises(UsageError, match="none of the 2 flights was completed"):
        view(read, x="controller.nodes")
    assert figure_of(view(read, x="controller.nodes", y="success")).axes
