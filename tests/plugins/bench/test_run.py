"""A leaderboard of real flights, short ones: who takes part, and that nothing is flown twice."""

import pytest

from quadexp.errors import UsageError
from quadexp.experiment.evaluate import evaluate_cell
from quadexp.parts.compose import session
from quadexp.plugins.bench import run as bench
from quadexp.plugins.bench.board import read_board
from quadexp.plugins.bench.entries import read_entries
from quadexp.plugins.bench.protocol import read_protocol
from quadexp.plugins.bench.settings import Bench
from quadexp.plugins.tune.preset import write_preset
from tests.plugins.bench.rows import SMALL, small
from tests.plugins.tune.parts import open_loop


def small_protocol(monkeypatch):
    monkeypatch.setattr(bench, "read_protocol", small)


@pytest.fixture
def protocol(monkeypatch):
    """The small protocol in place of the real one."""
    small_protocol(monkeypatch)


class Counted:
    """evaluate_cell, counted."""

    def __init__(self):
        self.flown = 0

    def __call__(self, *arguments):
        self.flown += 1
        return evaluate_cell(*arguments)


def run(out, controllers, conf=None, **options):
    function, asked = Counted(), Bench(**{"only": True, "controllers": controllers, **options})
    made = bench.bench([], asked, out=out, conf=conf, function=function, isolate=False)
    return made, function.flown


ASKED = [
    "neural_mpc",
    "nominal_mpc",
    "nominal_mpc controller.position_weight=[50,50,50]",
    "linear_drag_mpc",
    "open_loop",
]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Folder, configuration folder, leaderboard and flights of five entries."""
    folder = tmp_path_factory.mktemp("bench")
    mine = open_loop(folder / "mine")
    with pytest.MonkeyPatch.context() as monkeypatch:
        small_protocol(monkeypatch)
        return folder / "b", mine, *run(folder / "b", ASKED, mine)


def test_entries_by_name_with_settings_and_from_a_folder_of_the_users_own(protocol, made):
    out, mine, made, flown = made
    asked = ASKED
    assert flown == 5 * 2 * 2  # entries x worlds x seeds
    rows = read_board(out / "leaderboard.parquet")
    assert {row["entry"] for row in rows} == set(asked) and all(row["outcome"] == "ok" for row in rows)
    assert {row["settings"] for row in rows if "weight" in row["entry"]} == {"set by hand"}
    assert {row["model"] for row in rows if row["entry"] == "linear_drag_mpc"} == {str(out / "models/small")}
    assert {row["model"] for row in rows if row["entry"] == "neural_mpc"} == {str(out / "models/small_network")}
    pushed = {row["entry"]: row["mean_error"] for row in rows if row["world"] == "pushed" and row["seed"] == 0}
    assert max(pushed, key=pushed.get) == "open_loop"  # nothing holds it against a force
    assert made.tables["small"].rows[-1][1] == "open_loop"

    _, again = run(out, [*asked, "perfect_mpc"], mine)
    assert again == 4  # only the new one
    both, none = run(out, asked[:1], mine, add=[out / "leaderboard.parquet"])
    assert none == 0 and len({row["entry"] for row in both.rows}) == 6


def test_rows_of_another_contestant_of_the_same_name_are_said_to_be_left_out(protocol, tmp_path):
    run(tmp_path / "a", ["nominal_mpc"])
    (tmp_path / "mine" / "controller").mkdir(parents=True)
    (tmp_path / "mine" / "controller" / "nominal_mpc.yaml").write_text("defaults: [nominal_mpc, _self_]\nnodes: 12\n")
    for conf, said in ((tmp_path / "mine", ["nominal_mpc: flown otherwise in "]), (None, [])):
        made, _ = run(tmp_path / "b", ["nominal_mpc"], conf, add=[tmp_path / "a" / "leaderboard.parquet"])
        assert [note[: len(said[0])] for note in made.notes] == said


def test_a_protocol_without_a_rule_for_networks_flies_none(monkeypatch, tmp_path):
    without = small("\n".join(line for line in SMALL.splitlines() if "network" not in line))
    monkeypatch.setattr(bench, "read_protocol", lambda: without)
    with pytest.raises(UsageError, match=r"neural_mpc has no part in small: v1 \(.*\) has no rule for its model"):
        run(tmp_path / "b", ["neural_mpc"])


def test_fewer_seeds_are_flown_first_and_the_rest_later(protocol, tmp_path):
    made, flown = run(tmp_path / "b", ["nominal_mpc"], seeds=1)
    assert flown == 2 and {(row["seed"], row["size"]) for row in made.rows} == {(0, "quick, 1 seed")}
    with pytest.raises(UsageError, match="is of size quick, 1 seed, not quick: results of different sizes"):
        run(tmp_path / "c", ["perfect_mpc"], add=[tmp_path / "b" / "leaderboard.parquet"])
    made, flown = run(tmp_path / "b", ["nominal_mpc"])
    assert flown == 2 and {(row["seed"], row["size"]) for row in made.rows} == {(0, "quick"), (1, "quick")}


def test_protocols_are_not_mixed(protocol, monkeypatch, tmp_path):
    run(tmp_path / "a", ["nominal_mpc"])
    monkeypatch.setattr(bench, "read_protocol", lambda: small(SMALL.replace("[1,0,0]", "[2,0,0]")))
    with pytest.raises(UsageError, match="results of different protocols are not ranked together"):
        run(tmp_path / "b", ["perfect_mpc"], add=[tmp_path / "a" / "leaderboard.parquet"])
    assert not (tmp_path / "b").exists()


@pytest.mark.parametrize(
    ("controller", "message"),
    [
        ("gpmpc", "no such controller; did you mean gp_mpc"),
        ("nominal_mpc trajectory.speed=3", "trajectory.speed=3: is not used by bench --controller"),
        ("rls_feedback", "has no part in small: .*needs vehicle.rotor"),
        ("", "is empty"),
    ],
)
def test_who_cannot_take_part_is_said_before_anything_is_flown(protocol, tmp_path, controller, message):
    with pytest.raises(UsageError, match=message):
        run(tmp_path / "b", [controller])


def test_settings_that_were_tuned_on_its_own_seeds_are_refused(protocol, tmp_path):
    with session() as composer:
        config = composer.compose(["controller.nodes=12"])
        for name, seeds in (("honest", [1_000_000]), ("peeking", [7, 2])):
            about = {"flights": 40, "seeds": seeds}
            write_preset(tmp_path / "t", composer, {"controller": "nominal_mpc"}, config, about, name)
    made, _ = run(tmp_path / "b", ["honest"], tmp_path / "t")
    assert {row["settings"] for row in made.rows} == {"tuned, 40 flights"}
    with pytest.raises(UsageError, match="controller=peeking: was tuned on seed 2, which the protocol flies"):
        run(tmp_path / "b", ["peeking"], tmp_path / "t")


@pytest.mark.parametrize(
    ("entry", "settings"),
    [
        ("gp_mpc", "as shipped"),
        ("gp_mpc remedies=wind", "set by hand, seeds 0 to 3"),
        ("gp_mpc observer=wind", "set by hand, seeds 0 to 3"),
        ("online_mpc controller.nodes=20", "set by hand, seeds 0 to 3"),
        ("gp_mpc controller.nodes=20", "set by hand"),
        ("gp_mpc remedies=gp_mpc_wind_tuned", "tuned, 360 flights"),
    ],
)
def test_the_table_says_what_was_set_by_hand_and_on_which_seeds(entry, settings):
    with session() as composer:
        (found,) = read_entries([entry], composer, read_protocol())
    assert found.settings == settings


@pytest.mark.parametrize("option", ["gp_mpc", "my_gp_mpc"])
def test_an_option_of_a_users_is_not_as_shipped(option, tmp_path):
    (tmp_path / "controller").mkdir()
    (tmp_path / "controller" / f"{option}.yaml").write_text("defaults: [gp_mpc, _self_]\nnodes: 12\n")
    with session(tmp_path) as composer:
        (found,) = read_entries([option], composer, read_protocol(), tmp_path)
    assert found.settings == "set by hand"


def test_an_entry_of_the_field_that_cannot_fly_somewhere_is_a_note(protocol, monkeypatch, tmp_path):
    monkeypatch.setattr(bench, "field", lambda: ["rls_feedback", "nominal_mpc"])
    made, flown = run(tmp_path / "b", [], only=False)
    assert flown == 4 and len(made.notes) == 1 and made.notes[0].startswith("rls_feedback has no part in small: ")
