"""A column of a table is who flew, a line what was flown: by the recorded settings, whatever their labels."""

import pandas as pd
import pytest

import quadexp as qx
from quadexp.parts.cells import varied
from quadexp.parts.compose import expand
from quadexp.report.frame import SweepFrame, setting_column
from quadexp.report.pairing import condition_of, contestant_of
from quadexp.report.tables import comparison_table
from quadexp.sweeps.sweep import SweepRequest, run_sweep
from tests.cli.command import run
from tests.sweeps.cells import quick_cell
from tests.sweeps.quick import fly

SHORT = ["trajectory=hover", "trajectory.duration=1"]


def written(folder, **files):
    """Options in a user's folder, by "GROUP/NAME"."""
    for name, text in files.items():
        path = folder / f"{name.replace('__', '/')}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


TWO_OF_ONE_NAME = {
    "controllers": (["controller=pid,geometric", "controller.name=ours", *SHORT],
                    ["ours option=pid", "ours option=geometric"]),
    "options of a compensation": (
        ["controller=nominal_mpc", "observer=wind,disturbance", "observer.name=ours", *SHORT],
        ["nominal_mpc+ours option=wind", "nominal_mpc+ours option=disturbance"],
    ),
    "horizons": (["controller=nominal_mpc", "horizon=published,precise"],
                 ["nominal_mpc horizon=published", "nominal_mpc horizon=precise"]),
    "settings of a compensation": (["observer=wind", "observer.wind_walk=1.5,3"],
                             ["nominal_mpc+wind wind_walk=1.5", "nominal_mpc+wind wind_walk=3"]),
}  # fmt: skip


@pytest.mark.parametrize("case", TWO_OF_ONE_NAME)
def test_two_contestants_of_one_name_are_two_columns(tmp_path, case):
    from quadexp.plugins.page.view import view

    overrides, labels = TWO_OF_ONE_NAME[case]
    result = fly(tmp_path / "r", [*overrides, "seed=0,1"])
    assert (
        len({contestant_of(row) for row in result.rows}) == 2 and len({condition_of(row) for row in result.rows}) == 1
    )
    for file in ("table.md", "table.tex"):
        text = (tmp_path / "r" / file).read_text().replace("\\_", "_").replace("\\", "")
        told = [label.split()[-1].partition("=")[2] for label in labels]
        assert all(word in text for word in told)
    assert run("report", tmp_path / "r", "--out", tmp_path / "p.html")[0] == 0
    page = (tmp_path / "p.html").read_text()
    assert all(label in page for label in labels)
    frame = SweepFrame.read(tmp_path / "r")
    shown = view(frame, x="seed")
    assert len({(*panel, *line) for panel in shown.panels for line in shown.lines()}) == 2


@pytest.mark.parametrize(
    "overrides",
    [
        ["trajectory=circle,lemniscate", "trajectory.name=mine"],
        ["vehicle=torrente,hummingbird", "vehicle.name=mine"],
        ["plant=simplified,ideal", "plant.name=mine"],
        ["wind=constant,gust", "wind.name=mine"],
    ],
)
def test_two_worlds_of_one_name_are_two_lines(tmp_path, overrides):
    rows = fly(tmp_path / "r", [*overrides, "seed=0,1"]).rows
    assert len({condition_of(row) for row in rows}) == 2 and len({contestant_of(row) for row in rows}) == 1
    lines = [line for line in (tmp_path / "r/table.md").read_text().splitlines() if line.startswith("| ")]
    assert len(lines) == 5  # heading, rule, flown, and a line each


def test_tuned_remedies_of_two_searches_are_two_columns(tmp_path):
    bundle = "# @package _global_\ndefaults: [override /observer: wind, _self_]\ncontroller: {{nodes: {}}}\n"
    conf = written(tmp_path / "c", remedies__a=bundle.format(8), remedies__b=bundle.format(9))
    rows = run_sweep(
        expand(["controller=nominal_mpc", "remedies=a,b"], conf),
        tmp_path / "r",
        SweepRequest(isolate=False, function=quick_cell),
    ).rows
    assert {contestant_of(row).settings for row in rows} == {"remedies.option=a", "remedies.option=b"}


def test_what_differs_by_recorded_settings_alone_says_which(tmp_path):
    experiment = "# @package _global_\nsweep:\n  - {controller: nominal_mpc}\n  - {controller: heavier}\n"
    own = "defaults: [nominal_mpc, _self_]\nname: nominal_mpc\nposition_weight: [20, 20, 20]\n"
    conf = written(tmp_path / "c", experiment__e=experiment, controller__heavier=own)
    assert varied(expand(["experiment=e"], conf)) == ["", "controller.option=heavier"]
    grids = "# @package _global_\nsweep:\n  - {seed: 0}\n  - {controller.position_weight: '[20,20,20]', seed: 1}\n"
    conf = written(tmp_path / "d", experiment__e=grids)
    assert varied(expand(["experiment=e"], conf)) == [
        "controller.position_weight=[10,10,10]", "controller.position_weight=[20,20,20]",
    ]  # fmt: skip


def test_the_path_of_a_seed_is_no_other_condition():
    assert set(varied(expand(["trajectory=random", "seed=range(3)", "controller=pid,geometric"]))) == {""}


def test_two_horizons_are_tested_against_each_other(tmp_path):
    """They fly the same conditions, so that every one is compared with the baseline of its own horizon."""
    result = fly(tmp_path / "r", ["horizon=published,precise", "controller=nominal_mpc,perfect_mpc", "seed=range(4)"])
    assert {row.seeds for row in result.statistics.rows} == {4}
    assert len({row.setting for row in result.statistics.rows}) == 1
    table = comparison_table(result.statistics.of("mean_error"))
    assert [line[2] for line in table.rows] == ["perfect_mpc horizon=published", "perfect_mpc horizon=precise"]


def test_joined_sweeps_of_other_settings_are_not_averaged(tmp_path):
    """Two tables of the Python API, put together: what was flown decides, as the key of each flight says it."""
    one = ["controller=pid", *SHORT, "evaluate.workers=1"]
    first = qx.sweep(*one, seed=[0, 1], out=tmp_path / "a")
    other = qx.sweep(*one, "controller.position_proportional=[2,2,2]", seed=[0, 1], out=tmp_path / "b")
    again = pd.concat([first, first])
    assert again.table().columns[-1] == "pid"
    assert list(pd.concat([first, other]).table().columns[-2:]) == ["pid", "pid results=2"]


# ---------------------------------------------------------------------------------------------------- values as written
DRAG = "plant.linear_drag=[0.3,0.3,0],[0.3,0,0.3]"


def test_a_vector_is_shown_as_it_was_written(tmp_path):
    """Two of equal length too."""
    from quadexp.plugins.page.view import view

    fly(tmp_path / "r", [DRAG, "seed=0,1"])
    table = (tmp_path / "r/table.md").read_text()
    assert "0.424" not in table and "[0.3,0.3,0]" in table and "[0.3,0,0.3]" in table
    shown = view(SweepFrame.read(tmp_path / "r"), x="plant.linear_drag")
    assert [shown.x.text(value) for value in shown.x.values] == ["[0.3,0.3,0]", "[0.3,0,0.3]"]


@pytest.mark.parametrize(
    ("key", "spellings"),
    [
        ("controller.position_weight", ["[10,10,10]", "[10.0, 10.0, 10.0]", "[1e1,10,10.00]"]),
        ("trajectory.speed", ["10", "10.0", "1e1"]),
        ("controller.cone", ["true", "True"]),
    ],
)
def test_spellings_of_one_value_are_one_condition(key, spellings):
    given = ["controller=rls_feedback"] if key == "controller.cone" else []
    texts = [varied(expand([*given, f"{key}={text},{other}"]))[0] for text in spellings
             for other in ("[1,2,3]" if "[" in text else "3" if text[0] == "1" else "false",)]  # fmt: skip
    assert len(set(texts)) == 1


@pytest.mark.parametrize("value", ["[0.3, 0.3, 0.0]", "[[0.3, 0.3, 0.0], [0.1, 0.0, 0.0]]"])
def test_lists_of_an_experiment_are_those_of_the_command_line(tmp_path, value):
    grid = f"# @package _global_\nsweep:\n  plant.linear_drag: {value}\n"
    conf = written(tmp_path / "c", experiment__e=grid)
    nested = value.startswith("[[")
    if not nested:
        grid = f"# @package _global_\nsweep:\n  plant.linear_drag: '{value}'\n"
        written(tmp_path / "c", experiment__e=grid)
    found = [cell.config.plant.linear_drag for cell in expand(["experiment=e"], conf)]
    assert found == [(0.3, 0.3, 0.0), (0.1, 0.0, 0.0)][: 2 if nested else 1]


def test_null_texts_and_truth_values_of_an_experiment(tmp_path):
    path = written(tmp_path, **{"a, b": "x"}) / "a, b.yaml"
    grid = f"# @package _global_\nsweep:\n  model: [null, '{path}']\n  controller: [geometric]\n  seed: [1, 2]\n"
    conf = written(tmp_path / "c", experiment__e=grid)
    assert {cell.config.model for cell in expand(["experiment=e"], conf)} == {None, str(path)}
    grid = "# @package _global_\nsweep:\n  controller.airmode: [true, false]\n  controller: pid\n"
    conf = written(tmp_path / "d", experiment__e=grid)
    assert {cell.config.controller.airmode for cell in expand(["experiment=e"], conf)} == {True, False}


def test_values_that_look_the_same_in_six_digits_are_written_out():
    texts = ["0.12345678", "0.12345679"]
    assert setting_column("plant.step", texts, ["plant.step"])[1] == {text: text for text in texts}
