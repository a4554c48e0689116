"""Panels of what was learned: the lines are the model's and the flight's own numbers, recomputed here by hand."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from matplotlib.figure import Figure

from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, read_table, write_flight, write_table
from quadexp.models.checkpoint import save_model
from quadexp.models.gaussian_process import GPSettings, fit_gp
from quadexp.report.page import make_report
from quadexp.report.page.learned import estimate_panel, fit_panel, identified, read_checkpoint
from quadexp.report.page.palette import PAPER
from quadexp.report.style import looks
from tests.log.flights import straight_flight
from tests.models.synthetic import synthetic_dataset
from tests.report.results import make_results

CONSTANT = {"plant": {"profile_drag": 0.22, "lift_slope": 3.32, "body_drag": [0.01, 0.01, 0.02]}}


def identifying(final: float, config=CONSTANT) -> Flight:
    """Ten seconds in which C_d0 comes from 0.5 to `final` and C_la stays."""
    flight = straight_flight(500)
    d0 = final + (0.5 - final) * np.exp(-flight.t)
    columns = {**flight.columns, "C_d0": d0, "C_la": np.full(500, 3.0)}
    return Flight(columns, {**flight.metadata, "config": config})


class TestIdentified:
    def test_the_coefficient_over_time_and_the_true_one(self):
        panel = Figure().subplots()
        flights = [("rls_mpc", identifying(0.23)), ("rls_feedback", identifying(0.21))]
        estimate_panel(panel, "C_d0", flights, looks(["rls_mpc", "rls_feedback"]), PAPER)
        first, second, true = panel.lines
        for line, final in ((first, 0.23), (second, 0.21)):
            t, value = line.get_data()
            np.testing.assert_allclose(value, final + (0.5 - final) * np.exp(-t), rtol=1e-12)
            assert t[0] == 0 and t[-1] == pytest.approx(9.98, abs=0.03)
        assert first.get_color() != second.get_color()
        assert set(true.get_ydata()) == {0.22}
        assert "C_{d0}" in panel.get_title() and panel.get_xlabel() == "time (s)"
        low, high = panel.get_ylim()
        assert low < 0.21 and high > 0.3, "the true value and the last ones are inside"

    def test_a_coefficient_that_stays_was_not_identified(self):
        assert identified(identifying(0.23)) == ["C_d0"]

    @pytest.mark.parametrize("plant", [{}, {**CONSTANT["plant"], "schedule": [{"at": 5}]}])
    def test_no_truth_is_drawn_where_the_plant_has_none_that_stays(self, plant):
        panel = Figure().subplots()
        estimate_panel(panel, "C_d0", [("rls_mpc", identifying(0.23, {"plant": plant}))], looks(["rls_mpc"]), PAPER)
        assert len(panel.lines) == 1


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A checkpoint of one output over one feature, as read for the page."""
    settings = GPSettings(features={"a_x": ["v_x"]}, inducing=8, max_iterations=5, holdout=0.0)
    model = fit_gp(synthetic_dataset(rows=1200), settings)
    folder = tmp_path_factory.mktemp("models") / "gp"
    save_model(folder, model)
    sha256 = hashlib.sha256((folder / "model.json").read_bytes()).hexdigest()
    return folder, sha256, model


class TestFits:
    def test_mean_band_and_linear_drag(self, fitted):
        folder, sha256, model = fitted
        (output,) = model.outputs
        panel = Figure().subplots()
        fit_panel(panel, read_checkpoint(str(folder), sha256), output, PAPER)
        mean, drag = panel.lines
        x = mean.get_xdata()
        assert [x[0], x[-1]] == pytest.approx(model.feature_range["v_x"])
        scaled = (x[:, None] - output.inducing[:, 0]) / output.lengthscale[0]
        prior = 0.0 if model.mean is None else float(model.mean.intercept[0])
        expected = prior + np.exp(-(scaled**2) / 2) @ output.alpha
        np.testing.assert_allclose(mean.get_ydata(), expected, rtol=1e-6, atol=1e-9)
        line = model.linear_drag
        np.testing.assert_allclose(drag.get_ydata(), line.intercept[0] - line.drag[0] * x, rtol=1e-9, atol=1e-9)
        band = panel.collections[0].get_paths()[0].vertices
        limits = np.array([np.sort(band[band[:, 0] == v][:, 1])[[0, -1]] for v in x[1:-1]])
        np.testing.assert_allclose(limits.mean(axis=1), expected[1:-1], rtol=1e-6, atol=1e-9)
        widths = np.diff(limits, axis=1)[:, 0]
        assert (widths >= 4 * np.sqrt(output.noise_variance) * (1 - 1e-6)).all(), "2 sigma a side, noise and all"
        assert (widths <= 4 * np.sqrt(output.noise_variance + output.signal_variance) * (1 + 1e-6)).all()

    def test_another_model_at_that_place_is_not_drawn(self, fitted):
        folder, _, _ = fitted
        found = read_checkpoint(str(folder), "0" * 64)
        assert found.model is None and found.note == "another model lies there now, not the one that flew"
        assert read_checkpoint(str(folder / "nothing"), "").note == "it is not there any more"


def test_both_stand_on_the_page(fitted, tmp_path):
    folder, sha256, _ = fitted
    root = make_results(tmp_path / "r", controllers=("nominal_mpc", "gp_mpc"), lost=False)
    relabel(root, folder, sha256)
    made = make_report(root, tmp_path / "report.html", figures=tmp_path / "figures")
    text = made["path"].read_text(encoding="utf-8")
    assert "Learned models" in text and f"Residuals in <code>{folder}</code>" in text
    assert "a_x from v_x, 8 points" in text
    assert "Coefficients identified in flight" in text and "C_d0 0.23" in text and "of 0.22" in text
    assert {"mean_error_against_speed", "error_against_time"} < set(made["figures"]) and len(made["figures"]) == 5


def relabel(root, folder, sha256):
    """Let gp_mpc have flown with the checkpoint, and nominal_mpc be one that identifies coefficients."""
    columns, record = read_table(root / "results.parquet", "results")
    names = np.array(["rls_mpc" if name == "nominal_mpc" else name for name in columns["controller"]], dtype=object)
    models = np.array([str(folder) if name == "gp_mpc" else "" for name in names], dtype=object)
    write_table(root / "results.parquet", {**columns, "controller": names, "model": models}, record, "results")
    for path in (root / "cells").rglob("*.parquet"):
        flight = read_flight(path)
        about = dict(flight.metadata)
        columns = dict(flight.columns)
        if about["config"]["controller"]["name"] == "gp_mpc":
            about |= {"model": str(folder), "model_sha256": sha256}
        else:
            columns["C_d0"] = 0.23 + 0.27 * np.exp(-6 * flight.t)
            about["config"] = {**about["config"], **CONSTANT}
        write_flight(path, Flight(columns, about))
