"""Which samples lie outside the data of a fit: one definition for flights, held-out rows and validation."""

from __future__ import annotations

import numpy as np
import pytest

from quadexp.models.checkpoint import load_model, save_model
from quadexp.models.dataset import ResidualDataset
from quadexp.models.linear_drag import fit_linear_drag
from quadexp.models.support import feature_ranges, outside_shares


def rows(velocity, thrust=None) -> ResidualDataset:
    velocity = np.asarray(velocity, float)
    columns = {f"v_{axis}": velocity[:, i] for i, axis in enumerate("xyz")}
    return ResidualDataset(columns | {"thrust": np.full(len(velocity), 10.0) if thrust is None else thrust}, {})


def test_ranges_are_those_of_the_rows_and_speed_counts_from_zero():
    ranges = feature_ranges(rows([[3, 0, 0], [-3, 4, 1]], np.array([5.0, 9.0])), ["thrust"])
    assert ranges["v_x"] == [-3, 3] and ranges["v_y"] == [0, 4] and ranges["thrust"] == [5, 9]
    assert ranges["speed"] == [0, pytest.approx(np.sqrt(26))]


def test_a_corner_inside_every_axis_is_outside_by_its_speed():
    """17 m/s along x and along y, never both: 24 m/s along the diagonal was not in the data."""
    ranges = feature_ranges(rows([[17, 0, 0], [-17, 0, 0], [0, 17, 0], [0, -17, 0]]))
    shares = outside_shares(ranges, rows([[0, 0, 0], [16, 16, 0], [17, 0, 0], [18, 0, 0]]))
    assert shares["v_x"] == 0.25 and shares["v_y"] == 0 and shares["speed"] == 0.5 and shares["any"] == 0.5


def test_the_rows_of_the_fit_are_never_outside(dataset, model):
    assert outside_shares(model.feature_range, dataset)["any"] == 0
    assert outside_shares(fit_linear_drag(dataset, intervals=False).feature_range, dataset)["any"] == 0
    assert {"v_x", "v_y", "v_z", "speed", "thrust"} == set(model.feature_range)


def test_a_checkpoint_keeps_them_and_one_without_them_says_unknown(dataset, tmp_path):
    from msgspec.structs import replace

    from quadexp.report.summary import summarise

    fit = fit_linear_drag(dataset, intervals=False)
    save_model(tmp_path / "new", fit)
    assert load_model(tmp_path / "new").feature_range == fit.feature_range
    assert any(line.startswith("covers      v_x ") for line in summarise(tmp_path / "new")["lines"])
    save_model(tmp_path / "old", replace(fit, feature_range={}))
    assert any("covers      unknown" in line for line in summarise(tmp_path / "old")["lines"])
