"""The example notebooks: executed from empty to end, as a reader would, with the outputs that are stored."""

import base64
import re
from pathlib import Path

import nbformat
import pytest

from tests.docs.notebooks import FOLDER, NOTEBOOKS, PROGRESS, environment, execute, read
from tests.docs.test_commands import LOOSE, alike

LARGEST = 500_000  # bytes of a notebook with its figures
AGAIN = "execute it again: python -m tests.docs.notebooks"


def texts(cell) -> list[str]:
    """Lines that a cell prints, those aside that differ from run to run, and that of who waits on a slow machine."""
    printed = "".join(output["text"] for output in cell.get("outputs", ()) if output["output_type"] == "stream")
    printed = PROGRESS.sub("", printed)
    return [line.strip() for line in printed.splitlines() if line.strip() and not line.strip().startswith(LOOSE)]


def kinds(cell) -> list[list[str]]:
    """What a cell shows beside text: figures, tables."""
    return [sorted(output["data"]) for output in cell.get("outputs", ()) if "data" in output]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_they_are_stored_as_executed_and_small(name):
    notebook = read(name)
    nbformat.validate(notebook)
    assert (FOLDER / f"{name}.ipynb").stat().st_size < LARGEST
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), AGAIN
    assert any("image/png" in shown for cell in code for shown in kinds(cell))
    for cell in code:
        for output in cell.outputs:
            assert output["output_type"] != "error"
            shown = output.get("text", "") + "".join(map(str, output.get("data", {}).values()))
            assert not re.search(r"(^|\s)/(home|root|tmp|Users|work)/|\x1b", shown), shown[:300]
            if "image/png" in output.get("data", {}):
                assert base64.b64decode(output["data"]["image/png"]).startswith(b"\x89PNG")


def executed_again(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In an empty folder; a cell that fails fails the test, and what is printed is what is stored."""
    for variable, value in environment().items():
        monkeypatch.setenv(variable, value)
    stored, made = read(name), execute(name, folder)
    for before, after in zip(stored.cells, made.cells, strict=True):
        assert kinds(before) == kinds(after), (before.source, AGAIN)
        if "passed in" in "".join(texts(before)):
            continue
        assert len(texts(before)) == len(texts(after)), before.source
        for said, printed in zip(texts(before), texts(after), strict=True):
            assert alike(said, printed), (before.source, said, printed, AGAIN)


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_executed_again(name, tmp_path, monkeypatch):
    executed_again(name, tmp_path, monkeypatch)
    assert (tmp_path / "my_parts" / "test_my_control.py").is_file() == (name == "add_a_controller")


def test_these_are_all():
    assert NOTEBOOKS == ["add_a_controller", "compare_controllers", "learn_from_a_log", "sliders"]
