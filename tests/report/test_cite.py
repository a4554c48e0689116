"""`quadexp show --cite`: the papers of what flew; and the commit of a sweep."""

import re
from pathlib import Path

import pytest

from quadexp.parts.options import OptionFiles
from quadexp.parts.schema import conf_folder
from tests.cli.command import run
from tests.deleted import DELETED, needs

BARE = ("controller.backend=interpreted", "plant.backend=interpreted")
COURSE = ("trajectory=hover", "trajectory.duration=0.3", *BARE)


def keys(text):
    return re.findall(r"^@\w+\{([^,]+),", text, re.MULTILINE)


def test_every_paper_of_an_option_has_an_entry_and_every_entry_is_of_an_option():
    files = OptionFiles()
    cited = {paper for group in files.groups for option in files.options(group) for paper in files.cited(group, option)}
    entries = set(keys((conf_folder() / "references.bib").read_text()))
    assert cited == entries or (DELETED and cited < entries)


def test_every_controller_of_the_literature_states_its_paper():
    files = OptionFiles()
    without = {option for option in files.options("controller") if not files.cited("controller", option)}
    assert without == {"exported", "policy"}.intersection(files.options("controller"))  # whose paper is its user's


@pytest.mark.parametrize(
    ("words", "papers"),
    [
        (("controller=geometric",), {"lee2010", "torrente2021"}),
        (("controller=dfbc", "rate_loop=indi"), {"sun2022", "smeur2016", "torrente2021"}),
        (("controller=nominal_mpc", "adaptive=l1", "wind=dryden"), {"torrente2021", "hanover2022", "milf8785c"}),
    ],
)
@needs()
def test_what_flew_is_cited_and_nothing_else(tmp_path, monkeypatch, words, papers):
    monkeypatch.chdir(tmp_path)
    assert run("simulate", *words, *COURSE, "controller.allow_unstable=true", "--out", "a.parquet")[0] == 0
    code, text, _ = run("show", "--cite", "a.parquet")
    assert code == 0 and set(keys(text)) == papers | {"quadexp"}
    assert text.count("{") == text.count("}")


@needs()
def test_a_sweep_names_who_flew_in_it_and_its_commit(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    own = tmp_path / "own"
    (own / "controller").mkdir(parents=True)
    (own / "controller" / "quick.yaml").write_text('defaults: [pid, _self_]\ncite: "Doe 2026, in preparation"\n')
    (own / "controller" / "plain.yaml").write_text("defaults: [geometric, _self_]\n")
    words = ("--conf", "own", "controller=quick,plain", *COURSE, "--out", "r", "--no-figures")
    assert run("evaluate", "--sweep", *words)[0] == 0
    text = run("show", "--cite", "r")[1]
    assert "note = {Doe 2026, in preparation}" in text and {"lee2010", "torrente2021"} <= set(keys(text))
    assert "meier2015" not in text  # the option that it extends
    if (Path(__file__).parents[2] / ".git").exists():
        assert re.search(r"^table +written .*, commit [0-9a-f]{10}", run("show", "r")[1], re.MULTILINE)
    assert run("show", "--cite", "nowhere")[0] == 2
