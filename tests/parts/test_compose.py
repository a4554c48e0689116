"""Configurations: the quick way composes what Hydra composes, and every mistake is one line that says the mend."""

import hashlib
import json
import textwrap
from dataclasses import FrozenInstanceError

import hydra
import pytest
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from quadexp.errors import UsageError
from quadexp.experiment.identity import digest, flight_entropy
from quadexp.parts.cells import varied
from quadexp.parts.compose import compose, expand, session
from quadexp.parts.options import NOTHING, OptionFiles, groups
from quadexp.parts.part import part_class
from quadexp.parts.schema import BUNDLES, CHOSEN, PARTS, PRESETS, EvaluateConfig, conf_folder
from quadexp.parts.settings import plain, record
from tests.deleted import DELETED, needs

OVERRIDES = [
    ["trajectory=random", "trajectory.speed=12", "seed=7"],
    ["controller=gp_mpc", "controller.nodes=20", "plant=ideal", "plant.lift=0.3"],
    ["collect=default", "collect.duration=60"],
    ["trajectory=hover", "trajectory.position=[1,2,3]", "vehicle.inertia=[[1,0,0],[0,1,0],[0,0,1]]"],
    ["trajectory.radius=${trajectory.speed}", "controller.rate=${vehicle.thrust_max}"],
    ["experiment=torrente_table1"],
    ["experiment=quick", "trajectory=step", "evaluate.metric=rmse"],
]


def hydra_composes(overrides):
    """What Hydra makes of all overrides together, values too, over the defaults of the classes that it chose."""

    def over(defaults, content):
        nested = {k: over(v, content.get(k, {})) for k, v in defaults.items() if isinstance(v, dict)}
        return defaults | content | nested

    for name, entry in OptionFiles().entries.items():
        group, _, option = name.partition("/")
        package = "_global_" if group in BUNDLES else PRESETS.get(group)
        ConfigStore.instance().store(group=group, name=option, node=entry.content, package=package)
    every_group = [*({group: option} for group, option in CHOSEN.items()), "_self_", {"experiment": None}]
    ConfigStore.instance().store(name="every_group", node={"defaults": every_group})
    with hydra.initialize_config_dir(str(conf_folder()), version_base="1.3"):
        options = groups()  # a value that no file states is added, because defaults are those of classes
        given = [text if text.partition("=")[0] in options else f"++{text}" for text in overrides]
        composed = hydra.compose("every_group", overrides=given, return_hydra_config=True)
        chosen = dict(composed.hydra.runtime.choices)
        composed = OmegaConf.to_container(composed)
    for name in ("hydra", *BUNDLES, *PRESETS):
        composed.pop(name, None)
    for group in PARTS:
        composed[group].pop("look", None)
        composed[group].pop("cite", None)
        part = part_class(group, composed[group].pop("_target_"))
        composed[group] = over(plain(part), {"name": chosen[group]} | composed[group])
    whole = over({"evaluate": plain(EvaluateConfig), "model": None, "seed": 0, "sweep": None}, composed)
    whole["world"] = "clean"  # a name, which is made when all is composed
    return OmegaConf.to_container(OmegaConf.create(whole), resolve=True)


@pytest.mark.parametrize("overrides", OVERRIDES, ids=lambda o: " ".join(o) or "defaults")
def test_files_are_joined_as_hydra_joins_them(overrides):
    with session() as composer:
        composer.compose(overrides[:1])
        composed = record(composer.compose(overrides))
        assert composed == record(composer.compose(overrides)) == hydra_composes(overrides)


def test_none_is_a_word_of_every_group_that_can_be_absent():
    """It is what config.yaml takes, whatever its word there is."""
    with session() as composer:
        idle = [name.split("/") for name, entry in OptionFiles().entries.items() if entry.option_file.stem == NOTHING]
        assert len(idle) > (9 if DELETED else 15)
        for group, word in idle:
            assert word == CHOSEN[group]
            assert record(composer.compose([f"{group}=none"])) == record(composer.compose([]))
        assert {cell.config.link.name for cell in composer.expand(["link=none,latency"])} == {"ideal", "latency"}


def test_every_option_of_every_group_composes():
    with session() as composer:
        for group in PARTS:
            for option in composer.options(group):
                extra = {"file": [f"{group}.path=x"], "from_model": ["plant.model=x"]}.get(option, [])
                config = composer.compose([f"{group}={option}", *extra])
                assert isinstance(getattr(config, group), composer.part(group, option))


def test_every_experiment_expands():
    with session() as composer:
        names = composer.options("experiment")
        assert {"quick", "torrente_table1"} <= set(names)
        for name in names:
            composer.compose([f"experiment={name}"])
            assert len(composer.expand([f"experiment={name}"])) > 1


def test_configurations_share_what_nobody_can_change():
    with session() as composer:
        first, second = composer.compose(["seed=1"]), composer.compose(["seed=2"])
    assert first.controller is second.controller
    with pytest.raises(FrozenInstanceError):
        first.controller.nodes = 99
    with pytest.raises(TypeError):
        first.controller.attitude_weight[0] = 99.0


def test_every_file_is_read_once_for_all_cells(monkeypatch):
    read = []
    whole = OptionFiles.read
    monkeypatch.setattr(OptionFiles, "read", lambda files, *name: read.append(name) or whole(files, *name))
    with session() as composer:
        cells = list(composer.expand(["trajectory=circle,lemniscate", "wind=none,gust", "seed=range(20)"]))
    assert len(cells) == 80 and len(read) == len({*read})


class TestExpand:
    def test_the_product_of_all_values(self):
        cells = expand(["trajectory=circle,lemniscate", "trajectory.speed=4,8", "seed=range(3)"])
        assert len(cells) == 12
        found = [(c.config.trajectory.name, c.config.trajectory.speed, c.config.seed) for c in cells]
        assert found[0] == ("circle", 4.0, 0) and found[-1] == ("lemniscate", 8.0, 2) and len(set(found)) == 12

    @pytest.mark.parametrize(
        "option", ["plant=from_model plant.model=models/a", "wind=file wind.path=w.csv", "controller=pid"]
    )
    def test_an_invalid_cell_keeps_the_options_that_do_not_contradict_it(self, option):
        """Also those with a value that they need: its plant and world are those of the cells beside it."""
        words = option.split()
        for order in (words, words[::-1]):
            cells = expand(["trajectory=hover,circle", "trajectory.speed=4,8", *order])
            assert [bool(cell.invalid) for cell in cells] == [True] * 2 + [False] * 2
            for group in ("plant", "wind", "controller"):
                assert len({getattr(cell.config, group) for cell in cells}) == 1
            assert all(cell.refused == {cell.overrides[1]} for cell in cells[:2])

    @needs()
    def test_globs_see_the_options_and_no_schema(self):
        names = [cell.config.controller.name for cell in expand(["controller=glob(*)"])]
        with session() as composer:
            assert sorted(names) == composer.options("controller")
        assert {"gp_mpc", "linear_drag_mpc", "nominal_mpc", "perfect_mpc"} <= set(names) and "schema" not in names

    def test_what_differs_without_a_column_of_its_own_is_kept_with_the_cell(self):
        cells = expand(["controller.nodes=10,20", "controller.horizon=1", "trajectory.speed=4,8"])
        assert set(varied(cells)) == {"controller.nodes=10", "controller.nodes=20"}

    @pytest.mark.parametrize(
        ("grids", "expected"),
        [
            (["controller: nominal_mpc", "controller: nominal_mpc, controller.nodes: 30"], ["nodes=10", "nodes=30"]),
            (
                ["controller: nominal_mpc, seed: 1", "controller: nominal_mpc, controller.nodes: 30"],
                ["nodes=10", "nodes=30"],
            ),
            (
                ["controller: perfect_mpc", "controller: nominal_mpc, controller.nodes: 30"],
                ["", ""],
            ),  # named by a column
            (["controller: geometric", "controller: nominal_mpc, controller.horizon: 1"], ["", ""]),
            (["trajectory: circle", "trajectory: hover, trajectory.duration: 9"], ["", ""]),
        ],
    )
    def test_a_key_that_one_grid_gives_differs_from_the_default_of_the_others(self, tmp_path, grids, expected):
        """So that one controller with two settings is not one column."""
        lines = ["# @package _global_", "sweep:", *(f"  - {{{grid}}}" for grid in grids)]
        (tmp_path / "experiment").mkdir()
        (tmp_path / "experiment" / "mine.yaml").write_text("\n".join(lines) + "\n")
        found = varied(expand(["experiment=mine"], tmp_path))
        assert found == [f"controller.{text}" if text else "" for text in expected]

    def test_a_sweep_may_be_a_list_of_grids(self):
        cells = expand(["experiment=torrente_table1", "seed=0"])
        ideal = [cell for cell in cells if cell.config.plant.name == "ideal"]
        assert ideal and {cell.config.controller.name for cell in ideal} == {"nominal_mpc"}

    @pytest.mark.parametrize(
        ("overrides", "said"),
        [
            (["trajectory.speed=4,-1"], r"trajectory.speed=-1.0: must be in \(0, 60\] m/s"),
            (["trajectory=circle,hover", "trajectory.sped=4,8"], "trajectory.sped: no such key"),
            (
                ["trajectory=circle,hovr", "trajectory.speed=4"],
                "trajectory=hovr: no such trajectory; did you mean hover",
            ),
            (["trajectory=hover", "trajectory.speed=4,8"], "trajectory.speed: no such key"),
            (
                ["controller=nominal_mpc,rls_feedback", "controller.nodes=10,few"],
                "controller.nodes=few: must be a whole",
            ),
        ],
    )
    def test_a_mistake_in_any_cell_stops_the_sweep_before_it_begins(self, overrides, said):
        """A key that no cell has, an option that is none, a value that its key does not allow in any cell."""
        with pytest.raises(UsageError, match=said):
            expand(overrides)

    @needs()
    def test_a_combination_that_contradicts_itself_is_a_cell_that_says_why(self):
        cells = list(expand(["trajectory=circle,hover", "trajectory.speed=4", "seed=0,1"]))
        assert [cell.config.trajectory.name for cell in cells] == ["circle", "circle", "hover", "hover"]
        assert [cell.config.seed for cell in cells] == [0, 1, 0, 1]
        first = [cell.invalid.partition(";")[0] for cell in cells]
        assert first == [""] * 2 + ["trajectory.speed: no such key"] * 2
        made = list(
            expand(["horizon=published,precise", "controller=nominal_mpc,rls_feedback", "controller.nodes=10,20"])
        )
        wrong = [(cell.config.controller.name, bool(cell.invalid)) for cell in made]
        assert wrong == [("nominal_mpc", False)] * 2 + [("rls_feedback", True)] * 2 + wrong[:4]
        assert varied(made)[4] == "horizon=precise controller.nodes=10" == varied(made)[6]


MISTAKES = {
    "trajectory.speed=-3": r"trajectory.speed=-3.0: must be in \(0, 60\] m/s",
    "trajectory.speed=fast": "^trajectory.speed=fast: must be a number$",
    "trajectory.radius=": "^trajectory.radius=: must be a number$",
    "speed=8": r"^speed: no such key; did you mean trajectory.speed\?$",
    "seed=range(1,": "a bracket or quote is left open",
    "trajectory.sped=3": r"trajectory.sped: no such key; did you mean trajectory.speed\?",
    "controler=nominal_mpc": r"controler: no such key; did you mean controller\?",
    "controller=nominalmpc": r"controller=nominalmpc: no such controller; did you mean nominal_mpc\?",
    "controller=zzz": "no such controller; there are: .*linear_drag_mpc, ",
    "experiment=nope": "no such experiment; there are: ",
    "zzzz=3": "zzzz: no such key; there are:",
    "mass=1": r"mass: no such key; did you mean vehicle.mass or truth.mass\?",
    "velocity=[1,0,0]": "did you mean wind.velocity of wind=constant",
    "trajectory.duration=3": "it is a key of trajectory=",
    "evaluate=3": "evaluate=3: holds keys; set one of them, such as evaluate.metric=",
    "seed=${nope}": r"seed: refers to a name that does not exist; a reference is \$\{KEY\}",
    "seed=${seed}": "seed: refers to what cannot be read",
    "+controller=nominal_mpc": "keys can be set .* not added or deleted",
    "~model=x": "keys can be set .* not added or deleted",
    "hydra.job.name=x": "not a key of this program",
    "sweep=1": "not a key of this program",
    "trajectory.speed=4,8": "use `quadexp evaluate --sweep`",
    "trajectory.speed=interval(4,8)": "not a list of values; use commas, range, choice or glob",
    "speed": "expected KEY=VALUE",
    "trajectory.speed=a(b": "or the value has signs that need quotes",
    "trajectory=file": "trajectory.path: has no value; give trajectory.path=VALUE",
    "seed=-1": r"seed=-1: must be in \[0, 4294967295\]",
    "seed=0.5": "^seed=0.5: must be a whole number$",
    "controller.nodes=1": r"controller.nodes=1: must be in \[2, 200\] nodes",
    "controller.attitude_weight=[1,2]": "must be a list of 4 numbers",
    "controller.residual=magic": "must be one of none, plant, .*linear_drag",
    "collect.speed_min=21": "must not exceed collect.speed_max",
    "vehicle.inertia=[[1,2],[3]]": "must be 3 rows of 3 numbers each",
}


@pytest.mark.parametrize("override", MISTAKES)
def test_every_mistake_is_one_line(override):
    with pytest.raises(UsageError, match=MISTAKES[override]) as caught:
        compose([override])
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300
    assert caught.value.exit_code == 2


class TestAlternatives:
    """Controllers with what is around each of them, in one list."""

    def test_each_brings_its_own_settings(self):
        given = "controller=nominal_mpc,dfbc rate_loop=indi rate_loop.cutoff=8,pid adaptive=l1"
        cells = [cell.config for cell in expand([given, "trajectory.speed=4,8"])]
        found = {(c.controller.name, c.rate_loop.name, c.adaptive.name, c.trajectory.speed) for c in cells}
        assert len(cells) == 6 and found == {
            (*names, speed)
            for names in (("nominal_mpc", "none", "none"), ("dfbc", "indi", "none"), ("pid", "none", "l1"))
            for speed in (4.0, 8.0)
        }
        assert {c.rate_loop.cutoff for c in cells if c.rate_loop.name == "indi"} == {8.0}

    def test_of_an_experiment_too(self):
        cells = [cell.config for cell in expand(["experiment=quick", "controller=pid,dfbc rate_loop=indi"])]
        assert {c.controller.name for c in cells} == {"pid", "dfbc"} and len(cells) % 2 == 0

    @pytest.mark.parametrize(
        ("given", "said"),
        [
            ("controller=pid,dfb rate_loop=indi", "controller=dfb: no such controller; did you mean dfbc"),
            ("controller=pid,dfbc iner=indi", "iner: no such key"),
            ("controller=pid,dfbc rate_loop=indy", "rate_loop=indy: no such rate_loop"),
            ("controller=pid,dfbc adaptive=l1", "adaptive is given beside it too"),
        ],
    )
    def test_a_mistake_in_one_of_them_is_one_line(self, given, said):
        with pytest.raises(UsageError, match=said):
            expand([given, "adaptive=none"])


class TestOwnFolder:
    @pytest.fixture
    def folder(self, tmp_path):
        (tmp_path / "trajectory").mkdir()
        (tmp_path / "trajectory" / "mine.yaml").write_text(
            textwrap.dedent(
                """
                defaults: [circle, _self_]
                name: mine
                radius: 7.0
                """
            )
        )
        (tmp_path / "experiment").mkdir()
        (tmp_path / "experiment" / "two.yaml").write_text(
            "# @package _global_\nsweep: {trajectory: 'mine,circle', seed: [0, 1]}\n"
        )
        return tmp_path

    def test_its_options_are_there_beside_ours(self, folder):
        config = compose(["trajectory=mine"], folder)
        assert config.trajectory.name == "mine" and config.trajectory.radius == 7.0
        assert config.trajectory.height == compose([]).trajectory.height
        assert len(expand(["experiment=two"], folder)) == 4
        with pytest.raises(UsageError, match="no such trajectory"):
            compose(["trajectory=mine"])

    @pytest.mark.parametrize(
        ("text", "line"),
        [
            (
                "name: racer\nmass: [1.0\n",
                r"vehicle/racer.yaml, line 3, column 1: not valid YAML: .*expected ',' or '\]'",
            ),
            ("name: racer\n\tmass: 1.0\n", r"vehicle/racer.yaml, line 2, column 1: not valid YAML: found "),
            (b"name: \xff\n", r"vehicle/racer.yaml: not valid YAML: 'utf-8' codec"),
            (
                "name: racer\nmass: 1.0\n",
                "vehicle=racer: its file names no class; let it begin with `_target_: MODULE.CLASS`",
            ),
            ("- name\n", "racer.yaml: must be a mapping"),
            ("", "vehicle=racer: its file names no class"),
            ("defaults: [idle]\n", "vehicle=idle: no such vehicle; there are"),
            ("_target_: quadexp.world.simplified.Simplified\n", "Simplified: is a part of plant, not of vehicle"),
            (
                "_target_: quadexp.physics.vehicle.Vehicle\nname: racer\nmass: 1.0\nrate_max: 9.0\n",
                (
                    "vehicle.inertia, vehicle.rotor_position, vehicle.rotor_spin, vehicle.thrust_max,"
                    " vehicle.thrust_min, vehicle.torque_coefficient: have no value; give each as KEY=VALUE,"
                    " or in the option's file"
                ),
            ),
        ],
    )
    def test_a_file_that_is_wrong_is_one_line_that_names_it(self, tmp_path, text, line):
        (tmp_path / "vehicle").mkdir()
        (tmp_path / "vehicle/racer.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
        with pytest.raises(UsageError, match=line) as caught:
            compose(["vehicle=racer"], tmp_path)
        assert "\n" not in str(caught.value)

    def test_a_missing_one(self, tmp_path):
        with pytest.raises(UsageError, match="no such folder"):
            compose([], tmp_path / "none")


class TestNoise:
    def entropy(self, *overrides):
        return flight_entropy(compose(list(overrides)))

    def test_it_is_the_same_for_every_controller_model_and_back_end(self):
        assert (
            self.entropy("seed=1")
            == self.entropy("seed=1", "controller=gp_mpc", "model=models/x")
            == self.entropy("seed=1", "controller=perfect_mpc", "controller.nodes=20", "controller.backend=interpreted")
            == self.entropy("seed=1", "plant.backend=interpreted", "trajectory.allow_infeasible=true")
        )

    @pytest.mark.parametrize(
        "other", ["seed=2", "trajectory.speed=4", "trajectory=lemniscate", "plant.motor_loss=0.3", "vehicle.mass=1.1"]
    )
    def test_it_is_another_for_whatever_else_differs(self, other):
        assert self.entropy("seed=1") != self.entropy("seed=1", other)

    @needs("logs", "identification")
    @pytest.mark.parametrize("file", ["trajectory=file trajectory.path={}", "plant=from_model plant.model={}"])
    def test_it_is_the_same_in_another_folder(self, file):
        assert self.entropy(*file.format("a/x").split()) == self.entropy(*file.format("/b/x").split())

    def test_hashes_are_the_same_in_every_process_and_version(self):
        assert digest({"b": [1.0, "x"], "a": None}) == hashlib.sha256(b'{"a":null,"b":[1.0,"x"]}').hexdigest()[:20]


def test_a_record_is_json():
    assert json.loads(json.dumps(record(compose([])))) == record(compose([]))
