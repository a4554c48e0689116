"""Every command of the documentation: read by the command line as it stands, and flown in its order."""

import importlib.util
import os
import re
from pathlib import Path

import click
import pytest
from typer.main import get_command
from typer.testing import CliRunner

from quadexp.cli.app import app
from quadexp.parts.compose import session
from tests.deleted import needs
from tests.docs.commands import ROOT, commands, inline, run, steps

PAGES = sorted(page for folder in (".", "docs", "docs/site", "benchmarks") for page in (ROOT / folder).glob("*.md"))
OVERRIDE = re.compile(r"[\w./@]+=.*", re.DOTALL)
LOOSE = ("step", "a_x", "a_y", "a_z", "...")  # times, errors that a few held-out rows decide, and what stands for more
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?!\w)")
FACTOR = 1.5  # that a number may differ by: a new key makes `collect` draw other paths, and so what is learned
FORCED = ("simulate", "collect", "fit-gp", "report", "export", "import", "plot", "compare")


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def read_as_it_stands(words: list[str]) -> None:
    """Parsed and composed, but not run."""
    group = get_command(app)
    command = group.get_command(click.Context(group), words[0])
    assert command is not None, words
    context = command.make_context(words[0], list(words[1:]))
    overrides = [text for text in context.params.get("overrides") or [] if OVERRIDE.fullmatch(text)]
    folders = [ROOT / folder for folder in context.params.get("conf") or ()]
    if not all(map(Path.is_dir, folders)):
        return  # a folder that an earlier command of the page makes
    with session(folders) as composer:
        sweeps = context.params.get("sweep") or words[0] == "tune"  # whose trials are sweeps
        if words[0].startswith("fit"):
            model = context.params.get("model") or words[0].removeprefix("fit-")
            composer.fitted(model, overrides)
        elif sweeps and any("," in text or "range(" in text for text in overrides):
            assert len(composer.expand(overrides)) >= 1
        elif overrides:
            composer.compose(overrides)


@pytest.mark.parametrize("page", [page for page in PAGES if commands(page)], ids=name)
@needs()
def test_options_and_overrides_are_those_that_there_are(page):
    for words in commands(page):
        read_as_it_stands(words)


@pytest.mark.parametrize("page", [page for page in PAGES if inline(page) and page.name != "migrating.md"], ids=name)
@needs()
def test_commands_in_running_text_too(page):
    """Alone, `quadexp fit-gp` names a command; with more words it must be one that runs."""
    group = get_command(app)
    for words in inline(page):
        if len(words) > 1 and "--help" not in words:
            read_as_it_stands(words)
        elif words and not words[0].startswith("-"):
            assert group.get_command(click.Context(group), words[0]) is not None, words


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_make_targets_modules_and_tests_are_there(page):
    text = page.read_text(encoding="utf-8")
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    for target in re.findall(r"(?:`|^    )make ([a-z][\w-]*)(?![\w=-])", text, re.MULTILINE):
        assert target in targets, f"{page.name}: make {target}"
    for module in re.findall(r"python -m ([\w.]+)", text):
        assert importlib.util.find_spec(module) is not None, f"{page.name}: python -m {module}"
    for path in re.findall(r"pytest (?:-\S+ )*(tests/\S*\w)", text):
        assert (ROOT / path).exists(), f"{page.name}: {path}"


def test_what_a_command_prints_is_found_below_it():
    first = steps(ROOT / "docs" / "guide.md")[0]
    assert first.program == "quadexp" and first.words[0] == "simulate"
    assert first.said[1] == "outcome     ok" and first.said[-1] == "runs/nominal.parquet"


@pytest.mark.slow
@pytest.mark.parametrize("page", ["README.md", "docs/guide.md", "docs/plots.md"])
@needs()
def test_they_run_in_their_order_and_print_what_is_said(page, tmp_path, monkeypatch):
    """In an empty folder, beside what a checkout has; the README's own are run after `make`'s collect and fit."""
    for folder in ("examples", "conf"):
        os.symlink(ROOT / folder, tmp_path / folder)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    if page == "README.md":
        run("quadexp", ["collect", "collect.duration=60", "--out", "data/quick.parquet"])
        run("quadexp", ["fit-gp", "data/quick.parquet", "--out", "models/gp", "--no-figures"])
        run("quadexp", ["evaluate", "--sweep", "experiment=quick", "--out", "results/quick", "--no-figures"])
    for step in steps(ROOT / page):
        out = step.words[step.words.index("--out") + 1] if "--out" in step.words else ""
        force = ["--force"] if step.words[0] in FORCED and Path(out or ".").exists() and not step.into else []
        printed = run(step.program, [*step.words, *force])
        if step.into:
            Path(step.into).write_text(printed, encoding="utf-8")
        assert not out or Path(out).exists(), step.words
        for line in step.said:
            found = line.startswith(LOOSE) or any(alike(line, text) for text in printed.splitlines())
            assert found, (step.words, line, printed)


REFUSED = [(page, step) for page in PAGES for step in steps(page) if step.said and step.said[0].startswith("error: ")]


@pytest.mark.parametrize(("page", "step"), REFUSED, ids=[f"{name(page)} {step.words[-1]}" for page, step in REFUSED])
@needs()
def test_what_a_page_says_is_refused_is_refused_in_these_words(page, step, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = CliRunner().invoke(app, step.words)
    assert found.exit_code == 2 and alike(step.said[0], found.stderr.splitlines()[-1])


def alike(said: str, printed: str) -> bool:
    """The same words, and numbers within FACTOR of each other; intervals (in brackets) aside."""
    one, other = (" ".join(re.sub(r"\[[\d., ]+\]", "", line).split()) for line in (said, printed))
    pairs = zip(NUMBER.findall(one), NUMBER.findall(other), strict=False)
    close = all(a == b or 1 / FACTOR < float(a) / max(float(b), 1e-9) < FACTOR for a, b in pairs)
    return NUMBER.sub("#", one) == NUMBER.sub("#", other) and close


def test_a_line_is_alike_where_words_agree_and_numbers_nearly():
    assert alike("│ circle │ 4 │ 116.4 [115.8, 116.9] │ 0.9 │", "│ circle   │   4 │ 117.0 [111, 120] │ 1.1 │")
    assert not alike("│ circle │ 4 │ 116.4 │", "│ circle │ 4 │ 36.4 │")
    assert not alike("models/gp", "models/gp2") and not alike("lost at 4 s", "ok at 4 s")
