"""Every shipped experiment in a reduced size: from its flights to its table, its own figures, and its report."""

import json
import shutil
from dataclasses import replace
from functools import partial

import pytest

from quadexp.experiment import evaluate as flying
from quadexp.experiment.build import unshared
from quadexp.parts.cells import Cells
from quadexp.parts.compose import Composer, session
from quadexp.plugins.drawing.style import Figure
from quadexp.plugins.page import sweep_figures as figures
from quadexp.sweeps import server, sweep
from tests.cli.command import run

DURATION = 0.4  # s of a flight
MOST = 4  # cells of an experiment
with session() as composer:
    EXPERIMENTS = composer.options("experiment")


class Beginning:
    """The first part of a path."""

    def __init__(self, whole):
        self._whole, self.duration = whole, min(DURATION, whole.duration)

    def __getattr__(self, name):
        return getattr(self._whole, name)


@pytest.fixture(scope="module", autouse=True)
def _interpreted():
    """Compiling a form takes longer than its flights of 0.4 s take in CasADi's virtual machine. What is built so is not
    left to other tests."""
    with pytest.MonkeyPatch.context() as changed, unshared():
        changed.setenv("CC", "none")
        yield


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """vehicle -> a checkpoint fitted to one short flight."""
    folder = tmp_path_factory.mktemp("models")
    places = {}
    for vehicle, plant in {"torrente": "simplified", "lei_li": "blade_element", "sun": "sun"}.items():
        data, places[vehicle] = folder / f"{vehicle}.parquet", folder / vehicle
        chosen = [f"vehicle={vehicle}", f"plant={plant}"]
        gp = ["gp=sun" if vehicle == "sun" else "gp=zero_mean", "gp.inducing=2", "gp.holdout=0", "gp.max_iterations=1"]
        assert run("collect", *chosen, "collect.duration=2", "--out", data)[0] == 0
        assert run("fit-gp", data, chosen[0], *gp, "--no-figures", "--out", places[vehicle])[0] == 0
    return places


def first_cells(whole, most):
    """The first cell of every controller and plant of an experiment, a grid for each."""
    first = {}
    for grid in whole.grids:
        axes = {texts[0].partition("=")[0]: texts for texts in grid}
        for controller in axes["controller"]:
            for plant in axes.get("plant", [""]):
                single = {key: texts[:1] for key, texts in axes.items()} | {"controller": (controller,)}
                single |= {"plant": (plant,)} if plant else {}
                first.setdefault((controller, plant), tuple(single.values()))
    return Cells([*first.values()][:most], whole._compose)


@pytest.fixture
def reduced(models, here, monkeypatch, unmeasured):
    """Sweeps of few short flights in this process, which find the models that they name."""
    expand, build = Composer.expand, flying.build_trajectory

    def few(composer, overrides=(), *, check=True):
        cells = first_cells(expand(composer, overrides, check=False), MOST)
        for config in (cell.config for cell in cells):
            for named in filter(None, (config.model, *getattr(config.controller, "models", ()))):
                shutil.copytree(models[config.vehicle.name], named, dirs_exist_ok=True)
        return cells

    monkeypatch.setattr(Composer, "expand", few)
    monkeypatch.setattr(flying, "build_trajectory", lambda *parts: Beginning(build(*parts)))
    monkeypatch.setattr(server, "start_server", lambda preload: None)
    monkeypatch.setattr(sweep, "run_sweep", partial(no_processes, sweep.run_sweep))
    monkeypatch.setattr(Figure, "savefig", lambda figure, file, **_: file.write(b"made, and not drawn"))
    drawn = figures.SweepFigures
    monkeypatch.setattr(figures, "SweepFigures", lambda out, processes, *about: drawn(out, None, *about))
    with unshared():  # a reference of the first part of a path is nobody else's
        yield


def no_processes(run_sweep, cells, out, asked):
    return run_sweep(cells, out, replace(asked, isolate=False))


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_every_experiment_ends_with_its_table_and_its_report(experiment, reduced):
    words = ["evaluate", "--sweep", f"experiment={experiment}", "--out", "r"]
    code, out, err = run(*words, "--json")
    assert code == 0, err
    answer = json.loads(out)
    assert answer["rows"] and not answer["not_flown"], err
    assert {row["outcome"] for row in answer["rows"]} <= {"ok", "left_corridor"}
    for looked in ([*words, "--no-figures"], ["report", "r", "--out", "r.html"], ["results", "r"]):
        code, out, err = run(*looked)
        assert code == 0 and "r" in out, err


def test_every_experiment_that_says_how_to_collect_collects(here):
    with session() as composer:
        usual = composer.compose([])
        of_data = [
            name
            for name in EXPERIMENTS
            if (config := composer.compose([f"experiment={name}"])).collect != usual.collect
            or (config.vehicle, config.plant) != (usual.vehicle, usual.plant)
        ]
    assert of_data
    for name in of_data:
        code, out, err = run("collect", f"experiment={name}", "collect.duration=2", "--out", f"{name}.parquet")
        assert code == 0 and f"{name}.parquet" in out, err
