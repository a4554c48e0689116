"""The figure of a search for delays: what it shows, of the numbers that were found."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

from quadexp.cli.app import app
from quadexp.experiment.evaluate import fly_one
from quadexp.log.store import write_flight
from quadexp.parts.compose import compose
from quadexp.report.log_figures import Profile, delay_figure


def test_the_chosen_candidate_and_its_standard_error_are_drawn():
    candidates = np.linspace(0.0, 0.04, 81)
    profile = Profile("age of the state", candidates, -(((candidates - 0.012) / 0.002) ** 2) / 2, 0.012, 0.002)
    (panel,) = delay_figure([profile], {"t": np.arange(3.0)}).axes
    curve, chosen = panel.lines
    assert curve.get_xdata()[np.argmax(curve.get_ydata())] == pytest.approx(12.0)
    assert chosen.get_xdata() == pytest.approx([12.0, 12.0])
    band = panel.patches[0].get_extents().transformed(panel.transData.inverted())
    assert (band.x0, band.x1) == pytest.approx((12 - 2, 12 + 2))


def test_what_was_believed_in_flight_stands_beside_the_truth():
    t = np.arange(4.0)
    columns = {"t": t, "delay_known": t > 1, "delay_time": 0.01 * (t > 1)}
    columns |= {"delay_dead_time": 0.02 * (t > 1), "delay_lag": 0.03 * (t > 1)}
    profile = Profile("age", t, -t, 0.0, 0.1)
    panel = delay_figure([profile], columns, {"delay_lag": 0.031}).axes[-1]
    assert [line.get_ydata()[-1] for line in panel.lines] == pytest.approx([10.0, 20.0, 30.0, 31.0])
    assert "dotted: true" in panel.get_title()
    assert "dotted" not in delay_figure([profile], columns).axes[-1].get_title()


def test_the_command_draws_a_flight(tmp_path):
    path, picture = tmp_path / "a.parquet", tmp_path / "delays.svg"
    flown = ["controller=nominal_mpc", "controller.backend=interpreted", "world=everything", "trajectory.speed=6"]
    write_flight(path, fly_one(compose([*flown, "delay=identified", "seed=3"])))
    told = CliRunner().invoke(app, ["identify", "--method", "delays", str(path), "--figure", str(picture)])
    assert told.exit_code == 0 and picture.stat().st_size > 10_000 and picture.with_suffix(".png").exists()
    two = CliRunner().invoke(app, ["identify", "--method", "delays", str(path), str(path), "--figure", str(picture)])
    assert two.exit_code == 2 and "--figure: draws one flight, 2 are given" in two.output
    other = CliRunner().invoke(app, ["identify", "--method", "rls", str(path), "--figure", str(picture)])
    assert other.exit_code == 2 and "is for --method delays" in other.output
