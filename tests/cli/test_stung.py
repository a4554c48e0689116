"""Small things that stung: wrong kinds of files, folders for files, a model for a controller that takes none, paths
below the ground, and terminals of few columns."""

import os
import re
from pathlib import Path

import pytest

from quadexp.cli.terminal import fitted
from tests.cli.command import run, run_main
from tests.faults.test_hostile_files import on_a_terminal

QUICK = ("trajectory=hover", "trajectory.duration=0.5", "controller.backend=interpreted", "plant.backend=interpreted")
FLOWN = ("plant=ideal", *QUICK)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with one of each: flight, data set, results, text, table, empty file, empty folder."""
    folder, before = tmp_path_factory.mktemp("made"), Path.cwd()
    os.chdir(folder)
    try:
        assert run("simulate", *FLOWN, "--out", "flight.parquet")[0] == 0
        assert run("collect", "--flight", "flight.parquet", "--out", "data.parquet")[0] == 0
        assert run("evaluate", "--sweep", *FLOWN, "seed=0,1", "--no-figures", "--out", "results")[0] == 0
        Path("text.txt").write_text("hello")
        Path("table.csv").write_text("a,b\n1,2\n")
        Path("nothing").touch()
        Path("folder").mkdir()
        yield folder
    finally:
        os.chdir(before)


COMMANDS = {  # what each takes
    ("show", "FILE"): {"flight.parquet", "data.parquet", "results"},
    ("compare", "flight.parquet", "FILE"): {"flight.parquet"},
    ("compare", "results", "FILE"): {"results"},
    ("report", "FILE", "--out", "page.html", "--force"): {"results"},
    ("export", "FILE", "--to", "csv", "--out", "out.csv", "--force"): {"flight.parquet"},
    ("animate", "FILE", "--out", "a.gif", "--to", "0.1", "--force"): {"flight.parquet"},
    ("results", "FILE"): {"results"},
    ("check", "FILE"): {"flight.parquet"},
    ("identify", "FILE", "--out", "identified", "--force"): {"flight.parquet"},
    ("fit-gp", "FILE", "--out", "gp", "--force"): {"data.parquet"},
    ("fit-drag", "FILE", "--out", "drag", "--force"): {"data.parquet"},
    ("validate", "FILE", "--flights", "flight.parquet"): set(),
    ("collect", "--flight", "FILE", "--out", "d.parquet", "--force"): {"flight.parquet"},
    ("simulate", "controller=linear_drag_mpc", "model=FILE", "--out", "s.parquet", "--force"): set(),
}
FILES = ("flight.parquet", "data.parquet", "results", "text.txt", "table.csv", "nothing", "folder", "absent")


@pytest.mark.parametrize("words", COMMANDS, ids=lambda words: " ".join(words[:2]))
def test_a_file_of_another_kind_is_one_line_and_exit_code_2(made, words):
    for file in FILES:
        if file not in COMMANDS[words]:
            done = run_main(*(word.replace("FILE", file) for word in words))
            assert (done.returncode, done.stdout) == (2, ""), (file, done)
            assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1, (file, done.stderr)


def test_a_folder_of_results_names_its_flights(made):
    code, _, err = run("export", "results", "--to", "csv")
    assert code == 2 and err.startswith("error: results: is a folder, a flight is needed here")
    assert run("animate", "results")[2].startswith("error: results: is a folder, a flight is needed here")
    named = err.split("such as ")[1].split(" (")[0]
    assert "`quadexp results results` lists them" in err
    assert run("export", named, "--to", "csv", "--out", "named.csv")[0] == 0


def test_a_model_for_a_controller_that_takes_none_is_said(made):
    _, _, err = run("simulate", *FLOWN, "model=models/gp", "--out", "a.parquet", "--force")
    assert "note: nominal_mpc takes no model: model=models/gp is not used" in err
    sweep = ("evaluate", "--sweep", *FLOWN, "model=models/gp", "--no-figures", "controller=nominal_mpc,perfect_mpc")
    code, _, err = run(*sweep, "--out", "unused")
    assert code == 0 and "note: nominal_mpc and perfect_mpc take no model" in err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("trajectory=hover", "trajectory.position=[0,0,-1.5]"), "by 1.5 m at t = 0.00 s"),
        (("trajectory=hover", "trajectory.position=[0,0,0]"), ""),
        (("trajectory=hover", "trajectory.position=[0,0,-1]", "ground=cheeseman_bennett", "ground.height=-2"), ""),
    ],
)
def test_a_reference_below_the_ground_is_said(made, words, said):
    quick = ("trajectory.duration=0.5", "controller.backend=interpreted", "plant.backend=interpreted")
    radius = ("ground.rotor_radius=0.1",) if "ground=cheeseman_bennett" in words else ()
    code, _, err = run("simulate", *words, *quick, *radius, "--out", "low.parquet", "--force")
    assert code == 0 and (said in err and "raise trajectory.position" in err if said else "ground" not in err)


@pytest.mark.parametrize("width", [60, 80, 200])
def test_lines_are_broken_at_blanks_and_go_on_below_their_text(width):
    text = "flight      " + " ".join(f"word{i}" for i in range(40))
    lines = fitted(text, width).splitlines()
    assert len(lines) > 1
    assert max(map(len, lines)) <= width
    assert lines[0].startswith("flight      word0") and all(line.startswith(" " * 12 + "word") for line in lines[1:])
    assert " ".join(" ".join(lines).split()) == " ".join(text.split())
    assert fitted("/a/" + "b" * 300, width) == "/a/" + "b" * 300  # a path stays in one piece
    assert fitted("short", width) == "short"


@pytest.mark.parametrize(("width", "command"), [(60, "results"), (80, "show"), (200, "show")])
def test_what_commands_print_fits_the_terminal(made, width, command):
    shown = on_a_terminal(command, made / "results", width=width, patience=600.0)
    lines = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown).replace("\r", "").splitlines()
    assert lines and max(map(len, lines)) <= width, max(lines, key=len)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["evaluate", "--sweep", "seed=range(0)"], "seed=range(0): an empty range leaves nothing to fly"),
        (["evaluate", "--sweep", "experiment=nope"], "no such experiment"),
        (["simulate", "wind.speed=4"], "wind=none has no settings; wind=constant has wind.velocity"),
        (["simulate", "remedy=wind"], "did you mean remedies?"),
        (["simulate", "--out", "x.csv"], "write x.parquet, then quadexp export x.parquet"),
        (["report", "results/none"], "results/none: no such file"),
        (["simulate", "--seed", "3"], "a setting is given without dashes: seed=VALUE"),
        (["simulat"], "No such command"),
        (["simulate", "--ot", "x"], "No such option: --ot"),
        (["fit-gp"], "Missing argument"),
        (["simulate", "controller=nominal_mpc trajectory=circle"], "2 settings within one pair of quotes"),
        (["import", "nothing.csv"], "nothing.csv: no such file or folder"),
        (["import", "nothing.csv", "--log-format", "pdf"], "--log-format pdf: no such format"),
        (["import", "nothing.csv", "--bad-rows", "often"], "'often' is not one of 'refuse', 'drop', 'gap'"),
        (["export", ".", "--to", "csv"], "is a folder, a flight is needed here"),
        (["new", "rotor", "mine", "--to", "parts"], "new rotor: must be one of vehicle, trajectory, plant, model"),
        (["new", "plant", "my-plant", "--to", "parts"], "'my-plant' is not a valid name of a module"),
        (["new", "plant", "../up", "--to", "parts"], "'../up' is not a valid name"),
        (["new", "plant", "class", "--to", "parts"], "'class' is not a valid name"),
        (["new", "plant", "match", "--to", "parts"], "'match' is not a valid name"),
        (["new", "vehicle", "null", "--to", "parts"], "'null' means something else"),
        (["new", "trajectory", "circle", "--to", "parts"], "there is trajectory=circle already"),
        (["new", "model", "linear_drag", "--to", "parts"], "there is controller=linear_drag_mpc already"),
        (["new", "controller", "random", "--to", "parts"], "a Python module random exists"),
        (["new", "model", "theta", "--to", "parts"], "'theta' is used in the code"),
        (["bench", "trajectory=circle"], "trajectory=circle: is not used by bench; it is for"),
        (["bench", "--only"], "nobody takes part"),
        (["bench", "--controller", "nominal_mcp"], "no such controller; did you mean nominal_mpc"),
        (["bench", "--add", "nothing.parquet"], "no such file (made by `quadexp bench`)"),
        (["bench", "--conf", "nowhere"], "no such folder"),
        (["tune", "--flights", "1"], "a trial takes 2 flights, so 4 are needed"),
        (["tune", "--vary", "plant.mass=1..2"], "what is tuned is the controller"),
        (["tune", "controller=rls_feedback,static_feedback"], "one controller is tuned at a time"),
        (["tune", "trajectory=circle", "trajectory.speed=40"], "circle cannot be flown"),
        (["plot", "nowhere"], "nowhere: no such file"),
        (["simulate", "trajectory.speed=30"], "cannot be flown: it takes"),
        (["evaluate", "experiment=quick"], "experiment=quick: is not used by evaluate; add --sweep"),
        (["simulate", "controller=linear_drag_mpc"], "linear_drag_mpc needs a model and none is in models/"),
        (
            ["simulate", "controller=linear_drag_mpc", "model=models/nowhere"],
            "model=models/nowhere: no checkpoint there",
        ),
    ],
)
def test_a_wrong_request_is_one_line_and_exit_code_2_and_nothing_is_done(here, words, message):
    Path("nothing.csv").touch() if "pdf" in words else None
    done = run_main(*words)
    assert done.returncode == 2 and done.stdout == "" and message in done.stderr, done.stderr
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    assert {path.name for path in here.iterdir()} <= {"nothing.csv"}
