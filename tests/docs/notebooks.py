"""Execute the example notebooks; `python -m tests.docs.notebooks [NAME ...]` stores what they then show."""

import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "examples" / "notebooks"
PROGRESS = re.compile(r"\r[^\r\n]*\x1b\[K")
NOTEBOOKS = sorted(path.stem for path in FOLDER.glob("*.ipynb"))


def environment() -> dict[str, str]:
    """Commands of this installation, the checkout's examples, no colours in what is printed, lines of one width."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return {"PATH": path, "PYTHONPATH": str(ROOT), "NO_COLOR": "1", "PY_COLORS": "0", "TERM": "dumb", "COLUMNS": "120"}


def read(name: str) -> Any:
    return nbformat.read(FOLDER / f"{name}.ipynb", 4)


def execute(name: str, folder: Path) -> Any:
    """The notebook with new outputs, executed in `folder`; an error of a cell is raised."""
    notebook = read(name)
    resources = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, timeout=900, resources=resources, record_timing=False).execute()
    return notebook


def without_progress(notebook: Any) -> Any:
    """The notebook as on a quick machine: what a cell prints in one piece, without lines of progress."""
    for cell in notebook.cells:
        kept: list[Any] = []
        for output in cell.get("outputs", ()):
            joined = kept and output.get("name") and kept[-1].get("name") == output.name
            if joined:
                kept[-1].text += output.text
            else:
                kept.append(output)
        for output in kept:
            if output.output_type == "stream":
                output.text = PROGRESS.sub("", output.text)
        if "outputs" in cell:
            cell.outputs = [output for output in kept if output.get("text") != ""]
    return notebook


def main(names: list[str]) -> None:
    os.environ.update(environment())
    for name in names or NOTEBOOKS:
        with tempfile.TemporaryDirectory() as folder:
            nbformat.write(without_progress(execute(name, Path(folder))), FOLDER / f"{name}.ipynb")
        print(name)


if __name__ == "__main__":
    main(sys.argv[1:])
