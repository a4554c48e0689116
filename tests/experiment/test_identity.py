"""Edit anything that decides a flight, and exactly the flights that it decides have another key, or another program."""

import importlib
import os
import random
import shutil
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from quadexp import provenance
from quadexp.errors import DataError
from quadexp.experiment import identity
from quadexp.experiment.evaluate import evaluate_cell, fly_one
from quadexp.experiment.identity import flight_identity
from quadexp.parts.compose import compose, expand
from quadexp.sweeps.engine import Task, fly_as_planned
from quadexp.sweeps.plan import plan_cells
from quadexp.sweeps.sweep import run_sweep
from quadexp.sweeps.verify import verify_results
from tests.sweeps.cells import quick_cell
from tests.sweeps.test_dask import make_checkpoint

FILES = {
    "mine.py": """
        from dataclasses import dataclass
        import fake_package
        from base import Base
        from package.inner import SHIFT as MOVED
        from quadexp.parts.settings import key
        GAINS = "gains.csv"
        @dataclass(frozen=True, kw_only=True)
        class A(Base):
            table: str = key("", "a file of mine")
            def build(self, vehicle):
                from late import LENGTH
                return super().build(vehicle)
        @dataclass(frozen=True, kw_only=True)
        class B(A):
            pass
    """,
    "base.py": """
        import helper
        from quadexp.reference.hover import Hover
        class Base(Hover):
            former_kind = ""
            HEIGHT = helper.HEIGHT
    """,
    "helper.py": "HEIGHT = 1.0\n",
    "late.py": "from importlib import import_module\nLENGTH = import_module('called').LENGTH\n",
    "called.py": "LENGTH = 1.0\n",
    "package/__init__.py": "",
    "package/inner.py": "from . import (\n    shift,  # relative\n)\nfrom space.deep import DEEP\nSHIFT = shift.SHIFT\n",
    "package/shift.py": "SHIFT = 0.0\n",
    "space/deep.py": "DEEP = 0.0\n",  # a package without __init__.py
    "gains.csv": "1.0\n",
    "table.csv": "2.0\n",
    "other.py": "from quadexp.reference.hover import Hover\nclass Other(Hover):\n    former_kind = ''\n",
    "plants.py": "from quadexp.world.simplified import Simplified\nclass Heavy(Simplified):\n    former_kind = ''\n",
    "unused.py": "X = 1.0\n",
    "trajectory/mine.yaml": "_target_: mine.A\nduration: 0.2\ntable: {folder}/table.csv\n",
    "trajectory/other.yaml": "_target_: other.Other\nduration: 0.2\n",
    "plant/heavy.yaml": "_target_: plants.Heavy\n",
}
TRAJECTORIES, PLANTS, CONTROLLERS = ("circle", "hover", "mine", "other"), ("ideal", "heavy"), ("pid", "linear_drag_mpc")
GRID = [f"trajectory={','.join(TRAJECTORIES)}", f"plant={','.join(PLANTS)}", f"controller={','.join(CONTROLLERS)}"]
# What is edited -> what a flight has in common whose key changes.
OF_MINE = (
    *("mine.py", "base.py", "helper.py", "late.py", "called.py", "package/__init__.py", "package/inner.py"),
    *("package/shift.py", "space/deep.py", "gains.csv", "table.csv", "trajectory/mine.yaml", "site/fake_package.py"),
)
DECIDED = {name: {"trajectory=mine"} for name in OF_MINE} | {
    "other.py": {"trajectory=other"},
    "trajectory/other.yaml": {"trajectory=other"},
    "plants.py": {"plant=heavy"},
    "plant/heavy.yaml": {"plant=heavy"},
    "drag/model.json": {"controller=linear_drag_mpc"},
    "unused.py": set(),
}


@pytest.fixture
def conf(tmp_path, monkeypatch):
    """A folder of a user's own parts, and a package beside it."""
    folder = tmp_path / "conf"
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(textwrap.dedent(text).lstrip("\n").replace("{folder}", str(folder)))
    (folder / "site").mkdir()
    (folder / "site" / "fake_package.py").write_text("VERSION = 1\n")
    monkeypatch.syspath_prepend(str(folder / "site"))
    monkeypatch.delitem(sys.modules, "fake_package", raising=False)
    make_checkpoint(folder / "drag")
    return folder


def edit(path: Path) -> None:
    """Another content, of the same size and with the same time where the file allows it."""
    state, text = path.stat(), path.read_text()
    if path.suffix == ".yaml":
        text += "yaw: 0.5\n" if path.parent.name == "trajectory" else "step: 0.0005\n"
    elif "1" in text and path.suffix != ".json":
        text = text.replace("1", "3")
    elif path.suffix == ".json":
        text += " "
    else:
        text += "# edited\n"
    path.write_text(text)
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


def keys(conf, grid=GRID) -> dict[tuple[str, ...], str]:
    cells = expand([*grid, f"controller.models=[{conf}/drag]"] if "linear" in str(grid) else grid, conf)
    return {job.cell.overrides[:3]: key for key, job in plan_cells(cells).items()}


@pytest.mark.parametrize("seed", range(3))
def test_exactly_the_flights_that_an_edit_decides_have_another_key(conf, seed):
    """All that can be edited, one after the other in a drawn order."""
    before = keys(conf)
    assert len({*before.values()}) == len(before) == 16
    edits = [*DECIDED]
    random.Random(seed).shuffle(edits)
    for name in edits:
        edit(conf / name)
        after = keys(conf)
        changed = {overrides for overrides in before if before[overrides] != after[overrides]}
        assert changed == {overrides for overrides in before if DECIDED[name] & {*overrides}}, name
        before = after


def error(flight) -> float:
    """Mean distance from the point (0, 0, 1), m."""
    return float(np.linalg.norm(flight.state[:, :3] - (0, 0, 1), axis=1).mean())


def fly(conf, *overrides):
    return fly_one(compose([*overrides, "controller=pid", "plant=ideal", "trajectory.duration=0.2"], conf))


class TestOneProcess:
    """A flight has the code and the files as they are now."""

    def test_a_module_of_the_same_name_in_another_folder(self, tmp_path):
        for name, height in (("a", 1.0), ("b", 4.0), ("a", 1.0)):
            (tmp_path / name / "trajectory").mkdir(parents=True, exist_ok=True)
            (tmp_path / name / "trajectory" / "mine.yaml").write_text("_target_: same_name.Mine\n")
            (tmp_path / name / "same_helper.py").write_text(f"HEIGHT = {height}\n")
            (tmp_path / name / "same_name.py").write_text(
                "from quadexp.reference.hover import Hover\nimport same_helper\nclass Mine(Hover):\n"
                "    def flat_output(self, t):\n"
                "        from quadexp.reference.base import standing\n        import numpy as np\n"
                "        return standing(np.tile((0.0, 0.0, same_helper.HEIGHT), (np.size(t), 1)), 0.0)\n"
            )
            flight = fly(tmp_path / name, "trajectory=mine")
            assert flight.columns["ref_p_z"][0] == height and flight.columns["p_z"][0] == height
