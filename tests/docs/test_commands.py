"""Every command of the documentation: read by the command line as it stands, and flown in its order."""

from __future__ import annotations

import os
import re
from pathlib import Path

import click
import pytest
import typer.main
from typer.testing import CliRunner

from quadexp.cli import app
from quadexp.compose import session
from tests.docs.commands import ROOT, commands

PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
OVERRIDE = re.compile(r"[\w./@]+=.*", re.S)


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=lambda page: page.name)
def test_options_and_overrides_are_those_that_there_are(page):
    """Parsed and composed, but not run."""
    group = typer.main.get_command(app)
    for words in commands(page):
        command = group.get_command(click.Context(group), words[0])
        assert command is not None, words
        context = command.make_context(words[0], list(words[1:]))
        overrides = [text for text in context.params.get("overrides") or [] if OVERRIDE.fullmatch(text)]
        conf = context.params.get("conf")
        with session(ROOT / conf if conf else None) as composer:
            if context.params.get("sweep"):
                assert len(composer.expand(overrides)) >= 1
            elif overrides:
                composer.compose(overrides)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["README.md", "docs/guide.md"])
def test_they_run_in_their_order(name, tmp_path, monkeypatch):
    """In an empty folder, beside what a checkout has; the README's own are run after `make`'s collect and fit."""
    for folder in ("examples", "conf"):
        os.symlink(ROOT / folder, tmp_path / folder)
    monkeypatch.chdir(tmp_path)
    before = [] if name != "README.md" else [
        ["collect", "collect.duration=60", "--out", "data/quick.parquet"],
        ["fit-gp", "data/quick.parquet", "--out", "models/gp", "--no-figures"],
        ["evaluate", "--sweep", "experiment=quick", "--out", "results/quick", "--no-figures"],
    ]  # fmt: skip
    for words in [*before, *commands(ROOT / name)]:
        out = words[words.index("--out") + 1] if "--out" in words else ""
        force = ["--force"] if words[0] in ("simulate", "collect", "fit-gp", "report") and Path(out).exists() else []
        done = CliRunner().invoke(app, [*words, *force])
        assert done.exit_code == 0, (words, done.stderr or done.output)
        assert not out or Path(out).exists(), words
