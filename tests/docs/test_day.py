"""docs/paper.md as it stands: from a new controller to a PDF of two pages, and an archive that flies again; and the
exercises of docs/course.md."""

import re
import shutil
import subprocess
import zipfile
from pathlib import Path

import pytest
import yaml

from quadexp.parts.compose import expand
from quadexp.plugins.logs.importers.mapping import _TOP
from quadexp.plugins.logs.importers.quantities import QUANTITIES
from quadexp.report.frame import read_results
from tests.docs.commands import ROOT, run, steps
from tests.plugins.archive.test_archive import called, commands

PAGE = ROOT / "docs" / "paper.md"
LATEX = all(map(shutil.which, ("pdflatex", "bibtex", "kpsewhich")))


def fenced(page: Path, language: str) -> list[str]:
    """The fenced blocks of a page in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def test_the_experiment_of_the_page_is_of_as_many_flights_as_it_says(tmp_path):
    (tmp_path / "experiment").mkdir()
    (text,) = fenced(PAGE, "yaml")
    (tmp_path / "experiment" / "table3.yaml").write_text(text)
    cells = expand(["experiment=table3"], tmp_path)
    assert len(cells) == 4 * (16 + 6 + 1) == int(re.search(r"These are (\d+) flights", PAGE.read_text())[1])


def test_the_page_of_keys_has_every_key_of_a_mapping():
    rows = re.findall(r"^\| (`[^|]*) \|", (ROOT / "docs" / "import_keys.md").read_text(), re.MULTILINE)
    named = {key for row in rows for key in re.findall(r"`(\w+)`", row)}
    own = {key for quantity in QUANTITIES.values() for key in quantity.keys}
    assert named == {*_TOP, *own}


def test_the_options_of_the_pages_are_yaml():
    for page in ("reinforcement.md", "paper.md"):
        for text in fenced(ROOT / "docs" / page, "yaml"):
            assert yaml.safe_load(text)


@pytest.mark.slow
def test_a_day_from_a_controller_to_a_paper_and_its_archive(tmp_path, monkeypatch):
    work, empty = tmp_path / "work", tmp_path / "empty"
    work.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    for step in steps(PAGE):
        printed = run(step.program, step.words)
        if step.into:
            Path(step.into).write_text(printed, encoding="utf-8")
    if LATEX and subprocess.run(["kpsewhich", "IEEEtran.bst"], capture_output=True).stdout:
        (text,) = fenced(PAGE, "latex")
        Path("paper.tex").write_text(text)
        for command in ("pdflatex", "bibtex", "pdflatex", "pdflatex"):
            halt = ["-interaction=nonstopmode", "-halt-on-error"] if command == "pdflatex" else []
            done = subprocess.run([command, *halt, "paper"], capture_output=True, text=True)
            assert done.returncode == 0, done.stdout[-2000:]
        log = Path("paper.log").read_text(errors="replace")
        assert "Output written on paper.pdf (2 pages" in log and "Overfull" not in log
        assert "undefined" not in log
    with zipfile.ZipFile("day.zip") as archive:
        archive.extractall(empty)
    *_, fly, compare = commands((empty / "README.md").read_text())
    done = called(fly, empty)
    assert done.returncode == 0, done.stderr
    assert "120 of 120 pairs are the same to the last bit" in called(compare, empty).stdout
    errors = [[row["mean_error"] for row in sorted(read_results(folder)[1], key=lambda row: row["key"])]
              for folder in (work / "results" / "day", empty / "results_again")]  # fmt: skip
    assert errors[0] == errors[1] and len(errors[0]) == 120


@pytest.mark.slow
def test_the_exercises_run_and_give_what_the_teacher_expects(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    for words in (["collect", "collect.duration=30", "--out", "data/short.parquet"],
                  ["fit-drag", "data/short.parquet", "--out", "models/drag"]):  # fmt: skip
        run("quadexp", words)
    means = {}
    for step in steps(ROOT / "docs" / "course.md"):
        run(step.program, step.words)
        out = step.words[step.words.index("--out") + 1]
        if step.words[0] == "evaluate":
            means[out] = read_results(out)[1]
    ignorant = {
        row["speed"]: row["mean_error"] for row in means["results/ignorance"] if row["controller"] == "nominal_mpc"
    }
    assert 0.05 < ignorant[2.0] < 0.07 and 0.22 < ignorant[8.0] < 0.26
    helped = {row["controller"]: row["mean_error"] for row in means["results/feedback"]}
    assert max(helped["linear_drag_mpc"], helped["nominal_mpc+disturbance"]) < 0.35 * helped["nominal_mpc"]
    late = [row["outcome"] for row in means["results/late"]]
    assert late[0] == "ok" and late[-1] != "ok"
