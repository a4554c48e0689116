"""Whoever shows the numbers of a sweep says whether its flights hold them: edited, lost, and of another sweep."""

import json
import shutil

import pytest

from quadexp.log.cell_store import CellStore
from quadexp.plugins.page.report import make_report
from quadexp.report.checked import check_flights
from quadexp.report.frame import read_results
from tests.cli.command import run
from tests.report.results import make_results

WHO = ("nominal_mpc", "perfect_mpc")  # 48 flights


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    return make_results(tmp_path_factory.mktemp("sound") / "r", controllers=WHO, lost=False)


@pytest.fixture
def results(sound, tmp_path):
    return shutil.copytree(sound, tmp_path / "r")


def edit(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 1
    path.write_bytes(content)


def files(root):
    return sorted(CellStore(root).folder.rglob("*.parquet"))


def test_flights_as_they_were_written(sound):
    checked = check_flights(*read_results(sound)[:2])
    assert (checked.looked, checked.flights, checked.lines()) == (48, 48, [])
    assert checked.text() == "48 of 48 files of flights checked: all hold what the table says"
    assert check_flights(*read_results(sound)[:2], most=10).looked == 10


def test_edited_flights_lost_ones_and_those_of_another_sweep(results):
    edited, gone, other = files(results)[:3]
    edit(edited)
    gone.unlink()
    rows = read_results(results)[1]
    next(row for row in rows if row["key"] == other.stem)["mean_error"] = 0.5
    checked = check_flights(results, rows[:-2])
    assert (checked.unreadable, checked.missing, checked.other) == ([edited.stem], [gone.stem], [other.stem])
    assert checked.beside == 2 and [line.split()[0] for line in checked.lines()] == ["1", "1", "1", "2"]
    assert checked.text() == "46 of 46 files of flights checked: 43 hold what the table says"
    shutil.rmtree(CellStore(results).folder)
    (line,) = check_flights(results, rows).lines()
    assert line.startswith("none of the flights of this table is in its folder")


@pytest.mark.parametrize(
    "words",
    [("results", "r"), ("compare", "r", "r"), ("plot", "r", "--x", "trajectory.speed", "--out", "a.png")],
    ids=lambda words: words[0],
)
def test_every_command_that_shows_them_says_so(results, monkeypatch, words):
    monkeypatch.chdir(results.parent)
    for path in files(results):
        edit(path)
    said = "48 of 48 files of flights that were checked cannot be read, or were edited since they were written"
    code, out, err = run(*words)
    assert code == 0 and said in out + err
    again = [*words, "--force"] if "--out" in words else words
    record = json.dumps(json.loads(run(*again, "--json")[1]))
    assert said in record or "0 hold what the table says" in record


def test_the_page_says_it_where_its_numbers_begin_and_where_they_come_from(results):
    edit(files(results)[0])
    made = make_report(results, results / "a.html")
    (line,) = made["checked"]["lines"]
    assert made["path"].read_text(encoding="utf-8").count(line) == 2
    assert "47 hold what the table says" in made["checked"]["text"]


def test_flights_that_a_figure_leaves_out_are_of_the_same_sweep(sound, tmp_path):
    first = read_results(sound)[1][0]
    for where in (f"controller == {first['controller']}", f"trajectory.speed == {first['speed']}", "seed == 0"):
        code, _, err = run("plot", sound, "--where", where, "--out", tmp_path / "a.png", "--force")
        assert code == 0 and "another sweep" not in err, err
    other = shutil.copytree(sound, tmp_path / "r")
    (CellStore(other).folder / "ab").mkdir(exist_ok=True)
    shutil.copy(files(sound)[0], CellStore(other).path("ab" * 10))
    _, _, err = run("plot", other, "--where", "seed == 0", "--out", tmp_path / "a.png", "--force")
    assert "1 file of flights in this folder belong to another sweep" in err
