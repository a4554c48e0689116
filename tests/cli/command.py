"""The command line in this process."""

from __future__ import annotations

from typer.testing import CliRunner

from quadexp.cli.app import app


def run(*arguments):
    """Exit code, output, error output."""
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return done.exit_code, done.stdout, done.stderr
