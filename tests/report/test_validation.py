"""Text of a validation: what `validate` computes is printed with its own numbers."""

import numpy as np

from quadexp.report.model_lines import MODES, rollout_lines

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
