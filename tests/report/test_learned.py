"""Panels of what was learned: the lines are the model's and the flight's own numbers, recomputed here by hand."""

from __future__ import annotations

import hashlib
import json
import math
import shutil

import numpy as np
import pytest
from matplotlib.figure import Figure
from msgspec.structs import replace

from quadexp.log.schema import Flight
from quadexp.log.store import read_flight, read_table, write_flight, write_table
from quadexp.models.checkpoint import save_model
from quadexp.models.dataset import read_dataset
from quadexp.models.gaussian_process import GPSettings, fit_gp
from quadexp.report.page import make_report
from quadexp.report.page.learned import fit_sheet
from quadexp.report.page.over_time import identified, panel_over_time, truth
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
        panel_over_time(panel, "C_d0", flights, looks(["rls_mpc", "rls_feedback"]), truth(flights[0][1], "C_d0"))
        first, second, true = panel.lines
        for line, final in ((first, 0.23), (second, 0.21)):
            t, value = line.get_data()
            np.testing.assert_allclose(value, final + (0.5 - final) * np.exp(-t), rtol=1e-3)
            assert t[0] == pytest.approx(0.02, abs=0.02) and t[-1] == pytest.approx(9.98, abs=0.03)
        assert first.get_color() != second.get_color()
        assert set(true.get_ydata()) == {0.22}
        assert "C_d0" in panel.get_title() and panel.get_xlabel() == "time (s)"
        low, high = panel.get_ylim()
        assert low < 0.21 and high > 0.3, "the true value and the last ones are inside"

    def test_a_coefficient_that_stays_was_not_identified(self):
        assert identified(identifying(0.23)) == ["C_d0"]

    @pytest.mark.parametrize("plant", [{}, {**CONSTANT["plant"], "schedule": [{"at": 5}]}])
    def test_no_truth_is_drawn_where_the_plant_has_none_that_stays(self, plant):
        assert math.isnan(truth(identifying(0.23, {"plant": plant}), "C_d0"))
        panel = Figure().subplots()
        panel_over_time(panel, "C_d0", [("rls_mpc", identifying(0.23))], looks(["rls_mpc"]))
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


def test_a_checkpoint_is_drawn_with_its_data_only_if_it_is_the_one_that_flew(fitted, tmp_path):
    folder, sha256, model = fitted
    folder = shutil.copytree(folder, tmp_path / "gp")
    assert fit_sheet(str(folder), "0" * 64).text == "Not drawn: another model lies there now, not the one that flew."
    assert fit_sheet(str(folder / "nothing"), "").text == "Not drawn: it is not there any more."
    without = fit_sheet(str(folder), sha256)
    assert without.whole is None and "a_x from v_x, 8 points" in without.text and "data" in without.text
    path = folder / "data.parquet"
    write_table(path, synthetic_dataset(rows=1200).columns, {}, "residuals")
    data = read_dataset(path)
    save_model(folder, replace(model, dataset={**model.dataset, "sha256": data.sha256}), force=True)
    (folder / "report.json").write_text(json.dumps({"dataset": str(path), "rows": []}))
    digest = hashlib.sha256((folder / "model.json").read_bytes()).hexdigest()
    sheet = fit_sheet(str(folder), digest)
    assert len(sheet.whole().axes) == 2 and sheet.panels("fit")[0].startswith('<figure class="plate"')


def test_both_stand_on_the_page(fitted, tmp_path):
    folder, sha256, _ = fitted
    root = make_results(tmp_path / "r", controllers=("nominal_mpc", "gp_mpc"), lost=False)
    relabel(root, folder, sha256)
    made = make_report(root, tmp_path / "report.html", figures=tmp_path / "figures")
    text = made["path"].read_text(encoding="utf-8")
    assert "Learned models" in text and f"Residuals in {folder}" in text
    assert "a_x from v_x, 8 points" in text
    assert "Coefficients identified in flight" in text and "C_d0 0.23" in text and "of 0.22" in text
    assert {"mean_error_against_speed", "error_against_time"} < set(made["figures"]) and len(made["figures"]) == 4


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
