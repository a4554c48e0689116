"""The questions of docs/questions.md; `python -m tests.docs.questions [NUMBER ...]` draws their pictures anew."""

import os
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from PIL import Image

from tests.docs.commands import ROOT, Step, run, steps
from tests.docs.notebooks import environment

PAGE = ROOT / "docs" / "questions.md"
PICTURES = ROOT / "docs" / "figures" / "questions"
WIDEST = 1000  # pixels of a stored picture
COLOURS = 64  # of it


class Question(NamedTuple):
    """picture: the file that the command writes. shown: the name of its copy in PICTURES."""

    number: int
    title: str
    command: Step
    picture: str
    shown: str


def questions() -> tuple[list[Step], list[Question]]:
    """The commands that come first, and the questions."""
    parts = re.split(
        r"^## (\d+)\. (.*)$", PAGE.read_text(encoding="utf-8").partition("\n## Your own")[0], flags=re.MULTILINE
    )
    every, found = iter(steps(PAGE)), []
    first = [next(every) for _ in re.findall(r"^    quadexp", parts[0], re.MULTILINE)]
    for number, title, text in zip(parts[1::3], parts[2::3], parts[3::3], strict=True):
        pictures = re.findall(r"^!\[([^\]]+)\]\(figures/questions/([^)]+)\)$", text, re.MULTILINE)
        assert len(pictures) == text.count("    quadexp ") == 1, f"{title}: one command, one picture"
        found.append(Question(int(number), title, next(every), *pictures[0]))
    return first, found


def needed(words: list[str], before: list[Step]) -> list[Step]:
    """The commands before whose output a command reads, those that these read first."""
    made = {step.words[step.words.index("--out") + 1]: step for step in before}
    read = [made[name] for word in words if (name := word.partition("=")[2] or word) in made]
    return [one for step in read for one in [*needed(step.words[: step.words.index("--out")], before), step]]


def answer(number: int) -> str:
    """Run the command of a question here, after those that it needs; returns what it prints."""
    first, found = questions()
    question = found[number - 1]
    before = [*first, *(one.command for one in found[: number - 1])]
    for step in needed(question.command.words[: question.command.words.index("--out")], before):
        if not Path(step.words[step.words.index("--out") + 1]).exists():
            run(step.program, step.words)
    return run("quadexp", question.command.words)


def store(question: Question) -> None:
    """Keep a small copy of the picture that the command wrote."""
    copy = PICTURES / question.shown
    copy.parent.mkdir(exist_ok=True)
    if copy.suffix == ".gif":
        shutil.copyfile(question.picture, copy)
        return
    image = Image.open(question.picture).convert("RGB")
    image.thumbnail((WIDEST, 2 * WIDEST), Image.Resampling.LANCZOS)
    image.quantize(COLOURS).save(copy, optimize=True)


def main(numbers: list[int]) -> None:
    os.environ.update(environment())
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for question in questions()[1]:
            if not numbers or question.number in numbers:
                answer(question.number)
                store(question)
                print(question.number, question.shown, flush=True)


if __name__ == "__main__":
    main([int(text) for text in sys.argv[1:]])
