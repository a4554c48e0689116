"""The command that draws a search for delays."""

from __future__ import annotations

from typer.testing import CliRunner

from quadexp.cli.app import app
from quadexp.experiment.evaluate import fly_one
from quadexp.log.store import write_flight
from quadexp.parts.compose import compose


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
