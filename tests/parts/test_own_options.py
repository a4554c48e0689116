"""A user's own options come before those that ship, from one folder or from several; a note says what they cover."""

import re

import pytest

import quadexp as qx
from quadexp import messages
from quadexp.errors import ModuleError, UsageError
from quadexp.log.store import read_metadata
from quadexp.parts.compose import compose, expand, session
from quadexp.parts.listing import candidates, listed
from quadexp.parts.options import OptionFiles
from quadexp.parts.schema import CHOSEN, PARTS, PRESETS
from quadexp.parts.settings import declared, record
from tests.cli.command import run
from tests.deleted import needs

QUICK = ("plant=ideal", "trajectory=hover", "trajectory.duration=0.2")
MODULE = "from quadexp.plugins.laws.geometric import Geometric\n\n\nclass {name}(Geometric):\n    pass\n"


@pytest.fixture
def folder(tmp_path):
    """A function that writes an option's file, and returns its folder of configuration."""
    messages.note.cache_clear()

    def write(option, text, name="mine"):
        path = tmp_path / name / f"{option}.yaml"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        return tmp_path / name

    return write


@pytest.fixture
def own_pid(folder):
    """An own class under the name of a shipped controller."""
    mine = folder("controller/pid", "_target_: my_pid_of_a_test.MyPID\n")
    (mine / "my_pid_of_a_test.py").write_text(MODULE.format(name="MyPID"))
    return mine


def number_of(group):
    """An option of a group with a key that holds a number other than 0; None where all are 0."""
    files = OptionFiles()
    for option in (CHOSEN[group], *files.options(group)):
        for key, about in declared(part).items() if (part := files.part_of(group, option)) else ():
            if about.type is float and isinstance(about.default, float) and about.default:
                return group, option, key
    return None


COVERED = [case for group in PARTS if (case := number_of(group))]


@pytest.mark.parametrize(("group", "option", "key"), COVERED)
def test_an_option_of_every_group_comes_first_and_extends_the_one_that_it_covers(group, option, key, folder):
    """As a file and as an entry of an option file."""
    shipped = getattr(compose([f"{group}={option}"]), group)
    value = 0.9 * getattr(shipped, key)
    as_file = folder(f"{group}/{option}", f"defaults: [{option}, _self_]\n{key}: {value}\n")
    as_entry = folder("options/mine", f"{group}:\n  {option}: {{of: {option}, {key}: {value}}}\n", "sheet")
    for place in (as_file, as_entry):
        own = getattr(compose([f"{group}={option}"], place), group)
        assert type(own) is type(shipped) and getattr(own, key) == value != getattr(shipped, key)
        assert {**record(own), key: None} == {**record(shipped), key: None}


@pytest.mark.parametrize("group", PRESETS)
def test_a_preset_is_covered_too(group, folder):
    option, key, value = {"horizon": ("precise", "nodes", 14), "motor": ("lead", "motor_lead", 0.011)}[group]
    mine = folder(f"{group}/{option}", f"{key}: {value}\n")
    assert getattr(compose([f"{group}={option}"], mine).controller, key) == value


def test_bundles_and_experiments_are_covered_too(folder):
    folder("world/race", "defaults:\n  - override /wind: constant\nwind: {velocity: [3, 0, 0]}\n")
    folder("remedies/wind", "defaults:\n  - override /observer: disturbance\n")
    mine = folder("experiment/quick", "trajectory: {speed: 3.0}\n")
    config = compose(["world=race", "remedies=wind", "experiment=quick"], mine)
    assert config.wind.velocity == (3.0, 0.0, 0.0) and config.observer.name == "disturbance"
    assert config.trajectory.speed == 3.0 and config.sweep is None


def test_what_is_chosen_unless_something_else_is_can_be_covered(folder):
    mine = folder("vehicle/torrente", "defaults: [torrente, _self_]\nmass: 1.25\n")
    assert compose([], mine).vehicle.mass == 1.25


def test_what_ships_extends_what_ships_and_what_is_ones_own_ones_own(folder):
    folder("controller/nominal_mpc", "defaults: [nominal_mpc, _self_]\nnodes: 17\n")
    mine = folder("controller/longer", "defaults: [nominal_mpc, _self_]\nhorizon: 1.5\n")
    assert compose(["controller=gp_mpc"], mine).controller == compose(["controller=gp_mpc"]).controller
    assert compose(["controller=longer"], mine).controller.nodes == 17


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"controller/a": "defaults: [b]\n", "controller/b": "defaults: [a]\n"}, "controller=a extends itself"),
        ({"controller/a": "defaults: [a]\n"}, "controller=a extends itself"),
    ],
)
def test_what_covers_nothing_and_extends_itself_is_refused(options, message, folder):
    for option, text in options.items():
        mine = folder(option, text)
    with pytest.raises(UsageError, match=message):
        compose(["controller=a"], mine)


def test_the_first_folder_comes_first_and_extends_the_next(folder):
    first = folder("controller/pid", "defaults: [pid, _self_]\ntilt_limit: 0.9\n", "first")
    second = folder("controller/pid", "defaults: [pid, _self_]\ntilt_limit: 1.1\nthrust_least: 0.3\n", "second")
    both = compose(["controller=pid"], [first, second]).controller
    other = compose(["controller=pid"], [str(second), str(first)]).controller
    assert (both.tilt_limit, both.thrust_least) == (0.9, 0.3) and other.tilt_limit == 1.1
    folder("trajectory/only_here", "defaults: [hover, _self_]\n", "second")
    assert compose(["trajectory=only_here", "controller=pid"], [first, second]).controller == both


def test_it_is_flown_and_said_once_and_a_flight_shows_the_class(own_pid, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    flights = {}
    for words in ((), ("--conf", own_pid)):
        out = tmp_path / f"{len(words)}.parquet"
        code, _, err = run("simulate", "controller=pid", *QUICK, *words, "--out", out)
        notes = [line for line in err.splitlines() if "covers the shipped option" in line]
        assert code == 0 and len(notes) == bool(words), err
        flights[bool(words)] = run("show", out)[1]
    assert notes[0].startswith("note: controller=pid: ") and str(own_pid / "controller" / "pid.yaml") in notes[0]
    assert "class       controller: my_pid_of_a_test.MyPID" in flights[True]
    assert "class       controller: quadexp.plugins.laws.cascade.Cascade" in flights[False]


def test_workers_of_a_sweep_fly_it(own_pid, tmp_path):
    words = ["controller=pid", *QUICK, "seed=0,1", "evaluate.workers=1", "--no-figures", "--conf", own_pid]
    code, _, err = run("evaluate", "--sweep", *words, "--out", tmp_path / "r")
    assert code == 0 and len(re.findall("covers the shipped option", err)) == 1, err
    flights = [read_metadata(path, "flight")["classes"] for path in (tmp_path / "r" / "cells").rglob("*.parquet")]
    assert len(flights) == 2 and {each["controller"] for each in flights} == {"my_pid_of_a_test.MyPID"}


def test_every_way_of_asking_agrees(own_pid, tmp_path):
    """From Python, in a loop that the user steps, in the list of options, in completions."""
    kind = type(compose(["controller=pid"], own_pid).controller)
    flight = qx.simulate(*QUICK, controller="pid", conf=str(own_pid))
    assert flight.record["classes"]["controller"] == f"{kind.__module__}.{kind.__name__}"
    assert type(qx.controller(*QUICK, controller="pid", conf=[own_pid]).controller).__name__ != "CascadeController"
    keys = [record["key"] for record in listed("controller=pid", own_pid)]
    assert "controller.position_bandwidth" in keys and "controller.tilt_limit" not in keys
    assert candidates([], "controller.position_band", own_pid) == ["controller.position_bandwidth="]


@needs("bench")
def test_an_own_option_is_completed_for_the_leaderboard(own_pid):
    from quadexp.plugins.bench.commands import _controllers

    context = type("Context", (), {"params": {"conf": [str(own_pid)]}})
    assert "pid" in _controllers(context, "pi")


def test_own_keys_are_completed(folder):
    mine = folder("controller/gained", "_target_: my_gained_of_a_test.Gained\n")
    gain = "    my_own_gain: float = key(1.0, 'gain')\n"
    text = "from dataclasses import dataclass\nfrom quadexp.parts.settings import key\n" + MODULE.format(name="Gained")
    text = text.replace("class Gained", "@dataclass(frozen=True, kw_only=True)\nclass Gained").replace(
        "    pass\n", gain
    )
    (mine / "my_gained_of_a_test.py").write_text(text)
    assert candidates([], "controller.my_own", mine) == ["controller.my_own_gain="]


def test_what_was_tuned_is_flown_under_the_name_of_a_shipped_option(tmp_path):
    """`tune` writes pid_tuned, which ships too."""
    asked = {"vary": "controller.tilt_limit=0.5..1.5", "flights": 2, "seeds": 1}
    tuned = qx.tune("controller=pid", *QUICK, "evaluate.workers=1", out=tmp_path / "t", **asked)
    assert tuned.choice == "controller=pid_tuned"
    flight = qx.simulate(*tuned.choice.split(), *QUICK, conf=tuned.folder)
    flown = flight.record["config"]["controller"]
    shipped = compose(["controller=pid_tuned"]).controller
    assert flown["position_proportional"] == [0.95, 0.95, 1.0] != list(shipped.position_proportional)


COMMANDS = [
    ("simulate",), ("evaluate",), ("tune",), ("bench",), ("collect",), ("fit-gp", "x"), ("fit-drag", "x"),
    ("fit-nn", "x"), ("identify", "x"), ("validate", "x"), ("import", "x"), ("check", "x"), ("show", "x"), ("options",),
]  # fmt: skip


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_folder_that_is_none_is_refused_by_every_command(words, tmp_path, folder):
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    mine = folder("controller/mine", "defaults: [pid]\n")
    wrong = {"nope": "no such folder", "file": "is a file, not a folder", "empty": "has no options"}
    for name, message in wrong.items():
        for conf in (["--conf", tmp_path / name], ["--conf", mine, "--conf", tmp_path / name]):
            code, out, err = run(*words, *conf)
            assert code == 2 and err == f"error: --conf {tmp_path / name}: {err.partition(f'{name}: ')[2]}", err
            assert message in err and not out


def test_the_same_folder_twice_covers_nothing(folder):
    mine = folder("controller/mine", "defaults: [pid]\n")
    assert [len(each) for each in OptionFiles([mine, str(mine)]).definitions.values()] == [
        len(each) for each in OptionFiles(mine).definitions.values()
    ]
    with session([mine, mine]) as composer:
        assert composer.compose(["controller=mine"]).controller.name == "mine"


def test_a_wrong_option_is_told_to_who_takes_it_and_to_nobody_else(folder):
    """A module that ends Python ended the command without a word; and no key at all was listed beside it."""
    mine = folder("controller/mine", "_target_: ends_of_a_test.Own\n")
    (mine / "ends_of_a_test.py").write_text("raise SystemExit(3)\n")
    folder("controller/other", "_target_: ends_of_a_test.Own\n")
    code, out, err = run("simulate", "--conf", mine, "controller=mine")
    assert code == 2 and "importing ends_of_a_test: ends_of_a_test.py, line 1: SystemExit: 3" in err and not out
    assert "wind.velocity" in {record.get("key") for record in listed("velocity", mine)}


@pytest.mark.parametrize("helper", ["", "from shared_of_a_test import Shared as Own\n"])
def test_a_module_name_of_two_folders_is_refused_unless_it_is_one_text(helper, folder):
    """The option of the second folder flew the class of the first."""
    module = "shared_of_a_test" if helper else "own_of_a_test"
    for name in ("one", "two"):
        place = folder(f"controller/{name}", f"_target_: {name if helper else 'own'}_of_a_test.Own\n", name)
        (place / f"{name}_of_a_test.py").write_text(helper)
        (place / f"{module}.py").write_text(MODULE.format(name="Shared" if helper else "Own"))
    both = [place, place.with_name("one")]
    assert compose(["controller=one"], both).controller.name == "one"
    (place / f"{module}.py").write_text("# another\n" + MODULE.format(name="Shared" if helper else "Own"))
    for option in ("one", "two"):
        with pytest.raises(ModuleError, match=f"the name {module} stands for .*two/{module}.py and for .*one/{module}"):
            compose([f"controller={option}"], both)
        assert compose([f"controller={option}"], place.with_name(option)).controller.name == option


@pytest.mark.parametrize("name", ["2024_01", "1.10", "010", "no", "12:30", "2024-01-05", "1e3"])
def test_a_name_is_what_the_file_says(tmp_path, name):
    """YAML 1.1 reads 202401, 1.1, 8, False, 750, a date; and an option may have such a name."""
    (tmp_path / "controller").mkdir()
    (tmp_path / "experiment").mkdir()
    own = f"defaults: [geometric, _self_]\nname: {name}\nallow_unstable: yes\nrate: 50.0\n"
    (tmp_path / "controller" / f"{name}.yaml").write_text(own)
    (tmp_path / "controller" / "own.yaml").write_text(f"defaults: [{name}, _self_]\n")
    (tmp_path / "experiment" / "both.yaml").write_text(f"sweep: {{controller: [{name}, geometric]}}\n")
    for option in ("own", *([name] if ":" not in name else [])):
        controller = compose([f"controller={option}"], tmp_path).controller
        assert (controller.name, controller.allow_unstable, controller.rate) == (name, True, 50.0)
    if ":" not in name:
        (first, second) = expand(["experiment=both"], tmp_path)
        assert (first.config.controller.name, second.config.controller.name) == (name, "geometric")
