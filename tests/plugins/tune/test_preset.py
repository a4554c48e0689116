"""What was found, as options: they fly what was found, and say where it comes from."""

import shutil

import pytest

from quadexp.errors import UsageError
from quadexp.log.store import read_metadata, read_table
from quadexp.parts.compose import compose, session
from quadexp.parts.former import GROUPS
from quadexp.parts.options import OptionFiles
from quadexp.parts.schema import REMEDIES
from quadexp.parts.settings import record
from quadexp.plugins.tune.api import Tuning
from quadexp.plugins.tune.call import fingerprint, tune
from quadexp.plugins.tune.preset import options_of, provenance_of, read_provenance, write_preset
from quadexp.plugins.tune.search import FIRST_SEED
from quadexp.plugins.tune.settings import Tune
from tests.docs.commands import ROOT
from tests.plugins.tune.parts import HOVER, WeightCell

GIVEN = [*HOVER, "controller=perfect_mpc", "horizon=precise", "controller.rate=100"]
WEIGHT = "controller.position_weight=1..1000:log"


@pytest.fixture(scope="module")
def tuned(tmp_path_factory):
    out = tmp_path_factory.mktemp("tuned") / "t"
    return out, weighed(out)


def weighed(out):
    return tune(GIVEN, Tune(vary=(WEIGHT,), flights=9), out=out, function=WeightCell(), isolate=False)


def test_the_option_flies_what_was_found(tuned):
    """With the horizon and the rate that it was tuned with, and without them being given again."""
    out, found = tuned
    (weight,) = found.trials[found.best].numbers
    own = compose(["controller=perfect_mpc_tuned"], out).controller
    wanted = compose(
        ["controller=perfect_mpc", "horizon=precise", "controller.rate=100",
         f"controller.position_weight=[{weight},{weight},{weight}]"]
    ).controller  # fmt: skip
    assert record(own) == record(wanted) | {"name": "perfect_mpc_tuned"}


def test_the_budget_is_counted_in_flights(tuned):
    out, found = tuned
    assert len(found.trials) == 4 and found.record["flights"] == 8  # of two flights each: nine pay four trials
    columns, _ = read_table(out / "history.parquet", "tuning")
    assert columns["flights"].tolist() == [2, 4, 6, 8] and columns["trial"].tolist() == [0, 1, 2, 3]
    assert columns["best"].tolist() == [min(columns["value"][: k + 1]) for k in range(4)]
    assert read_metadata(out / "history.parquet")["request"]["space"] == [WEIGHT]
    assert (out / "history.svg").is_file()


@pytest.mark.parametrize("order", [[0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]])
def test_the_best_trial_is_the_same_however_the_table_is_sorted(tuned, order):
    out, found = tuned
    for attrs in ({}, {"best": found.best}):
        table = Tuning.of(*read_table(out / "history.parquet", "tuning"), out)
        table.attrs |= attrs
        table = table.iloc[order]
        assert table["trial"].iloc[table.best] == found.best
    with pytest.raises(UsageError, match="not among these rows"):
        _ = table[table["trial"] != found.best].best


def test_where_it_comes_from_stands_in_its_file(tuned):
    about = provenance_of("perfect_mpc_tuned", tuned[0])
    assert about and all(tuned[1].record[key] == value for key, value in about.items())
    assert about["seeds"] == [FIRST_SEED, FIRST_SEED + 1]
    assert provenance_of("perfect_mpc", tuned[0]) is None and read_provenance("name: x\n") is None


def test_the_same_search_writes_the_same_bytes(tuned, tmp_path):
    out = tuned[0]
    shutil.copytree(out, tmp_path / "u", ignore=shutil.ignore_patterns("search.json", "*.yaml"))
    weighed(tmp_path / "u")
    option = "controller/perfect_mpc_tuned.yaml"
    assert (out / option).read_bytes() == (tmp_path / "u" / option).read_bytes()


def test_settings_below_settings(tmp_path):
    with session() as composer:
        config = composer.compose(["controller=rls_mpc", "controller.rls.noise=0.5", "controller.nodes=15"])
        options = {"controller": "rls_mpc"}
        option, path = write_preset(tmp_path, composer, options, config, {"flights": 7}, "mine")
    assert option == "controller=mine" and read_provenance(path.read_text()) == {"flights": 7}
    assert record(compose([option], tmp_path).controller) == record(config.controller) | {"name": "mine"}


@pytest.mark.parametrize(
    "given",
    [
        ["controller=gp_mpc", "observer=wind", "observer.wind_walk=3"],
        ["controller=dfbc", "rate_loop=indi", "controller.position_gain=[7,7,9]"],
        ["controller=nominal_mpc", "remedies=offset_free", "observer.force_bandwidth=2", "adaptive=l1"],
    ],
)
def test_a_controller_and_its_remedies_are_one_bundle(given, tmp_path):
    """It flies what was found, in one composition and as a cell of a sweep, whatever was chosen before."""
    with session() as composer:
        config = composer.compose([*given, "controller.rate=150"])
        options = options_of(given, config)
        choice, path = write_preset(tmp_path, composer, options, config, {"flights": 7}, "mine")
    assert choice == f"{given[0]} remedies=mine"
    groups = ("controller", *REMEDIES)
    wanted = [record(getattr(config, group)) for group in groups]
    own = compose(choice.split(), tmp_path)
    assert [record(getattr(own, group)) for group in groups] == wanted
    with session(tmp_path) as composer:
        swept = composer.expand([*choice.split(), "world=clean,only_wind"])
        assert [[record(getattr(cell.config, group)) for group in groups] for cell in swept] == [wanted] * 2


def test_what_is_called_as_a_shipped_option_comes_before_it(tmp_path):
    """Flown and read alike: the one that is composed is the one whose provenance counts."""
    with session() as composer:
        config = composer.compose(["controller.nodes=12"])
        write_preset(tmp_path, composer, {"controller": "nominal_mpc"}, config, {"flights": 7})
    assert compose(["controller=nominal_mpc_tuned"], tmp_path).controller.nodes == 12
    assert provenance_of("nominal_mpc_tuned", tmp_path) == {"flights": 7}


SHIPPED = [tuple(name.split("/")) for name in sorted(OptionFiles().entries) if name.endswith("_tuned")]
PLACE = (
    "controller",
    "model",
    "vehicle",
    "plant",
    "sensor",
    *GROUPS,
    *REMEDIES,
)  # Lei & Li's are tuned on their vehicle


@pytest.mark.parametrize(("group", "option"), SHIPPED)
def test_shipped_tunings_come_from_the_history_beside_them(group, option):
    about = provenance_of(option, group=group)
    columns, meta = read_table(ROOT / "docs" / "tuned" / f"{option}.parquet", "tuning")
    names = [text.partition("=")[0] for text in meta["request"]["space"]]
    trials = [[float(columns[name][i]) for name in (*names, "value")] for i in range(len(columns["trial"]))]
    assert about and about["trials"] == fingerprint(trials) and about["space"] == meta["request"]["space"]
    best = min(range(len(trials)), key=lambda i: trials[i][-1])
    assert about["tuned"].endswith(f"trial {best}")
    choice = [f"{group}={option}"] if group == "controller" else [about["cells"][0], f"{group}={option}"]
    config = compose(choice)
    for name, value in zip(names, trials[best], strict=False):
        own = config
        parts = name.split(".")
        for part in parts if parts[-1] not in ("xy", "z") else parts[:-1]:
            own = own[part] if isinstance(own, dict) else getattr(own, GROUPS.get(part, part))
        at = 0 if parts[-1] == "xy" else next((i for i, x in enumerate(own) if x), 0) if isinstance(own, tuple) else 0
        at = 2 if parts[-1] == "z" else at
        assert (own[at] if isinstance(own, tuple) else own) == value


def test_shipped_tunings_had_the_same_budget_and_cells():
    """But for the controller and where it can fly, and for what of the budget did not pay a whole trial."""
    abouts = [provenance_of(option, group=group) for group, option in SHIPPED]
    cells = {tuple(text for text in about["cells"] if text.partition("=")[0] not in PLACE) for about in abouts}
    assert len(cells) == 1 and len({about["flights"] for about in abouts}) == 1
