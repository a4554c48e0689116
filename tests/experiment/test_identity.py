"""Edit anything that decides a flight, and exactly the flights that it decides have another key, or another program."""

import importlib
import importlib.util
import os
import pickle
import random
import shutil
import sys
import textwrap
from pathlib import Path

import pytest

from quadexp import provenance
from quadexp.errors import DataError, UsageError
from quadexp.experiment import identity
from quadexp.experiment.evaluate import evaluate_cell, fly_one
from quadexp.experiment.identity import flight_identity
from quadexp.log.cell_store import CellStore
from quadexp.log.store import read_flight
from quadexp.parts.compose import compose, expand
from quadexp.sweeps.engine import Task, fly_as_planned
from quadexp.sweeps.plan import plan_cells
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.models.by_hand import make_checkpoint
from tests.sweeps.cells import quick_cell

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
    "package/inner.py": "from . import (\n    shift,  # beside\n)\nfrom space.deep import DEEP\nSHIFT = shift.SHIFT\n",
    "package/shift.py": "FOLDER, FILE = 'tables', 'above.yaml'  # of the folder above\nSHIFT = 0.0\n",
    "package/unused.py": "X = 1.0\n",
    "tables/above.yaml": "x: 1.0\n",
    "tables/unused.yaml": "x: 1.0\n",
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
    *("package/shift.py", "space/deep.py", "tables/above.yaml", "gains.csv", "table.csv", "trajectory/mine.yaml"),
    "site/fake_package.py",
)
DECIDED = {name: {"trajectory=mine"} for name in OF_MINE} | {
    "other.py": {"trajectory=other"},
    "trajectory/other.yaml": {"trajectory=other"},
    "plants.py": {"plant=heavy"},
    "plant/heavy.yaml": {"plant=heavy"},
    "drag/model.json": {"controller=linear_drag_mpc"},
    "unused.py": set(),
    "package/unused.py": set(),
    "tables/unused.yaml": set(),
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


MODULE = """
import numpy as np
from dataclasses import dataclass
from quadexp.reference.base import standing
from quadexp.reference.hover import Hover
import same_helper

@dataclass(frozen=True, kw_only=True)
class A(Hover):
    former_kind = ""

    def flat_output(self, t):
        return standing(np.tile((0.0, 0.0, same_helper.HEIGHT), (np.size(t), 1)), 0.0)

class B(A):
    def flat_output(self, t):
        return standing(np.tile((0.0, 0.0, 9.0), (np.size(t), 1)), 0.0)
"""
SHORT = ["controller=pid", "plant=ideal", "trajectory.duration=0.1", "controller.backend=interpreted"]


def place(folder: Path, height: float, target: str = "same_name.A") -> Path:
    """A folder with a path at a height (m) that a module beside that of its class says."""
    (folder / "trajectory").mkdir(parents=True, exist_ok=True)
    (folder / "trajectory" / "mine.yaml").write_text(f"_target_: {target}\n")
    (folder / "same_name.py").write_text(MODULE)
    (folder / "same_helper.py").write_text(f"HEIGHT = {height}\n")
    return folder


def flown_height(folder: Path) -> float:
    """Of the reference, flown in this process (m)."""
    return float(fly_one(compose(["trajectory=mine", *SHORT], folder)).columns["ref_p_z"][0])


def swept_height(folder: Path, out: Path, trajectories: str = "mine", **options) -> float:
    """Of the reference of `mine` in a sweep, flown by worker processes (m)."""
    result = run_sweep(expand([f"trajectory={trajectories}", *SHORT], folder), out, SweepRequest(workers=1, **options))
    (row,) = (row for row in result.rows if row["trajectory"] == "mine")
    assert row["outcome"] == "ok", row["cause"]
    return float(read_flight(CellStore(out).path(row["key"])).columns["ref_p_z"][0])


class TestOneProcess:
    """What is flown has the code and the files as they are now, in this process as in a worker."""

    def test_modules_of_one_name_in_two_folders(self, tmp_path):
        for name, height in (("a", 1.0), ("b", 4.0), ("a", 1.0), ("a", 2.0)):
            assert flown_height(place(tmp_path / name, height)) == height

    def test_cells_that_are_composed_after_another_session(self, tmp_path):
        one, two = (place(tmp_path / name, height) for name, height in (("a", 1.0), ("b", 4.0)))
        cells = expand(["trajectory=mine", *SHORT], one)
        assert flown_height(two) == 4.0
        assert fly_one(cells[0].config).columns["ref_p_z"][0] == 1.0

    @pytest.mark.parametrize("how", ["edited", "reloaded", "helper reloaded", "class"])
    def test_an_edit_is_flown_by_both_ways(self, tmp_path, how):
        """Also within one tick of the clock and with the same size, by which bytecode would be taken for the text's."""
        folder = place(tmp_path / "mine", 1.0)
        (folder / "__pycache__").mkdir()
        assert flown_height(folder) == swept_height(folder, tmp_path / "r", "hover,mine") == 1.0
        module = sys.modules["same_name"]
        place(folder, 2.0, "same_name.B" if how == "class" else "same_name.A")
        if "reloaded" in how:
            importlib.reload(sys.modules["same_helper"])
            importlib.reload(module if how == "reloaded" else sys.modules["same_helper"])
        expected = 9.0 if how == "class" else 2.0
        assert flown_height(folder) == swept_height(folder, tmp_path / "r", "hover,mine") == expected
        assert sys.modules["same_name"] is module, "which can be reloaded by who has imported it"

    def test_data_that_a_module_reads_when_it_is_imported(self, tmp_path):
        """A worker read them anew, this process did not."""
        folder = place(tmp_path / "mine", 1.0)
        read = "from pathlib import Path\nHEIGHT = float((Path(__file__).parent / 'data' / 'height.txt').read_text())\n"
        (folder / "same_helper.py").write_text(read)
        (folder / "data").mkdir()
        for i, height in enumerate((1.0, 2.0, 3.0)):
            (folder / "data" / "height.txt").write_text(str(height))
            assert flown_height(folder) == height
            if i == 1:  # a folder of data, and one with an option in it
                assert swept_height(folder, tmp_path / "r") == height
                (folder / "data" / "about.yaml").touch()

    def test_results_beside_a_module_decide_nothing(self, tmp_path):
        """Its flights failed: what decides them had changed since the run began."""
        folder = place(tmp_path / "mine", 1.0)
        (folder / "same_helper.py").write_text("HEIGHT = 1.0\nOUT = 'results'\n")
        (folder / "results").mkdir()
        for _ in range(2):
            assert swept_height(folder, folder / "results") == 1.0
        assert len([*(folder / "results" / "cells").glob("*/*.parquet")]) == 1

    def test_a_mistake_while_editing_is_mended(self, tmp_path):
        folder = place(tmp_path / "mine", 1.0)
        assert flown_height(folder) == 1.0
        (folder / "same_helper.py").write_text("HEIGHT = (\n")
        with pytest.raises(UsageError, match="importing same_name: SyntaxError"):
            flown_height(folder)
        assert flown_height(place(folder, 3.0)) == 3.0

    def test_what_is_taken_as_the_truth_is_what_controllers_believe(self, tmp_path):
        step = ["trajectory=step", "trajectory.duration=0.4", "trajectory.step_time=0.1", "plant.backend=interpreted"]
        asked = ["plant=from_model", f"plant.model={tmp_path}/m", "controller=perfect_mpc", *step]
        errors = []
        for drag in (0.3, 1.5):
            make_checkpoint(tmp_path / "m", drag)
            flights = [fly_one(compose([*asked, "controller.backend=interpreted"])) for _ in range(2)]
            errors.append({flight.metadata["row"]["mean_error"] for flight in flights})
        shutil.copytree(tmp_path / "m", tmp_path / "other")
        asked[1] = f"plant.model={tmp_path}/other"
        alone = fly_one(compose([*asked, "controller.backend=interpreted"])).metadata["row"]["mean_error"]
        assert errors[0] != errors[1] == {alone}

    def test_a_wind_that_is_replaced_with_its_size_and_time(self, tmp_path):
        file = tmp_path / "wind.csv"
        asked = ["wind=file", f"wind.path={file}", "trajectory=hover", *SHORT]
        config = compose(asked)
        for speed in (1.0, 8.0, 1.0):
            file.write_text(f"t,wind_x,wind_y,wind_z\n0,{speed},0,0\n")
            os.utime(file, ns=(10**18, 10**18))
            for flight in (fly_one(config), fly_one(compose(asked))):
                assert flight.columns["wind_x"][-1] == speed


class TestSweep:
    def test_an_own_option_beside_a_shipped_one_that_is_edited_is_flown_again_alone(self, tmp_path):
        from quadexp.plugins.archive.verify import verify_results

        folder, cells = place(tmp_path / "mine", 1.0), ["trajectory=hover,mine", *SHORT]
        options = {"isolate": False, "function": quick_cell}
        assert run_sweep(expand(cells, folder), tmp_path / "r", SweepRequest(**options)).flown == 2
        assert run_sweep(expand(cells, folder), tmp_path / "r", SweepRequest(**options)).flown == 0
        place(folder, 2.0)
        assert "same_helper.py" in str(verify_results(tmp_path / "r").wrong)
        assert run_sweep(expand(cells, folder), tmp_path / "r", SweepRequest(**options)).flown == 1
        assert not verify_results(tmp_path / "r").wrong
        (folder / "same_helper.py").unlink()
        assert verify_results(tmp_path / "r").missing == [str(folder / "same_helper.py")]

    def test_a_worker_flies_what_was_planned_or_refuses(self, tmp_path):
        folder = place(tmp_path / "mine", 1.0)
        (job,) = plan_cells(expand(["trajectory=mine", *SHORT], folder)).values()
        packed = pickle.dumps(Task(job.key, job.cell.config, None, str(tmp_path / "f.parquet"), job.inputs))
        assert fly_as_planned(evaluate_cell, packed)["outcome"] == "ok"
        place(folder, 2.0)
        with pytest.raises(DataError, match="trajectory module same_helper: has changed since this run began"):
            fly_as_planned(evaluate_cell, packed)
        place(folder, 1.0)
        assert fly_as_planned(evaluate_cell, packed)["outcome"] == "ok"


class TestPackages:
    def test_only_what_flies_with_it_is_decided_by_a_package(self, monkeypatch, tmp_path):
        """Its weights are others; what is flown in this process has them too."""
        pytest.importorskip("foundation_policy")
        before = keys(None, ["controller=raptor,pid"])
        source = Path(importlib.util.find_spec("foundation_policy").origin).parent
        shutil.copytree(source, tmp_path / "foundation_policy")
        with open(tmp_path / "foundation_policy" / "blob" / "checkpoint.h5", "ab") as file:
            file.write(b"\0")
        spec = importlib.util.spec_from_file_location("x", tmp_path / "foundation_policy" / "__init__.py")
        monkeypatch.setattr("importlib.util.find_spec", lambda name: spec)
        after = keys(None, ["controller=raptor,pid"])
        assert {name for name in before if before[name] != after[name]} == {("controller=raptor",)}

    def test_a_library_decides_what_imports_it(self, monkeypatch):
        programs = {}
        for version in ("1.0", "2.0"):
            monkeypatch.setattr(provenance, "versions", lambda v=version: {"numpy": "1", "minsnap-trajectories": v})
            identity._program.cache_clear()
            for path in ("circle", "random"):
                programs[path, version] = flight_identity(compose([f"trajectory={path}"])).program
        identity._program.cache_clear()
        assert len({*programs.values()}) == 3 and programs["circle", "1.0"] == programs["circle", "2.0"]


SOURCES = {
    "parts/sensor_spec.py": "all",
    "physics/rigid_body.py": "all",
    "experiment/flight.c": "all",
    "report/metrics.py": "all",
    "reference/circle.py": "trajectory=circle",
    "plugins/worlds/dryden.py": "wind=dryden",
    "plugins/laws/cascade.py": "controller=pid",
    "plugins/neural/neural.py": "controller=linear_drag_mpc",  # whose checkpoint says which model reads it
    "experiment/fit.py": "fitted",
    "plugins/drawing/style.py": "",
    "cli/fly.py": "",
    "plugins/cluster/cluster.py": "",
    "plugins/tune/search.py": "",
    "errors.py": "",
}


def test_exactly_the_flights_that_a_source_of_this_program_decides_are_of_another_program(monkeypatch, tmp_path):
    make_checkpoint(tmp_path / "drag")
    asked = [
        (f"trajectory={path}", f"wind={wind}", f"controller={law}", f"controller.models=[{tmp_path}/drag]")
        for path, wind, law in (
            ("circle", "none", "pid"), ("hover", "none", "pid"), ("hover", "dryden", "nominal_mpc"),
            ("hover", "none", "linear_drag_mpc"),
        )
    ]  # fmt: skip
    configs = {text[:3]: compose(text[: 4 if "linear" in text[2] else 3]) for text in asked}
    folder = tmp_path / "quadexp"
    shutil.copytree(provenance.package_folder(), folder, ignore=shutil.ignore_patterns("__pycache__"))

    def programs():
        for cached in (provenance.program_of, provenance.sources, provenance._deciding_modules, identity._program):
            cached.cache_clear()
        flown = {name: flight_identity(config).program for name, config in configs.items()}
        fitted = identity.identity_with(configs[asked[0][:3]], None, fitted=True).digest
        return flown | {("fitted",): fitted}, provenance.sources()

    here = programs()
    monkeypatch.setattr(provenance, "package_folder", lambda: folder)
    monkeypatch.setattr(identity, "package_folder", lambda: folder)
    assert programs() == here, "where it lies decides nothing"
    for name, decided in SOURCES.items():
        before = (folder / name).read_bytes()
        (folder / name).write_bytes(before + b"\n")
        now, sources = programs()
        changed = {text for text in now if now[text] != here[0][text]}
        of_model = {("fitted",)} if decided and not decided.startswith("wind") else set()  # it flew without wind
        assert changed - {("fitted",)} == {text for text in configs if decided == "all" or decided in text}, name
        assert changed & {("fitted",)} == of_model, name
        assert (sources != here[1]) == bool(decided and decided != "fitted"), name
        (folder / name).write_bytes(before)
    monkeypatch.undo()
    programs()


def test_a_cell_is_recalled_if_its_own_sources_are_the_same(tmp_path, monkeypatch):
    """Whatever else of the program has changed since; and not if a library that it was flown with has."""
    options = {"isolate": False, "function": quick_cell}
    cells = expand(["controller=pid", "seed=0,1"])
    run_sweep(cells, tmp_path / "r", SweepRequest(**options))
    with monkeypatch.context() as patch:
        for module in ("sweeps.sweep", "experiment.identity", "experiment.evaluate"):
            patch.setattr(f"quadexp.{module}.sources", lambda: "0123456789ab")
        assert run_sweep(cells, tmp_path / "r", SweepRequest(**options)).flown == 0
    monkeypatch.setattr(identity, "_program", lambda *_: ("of another library", frozenset()))
    with pytest.raises(UsageError, match="2 of its cells were flown by other sources"):
        run_sweep(cells, tmp_path / "r", SweepRequest(**options))
    assert run_sweep(cells, tmp_path / "r", SweepRequest(old="refly", **options)).flown == 2
