"""The figure of a search for delays: what it shows, of the numbers that were found."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner

from quadexp.cli.app import app
from quadexp.experiment.evaluate import fly_one
from quadexp.log.store import write_flight
from quadexp.parts.compose import compose
from quadexp.report.log_figures import Profile, delay_figure


def test_the_chosen_candidate_and_what_was_believed_in_flight_are_drawn():
    candidates, t = np.linspace(0.0, 0.04, 81), np.arange(4.0)
    profile = Profile("age of the state", candidates, -(((candidates - 0.012) / 0.002) ** 2) / 2, 0.012, 0.002)
    curve, band, chosen = (mark.values for mark in profile.panel().marks)
    assert curve[0][np.argmax(curve[1])] == pytest.approx(12.0) == chosen[0] and band == pytest.approx((10, 14))
    columns = {"t": t, "delay_known": t > 1, "delay_time": 0.01 * (t > 1)}
    columns |= {"delay_dead_time": 0.02 * (t > 1), "delay_lag": 0.03 * (t > 1)}
    panel = delay_figure([profile, profile], columns, {"delay_lag": 0.031}).axes[-1]
    assert [line.get_ydata()[-1] for line in panel.lines] == pytest.approx([10.0, 20.0, 30.0, 31.0])
    assert "dotted: true" in panel.get_title()
    assert len(delay_figure([profile], {"t": t}).axes) == 1


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
