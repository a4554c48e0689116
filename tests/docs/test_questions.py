"""docs/questions.md: twenty questions, each answered by one command that draws the picture that is named."""

import shlex
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from quadexp.parts.compose import expand
from quadexp.plugins.page.sweep_figures import draw, drawings
from quadexp.report.frame import SweepFrame
from tests.docs.questions import PICTURES, answer, questions
from tests.docs.test_commands import alike
from tests.report.sweeps import noise, swept

QUICK = (1, 2, 19)  # questions whose flights are flown by the default tests; those of the others are slow
LARGEST = 1_500_000  # bytes of all pictures
PATHS = (8,)  # whose picture is of the paths that were flown


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("questions")


def test_there_are_twenty_and_each_is_one_command():
    _, found = questions()
    assert [one.number for one in found] == list(range(1, 21))
    assert len({shlex.join(one.command.words) for one in found}) == 20
    assert all(one.title.endswith("?") and one.command.program == "quadexp" for one in found)


def test_the_picture_of_each_is_stored_and_small():
    """Made by `python -m tests.docs.questions`."""
    shown = [PICTURES / one.shown for one in questions()[1]]
    assert len({*shown}) == 20 and {*PICTURES.iterdir()} == {*shown}
    for path in shown:
        assert min(Image.open(path).size) > 200, path
    assert sum(path.stat().st_size for path in shown) < LARGEST


def swept_questions() -> list[int]:
    return [one.number for one in questions()[1] if one.command.words[0] == "evaluate"]


@pytest.mark.parametrize("number", swept_questions())
def test_what_a_question_sweeps_can_be_flown_and_chooses_its_picture(number, tmp_path):
    """Without flights: every combination is sound, rows stand for the flights, and the figure that is chosen for them
    has the name of the picture and can be drawn."""
    question = questions()[1][number - 1]
    words = question.command.words
    asked = [word for word in words[1 : words.index("--out")] if word != "--sweep"]
    # a checkpoint that another command makes, and who needs it
    asked = [word.replace("linear_drag_mpc", "perfect_mpc") for word in asked if not word.startswith("model=")]
    assert all(not cell.invalid for cell in expand(asked))
    out = swept(tmp_path / "results", asked, lambda config: 0.01 * (1 + noise(config.seed, repr(config))))
    frame = SweepFrame.read(out)
    made = {one.name: one for one in drawings(frame.rows, out, "mean_error", 0.95, frame.record)}
    picture = Path(question.picture)
    assert picture.parent == Path(words[words.index("--out") + 1]) / "figures" and picture.stem in made
    if number not in PATHS:
        draw(made[picture.stem], tmp_path / "a.svg")


@pytest.mark.parametrize(
    "number", [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in range(1, 21)]
)
def test_the_command_prints_what_is_said_and_draws_the_picture(number, folder, monkeypatch):
    monkeypatch.chdir(folder)
    question = questions()[1][number - 1]
    printed = answer(number)
    for line in question.command.said:
        assert any(alike(line, text) for text in printed.splitlines()), (line, printed)
    pixels = np.asarray(Image.open(question.picture).convert("L"))
    assert min(pixels.shape) > 100 and len(np.unique(pixels)) > 10, "the picture is empty"
