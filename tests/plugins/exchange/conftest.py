"""Checkpoints of identified vehicles, and a function that exports as the command does."""

import pytest

from quadexp.cli.app import app
from quadexp.models.checkpoint import save_model


@pytest.fixture(scope="session")
def checkpoints(tmp_path_factory):
    """Folder with the checkpoints cf (motor commands, linear drag) and hb (rotor speeds, blade element)."""
    from tests.plugins.exchange.models import crazyflie, hummingbird

    folder = tmp_path_factory.mktemp("models")
    save_model(folder / "cf", crazyflie())
    save_model(folder / "hb", hummingbird())
    return folder


@pytest.fixture
def export(checkpoints, tmp_path):
    """quadexp export SOURCE --to FORMAT ..; returns the text of the file. SOURCE: cf, hb, or vehicle=NAME."""
    from typer.testing import CliRunner

    def run(source: str, to: str, *options: str, out: str = "file", code: int = 0) -> str:
        place = source if "=" in source else str(checkpoints / source)
        words = ["export", place, "--to", to, *options, "--out", str(tmp_path / out), "--force"]
        done = CliRunner().invoke(app, words)
        assert done.exit_code == code, done.stderr or done.output
        return done.stderr if code else (tmp_path / out).read_bytes().decode(errors="replace")

    return run
