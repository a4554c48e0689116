"""A command refuses what it does not use: every command with every group and key that stands in none."""

import json

import pytest

import quadexp as qx
from quadexp.errors import UsageError
from quadexp.parts.compose import compose, session
from quadexp.parts.options import OptionFiles
from quadexp.parts.reads import is_read
from quadexp.parts.schema import CHOSEN, PARTS, Config
from quadexp.parts.settings import declared, find, shown
from quadexp.plugin import shipped_places
from tests.cli.command import run
from tests.deleted import needs

OF_GP = needs("gaussian_process")
READERS = shipped_places("reads")
SINGLE = {"model": "model=m", "seed": "seed=1"}
EVALUATE = [f"evaluate.{name}={shown(key.default)}" for name, key in declared(find(Config, "evaluate").node).items()]
TEXTS = [*(f"{group}={option}" for group, option in CHOSEN.items()), *SINGLE.values(), *EVALUATE]
WORDS = {
    "simulate": ["simulate"], "evaluate": ["evaluate"], "evaluate --sweep": ["evaluate", "--sweep"], "tune": ["tune"],
    "bench": ["bench"], "collect": ["collect"], "collect --sweep": ["collect", "--sweep"],
    "collect --flight": ["collect", "--flight", "{flight}"], "fit": ["fit", "neural", "no_data"],
    "export-controller": ["export-controller"], "fly": ["fly", "udp:127.0.0.1:9"],
    "validate": ["validate", "m", "--flights", "{flight}"], "show --margins": ["show", "--margins", "{flight}"],
}  # fmt: skip


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    path = tmp_path_factory.mktemp("reads") / "a.parquet"
    qx.simulate("plant=ideal", "trajectory=hover", "trajectory.duration=0.2", out=path)
    return path


@needs()
def test_every_command_is_here_and_every_key_is_read_by_one():
    assert {*WORDS, "qx.controller", "bench --controller", "gymnasium.make"} == {*READERS}
    for text in TEXTS:
        assert any(is_read(text.partition("=")[0], command) for command in READERS), text


@pytest.mark.parametrize("command", [command for command in WORDS if command in READERS])
def test_what_a_command_does_not_use_is_refused(command, flight, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [word.format(flight=flight) for word in WORDS[command]]
    for text in TEXTS:
        key = text.partition("=")[0]
        with session() as composer:
            if is_read(key, command):
                composer.only(command, [text])
                continue
        code, out, err = run(*words, text)
        assert code == 2 and not out, (text, err)
        assert err.startswith(f"error: {text}: is not used by {command}; ") and err.count("\n") == 1, err
        readers = [other for other in READERS if is_read(key, other)]
        advice = "add --sweep" if f"{command} --sweep" in readers else f"it is for {', '.join(readers)}"
        assert err.endswith(f"; {advice}\n"), err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["simulate", "experiment=quick"], "experiment=quick: is not used by simulate; it is for evaluate --sweep"),
        (["simulate", "experiment=torrente_table1"], "is not used by simulate"),
        (["evaluate", "experiment=quick"], "add --sweep"),
        (["collect", "experiment=quick"], "is not used by collect; add --sweep"),
        (["bench", "experiment=sun"], "is not used by bench"),
        (["fit-gp", "x", "experiment=torrente_table1"], "is not used by fit"),
        (["collect", "--flight", "x", "collect.duration=5"], "collect.duration=5: is not used by collect --flight"),
        (["fit-gp", "x", "drag.loss=huber"], "drag.loss=huber: is not used by fit gp; it is for fit linear_drag"),
        (["fit-gp", "x", "seed=3"], "seed=3: is not used by fit"),
        pytest.param(
            ["simulate", "gp.inducing=4,5"], "gp.inducing=4,5: is not used by simulate; it is for fit", marks=OF_GP
        ),
        pytest.param(["simulate", "gp.inducng=4"], "is not used by simulate", marks=OF_GP),
        (["simulate", "nothing.at=4"], "nothing.at: no such key"),
        (["simulate", "speed=4"], "speed: no such key; did you mean trajectory.speed?"),
        (["show", "--margins", "controller=pid", "engine=local"], "engine=local: is not used by show --margins"),
        pytest.param(
            ["bench", "--only", "--controller", "pid experiment=quick"],
            "is not used by bench --controller",
            marks=OF_GP,
        ),
    ],
)
def test_experiments_and_single_keys_too(words, message):
    code, out, err = run(*words)
    assert code == 2 and message in err and err.count("\n") == 1 and not out, err


@needs("gaussian_process", "tune", "margins", "identification")
def test_an_experiment_is_taken_where_some_of_it_is_used(tmp_path):
    folder = tmp_path / "mine" / "experiment"
    folder.mkdir(parents=True)
    (folder / "calm.yaml").write_text("trajectory: {speed: 3.0}\nevaluate: {log_period: 0.1}\ngp: {inducing: 7}\n")
    (folder / "grid.yaml").write_text("sweep: {seed: '0,1', gp.inducing: '7,8'}\n")
    with session(tmp_path / "mine") as composer:
        for command in ("simulate", "evaluate", "evaluate --sweep", "tune", "fit", "show --margins"):
            composer.only(command, ["experiment=calm"])
        for command in ("collect", "validate"):
            with pytest.raises(UsageError, match=f"experiment=calm: is not used by {command}"):
                composer.only(command, ["experiment=calm"])
        with pytest.raises(UsageError, match="gp.inducing=7,8: is not used by evaluate --sweep; it is for fit"):
            composer.only("evaluate --sweep", ["experiment=grid"])
        composer.only("collect", ["experiment=torrente_table1"])  # as `make reproduce` does
        for name in composer.options("experiment"):
            if name != "grid":
                composer.only("evaluate --sweep", [f"experiment={name}"])


@pytest.mark.parametrize(
    ("call", "keywords", "message"),
    [
        pytest.param(qx.simulate, {"gp": "full"}, "gp=full: is not used by simulate", marks=OF_GP),
        (qx.simulate, {"evaluate": {"metric": "rmse"}}, "evaluate.metric=rmse: is not used by simulate"),
        (qx.controller, {"engine": "local"}, "engine=local: is not used by qx.controller"),
        (qx.collect, {"trajectory": "circle"}, "trajectory=circle: is not used by collect"),
        (qx.sweep, {"collect": {"duration": 3}}, "collect.duration=3: is not used by evaluate --sweep"),
        pytest.param(
            lambda **keys: qx.tune(**keys),
            {"controller": "pid", "nn": "default"},
            "nn=default: is not used by tune",
            marks=needs("tune", "laws", "neural"),
        ),
        (lambda **keys: qx.bench(**keys), {"metric": "rmse"}, "evaluate.metric=rmse: is not used by bench"),
        (lambda **keys: qx.fit_drag("x", **keys), {"trajectory": "hover"}, "trajectory=hover: is not used by fit"),
    ],
)
def test_python_refuses_the_same(call, keywords, message):
    with pytest.raises(UsageError, match=message):
        call(**keywords)


def test_every_group_and_key_is_a_keyword():
    """Each is told from a key of the trajectory, also where it chooses for other groups."""
    from quadexp.api import overrides

    for text in TEXTS:
        key, _, value = text.partition("=")
        assert overrides([], {key: value}) == [text]
    flight = qx.simulate(trajectory="hover", duration=0.2, remedies="auto", horizon="precise", motor="none", seed=2)
    assert flight.record["config"]["controller"]["first_node"] == 0.02 and flight.record["seed"] == 2
    assert flight.metrics["controller"] == "nominal_mpc+auto"


CONDITIONAL = [
    (group, option, name, about.setting.when)
    for group in PARTS
    for part, option in {part: option for option, part in OptionFiles().parts(group).items()}.items()
    for name, about in declared(part).items()
    if about.setting.when
]


@pytest.mark.parametrize(("group", "option", "name", "when"), CONDITIONAL)
def test_a_key_is_refused_where_others_leave_it_without_effect(group, option, name, when):
    part = OptionFiles().part_of(group, option)
    other, _, wanted = when.partition("=")
    about, default = declared(part)[other], shown(declared(part)[name].default).replace(" ", "")
    on = wanted or ("true" if about.type is bool else "0.1")
    off = {"null": "m" if about.type is str else "3"}.get(wanted) or (
        next(word for word in about.words if word != wanted) if about.words else "false" if about.type is bool else "0"
    )
    given = [f"{group}={option}", *(["vehicle=lei_li"] if option.endswith("feedback") else [])]
    text = f"{group}.{name}={default}"
    compose([*given, f"{group}.{other}={on}", text])
    with pytest.raises(UsageError, match=rf"{group}.{name}=.*: has no effect with {group}.{other}="):
        compose([*given, f"{group}.{other}={off}", text])


def test_the_length_of_one_flight_bounds_random_paths_too(tmp_path):
    lengths = {}
    for longest in ("null", "3"):
        words = ["plant=ideal", "collect.duration=9", f"collect.flight_duration={longest}", "--json"]
        code, out, err = run(
            "collect", *words, "--save-flights", tmp_path / longest, "--out", tmp_path / f"{longest}.p"
        )
        assert code == 0, err
        lengths[longest] = json.loads(out)["flights"], [qx.load(p)["t"].max() for p in (tmp_path / longest).iterdir()]
    assert lengths["3"] == (3, pytest.approx([3.0, 3.0, 3.0])) and lengths["null"][0] == 2
