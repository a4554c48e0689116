"""Text and figures of a validation: every mode that `validate` computes is printed and drawn, with its own numbers."""

import numpy as np
import pytest

from quadexp.plugins.identification.figures import rollout_figure
from quadexp.plugins.identification.lines import MODES, rollout_lines

HORIZONS, PREDICTORS = (0.1, 0.5), ("nominal", "linear drag")


def rollouts(modes=tuple(MODES)):
    """Rows as `validate` writes them: attitude as measured without errors of attitude and rate, tracked and not."""
    rng, rows = np.random.default_rng(0), []
    for mode in modes:
        names = ("position", "velocity") if mode == "attitude" else ("position", "velocity", "attitude", "rate")
        for predictor in PREDICTORS:
            for tracked in (False, True) if mode == "attitude" else (True,):
                for horizon in HORIZONS:
                    errors = {f"{n}{end}": float(rng.uniform(0.1, 1)) for n in names for end in ("", "_median")}
                    about = {"predictor": predictor, "mode": mode, "thrust_tracked": tracked, "horizon": horizon}
                    rows.append({**about, "starts": 9, "lost": 0.0, **errors})
    return rows


@pytest.mark.parametrize("modes", [tuple(MODES), ("held", "full")])
def test_every_mode_is_drawn_with_its_own_numbers(modes):
    rows = rollouts(modes)
    panels = [panel for panel in rollout_figure(rows).axes if panel.axison]
    assert len(panels) == sum(2 if mode == "attitude" else 4 for mode in modes)
    assert {panel.get_title() for panel in panels} == {MODES[mode][0] for mode in modes}
    titles = {MODES[mode][0]: mode for mode in MODES}
    for panel in panels:
        mode, quantity = titles[panel.get_title()], panel.get_ylabel().split()[0]
        factor = 180 / np.pi if quantity == "attitude" else 1.0
        column = quantity if mode == "attitude" else f"{quantity}_median"
        assert ("RMS" if mode == "attitude" else "median") in panel.get_ylabel()
        assert ("(deg)" in panel.get_ylabel()) == (quantity == "attitude")
        for line in panel.lines:
            own = [r for r in rows if r["mode"] == mode and r["thrust_tracked"] and r["predictor"] == line.get_label()]
            np.testing.assert_allclose(line.get_xdata(), HORIZONS)
            np.testing.assert_allclose(line.get_ydata(), [factor * r[column] for r in own])
        assert [line.get_label() for line in panel.lines] == list(PREDICTORS)


def test_the_text_has_the_same_numbers():
    rows = [row for row in rollouts() if row["mode"] == "held"]
    above, _, *lines = rollout_lines(rows)
    assert above.split() == ["position", "(m)", "velocity", "(m/s)", "attitude", "(deg)", "rate", "(rad/s)"]
    for line, predictor in zip(lines, PREDICTORS, strict=True):
        own = [row for row in rows if row["predictor"] == predictor]
        wanted = [
            (180 / np.pi if name == "attitude" else 1) * row[f"{name}_median"]
            for name in ("position", "velocity", "attitude", "rate")
            for row in own
        ]
        assert line.startswith(predictor)
        np.testing.assert_allclose([float(x) for x in line.removeprefix(predictor).split()], wanted, atol=5e-4)
