"""The report as a file: what it says, how large it is, what it would load. Nothing here needs a browser."""

import re
import shutil
from html.parser import HTMLParser

import pytest

from quadexp.errors import UsageError
from quadexp.log.store import read_table
from quadexp.plugins.page.report import make_report
from quadexp.plugins.page.report.answer import answer
from quadexp.plugins.page.report.panels import swept_section
from quadexp.plugins.page.report.sections import sweep_command
from quadexp.plugins.page.report.source import read_comparison
from quadexp.plugins.page.view import automatic
from quadexp.report.frame import SweepFrame
from quadexp.report.metrics import from_columns
from quadexp.report.tables import error_table
from quadexp.report.text import typeset
from tests.report.results import ERRORS, make_results, many_results
from tests.report.sweeps import noise, swept

METRICS = {"mean_error", "rmse", "max_error"}
BARE = re.compile(r"[\s*()]")  # what is set differently on the page and in the terminal
VOID = {"meta", "link", "input", "img", "br", "path", "use", "circle", "polyline"}


class Page(HTMLParser):
    """Cells of the tables, attributes that load something, and whether every element is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables: dict[str, list[list[str]]] = {}
        self.loads: list[str] = []
        self.ids: list[str] = []
        self.open: list[str] = []
        self._table: list[list[str]] | None = None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.loads += [given[name] for name in ("src", "href", "xlink:href", "action") if given.get(name)]
        self.ids += [given["id"]] if "id" in given else []
        if tag not in VOID:
            self.open.append(tag)
        if tag == "table" and "data-table" in given:
            self._table = self.tables[given["data-table"]] = []
        if self._table is not None and tag == "tr":
            self._table.append([])
        if self._table and tag in ("td", "th"):
            self._table[-1].append("")

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        if tag in VOID:
            return
        assert self.open.pop() == tag
        if tag == "table":
            self._table = None

    def handle_data(self, data):
        if self._table and self._table[-1]:
            self._table[-1][-1] += data


@pytest.fixture(scope="module")
def made(results, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    return make_report(results, folder / "report.html", figures=folder / "figures")


@pytest.fixture(scope="module")
def text(made):
    return made["path"].read_text(encoding="utf-8")


def test_one_file_under_two_megabytes_that_loads_nothing(made, text):
    assert made["bytes"] == made["path"].stat().st_size < 2_000_000
    page = Page(text)
    assert page.open == []  # well formed
    assert [url for url in page.loads if not url.startswith(("#", "data:"))] == []
    assert not re.search(r"@import|url\((?!['\"]?(#|data:))", text)
    assert not re.search(r"\bfetch\(|XMLHttpRequest|WebSocket|import\(", text)
    assert len(page.ids) == len(set(page.ids))


@pytest.fixture(scope="module")
def sure(tmp_path_factory):
    """Results of ten seeds, which can tell three contestants apart."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tests.report.results.SEEDS", range(10))
        return make_results(tmp_path_factory.mktemp("sure") / "results")


def test_the_answer_comes_from_the_numbers(sure, tmp_path):
    made, comparison = make_report(sure, tmp_path / "report.html"), read_comparison(sure)
    first, second = made["answer"]
    pooled = comparison.overall["gp_mpc"]
    expected = 100 * (1 - ERRORS["gp_mpc"] / ERRORS["nominal_mpc"])  # 95 %, the same noise for both
    assert pooled.reduction == pytest.approx(expected, abs=0.01)
    assert first.startswith(
        "Completed flights: perfect_mpc, gp_mpc and nominal_mpc 40 of 40, linear_drag_mpc 39 of 40."
    )
    over = "the 36 to 40 flights that it and each other completed"  # linear_drag_mpc lost one, which leaves out a seed
    assert f"Least over {over}, oracles aside: gp_mpc, the best of 3" in first
    assert typeset(f"Knowing the aerodynamics: {pooled.text()}.") in first, "the sentence below the tables, with its p"
    assert re.search(r"The error of gp_mpc is 1\.33 times \[.*\] that of perfect_mpc\.$", first)
    assert second.startswith("It runs in real time") and "50.0\u202fµs" in second and "20\u202fms" in second
    assert "1 of 160 flights were not completed (lost)" in made["note"] and "paired permutation test" in made["note"]


@pytest.mark.parametrize(("controller", "credited"), [("gp_mpc", True), ("geometric", False), ("gp_mpc+wind", False)])
def test_only_what_knows_the_air_and_differs_in_nothing_else_is_credited(tmp_path, monkeypatch, controller, credited):
    monkeypatch.setattr("tests.report.results.ERRORS", {"nominal_mpc": 0.04, controller: 0.002})
    monkeypatch.setattr("tests.report.results.SEEDS", range(10))
    monkeypatch.setattr("tests.report.results.TIMES", {"nominal_mpc": 2e-5, controller: 2e-5})
    made = answer(read_comparison(make_results(tmp_path / "r", controllers=("nominal_mpc", controller), lost=False)))
    assert ("aerodynamics" in made.gain) == ("aerodynamics" in made.question) == credited
    assert "less than nominal_mpc" in made.gain and "95.0" in made.gain


def test_the_numbers_on_the_page_are_those_of_the_table(text, results):
    columns, _ = read_table(results / "results.parquet", "results")
    rows = from_columns(columns)
    tables = Page(text).tables
    assert set(tables) > METRICS
    for metric in METRICS:
        cells, table = tables[metric], error_table(rows, metric)
        assert len(cells) == len(table.rows)
        for line, row in zip(cells[1:], table.rows[1:], strict=True):
            assert [BARE.sub("", text) for text in line] == [BARE.sub("", text) for text in row]


def test_a_lost_flight_is_counted_and_stands_first_among_the_worst(text):
    worst = text[text.index('<section id="worst"') :]
    assert worst.index("lost: 10.2 m from the reference") < worst.index("nominal_mpc")
    assert "1 lost" in text


def test_provenance_lets_every_figure_be_made_again(text, results):
    assert "sha256" in text and "some cpu" in text
    assert "quadexp evaluate --sweep trajectory=circle,lemniscate trajectory.speed=4,8" in text
    assert str(results.parent) not in text  # a page that travels names no folder of this machine
    assert "quadexp simulate trajectory=lemniscate trajectory.speed=8 controller=linear_drag_mpc seed=3" in text


def test_commands_of_sweeps():
    one = [((("a=1", "a=2")), ("seed=0",))]
    assert sweep_command(one, "results/x") == "quadexp evaluate --sweep a=1,2 seed=0 --out results/x"
    named = [(("experiment=e",), ("a=1",)), (("experiment=e",), ("b=2",))]
    assert sweep_command(named, "results/x") == "quadexp evaluate --sweep experiment=e --out results/x"
    assert sweep_command([], "results/x") == ""


def test_the_same_results_give_the_same_page(results, text, tmp_path):
    again = make_report(results, tmp_path / "report.html", figures=tmp_path / "figures")
    assert again["path"].read_text(encoding="utf-8") == text


@pytest.mark.parametrize("controllers", [("gp_mpc",), ("nominal_mpc",), ("perfect_mpc", "linear_drag_mpc")])
def test_results_without_a_baseline_or_a_rival(tmp_path, monkeypatch, controllers):
    monkeypatch.setattr("tests.report.results.SEEDS", range(2))
    made = make_report(make_results(tmp_path / "few", controllers=controllers, lost=False), tmp_path / "report.html")
    assert all(sentence.endswith(".") and "nan" not in sentence for sentence in made["answer"])


def test_absent_cells_leave_the_numbers(results, tmp_path):
    root = shutil.copytree(results, tmp_path / "some", ignore=shutil.ignore_patterns("??"))
    text = make_report(root, tmp_path / "report.html")["path"].read_text(encoding="utf-8")
    assert Page(text).tables["rmse"]


def test_a_large_page_says_what_it_leaves_out(tmp_path, monkeypatch):
    monkeypatch.setattr("quadexp.plugins.page.report.MOST_LINES", 10)
    made = make_report(many_results(tmp_path / "many", 20, seeds=8), tmp_path / "report.html")
    text = made["path"].read_text(encoding="utf-8")
    assert len(Page(text).tables["mean_error"]) == 1 + 10
    assert made["left_out"][0] == "10 of 20 lines of the tables"
    assert all(text.count(entry) == 2 for entry in made["left_out"]), "where the page begins and where it comes from"
    assert "gp_mpc: 95.0" in made["answer"][0], "the answer is made from all of them"


@pytest.mark.slow  # half a minute
def test_a_thousand_conditions_make_a_small_page(tmp_path):
    made = make_report(many_results(tmp_path / "many", 1000, seeds=8), tmp_path / "report.html")
    assert made["bytes"] == made["path"].stat().st_size < 2_000_000


def test_of_many_flights_some_are_looked_at_and_tables_are_complete(tmp_path, monkeypatch):
    """The work is bounded: so many files are read, whatever the number of flights."""
    root, read = many_results(tmp_path / "many", 1, seeds=300), []

    def counted(reader):
        return lambda path, *words, **options: read.append(path) or reader(path, *words, **options)

    for place in (
        "report.frame.read_metadata",
        "plugins.page.report.source.read_record",
        "plugins.page.report.source.read_flight",
    ):
        room, _, name = place.rpartition(".")
        module = __import__(f"quadexp.{room}", fromlist=[name])
        monkeypatch.setattr(module, name, counted(getattr(module, name)))
    made = make_report(root, tmp_path / "page.html")
    text = made["path"].read_text(encoding="utf-8")
    assert len(read) < 1000 and made["bytes"] < 2_000_000
    assert text.count("300 of 300") >= 4 and "1200 flights" in text, "every flight is in the tables"
    assert "settings of flights beyond 400 of 1200, evenly chosen" in made["left_out"]


class TestSwept:
    """The figures over what was swept are those of `quadexp plot` without keys."""

    TWO = ("controller=nominal_mpc,perfect_mpc", "controller.nodes=5,10,20", "truth.mass=1,1.1,1.2", "seed=0,1")

    @pytest.fixture(scope="class")
    def two(self, tmp_path_factory):
        def error(config):
            lost = (config.controller.name, config.controller.nodes, config.seed) == ("nominal_mpc", 5, 1)
            return None if lost else 0.2 / config.controller.nodes * config.truth.mass * (1 + 0.1 * noise(config.seed))

        return swept(tmp_path_factory.mktemp("swept") / "two", list(self.TWO), error)

    def test_two_keys_are_lines_in_panels_and_a_map_for_every_quantity(self, two, tmp_path):
        section, left_out, views = swept_section(read_comparison(two))
        assert [view.kind for view in automatic(SweepFrame.read(two))] == [view.kind for view in views]
        assert [block.tab for block in section.blocks] == ["mean_error", "rmse", "max_error", "success"]
        assert not left_out
        assert all(figure.count("<img alt=") == 1 for block in section.blocks for figure in block.figures)
        assert [len(block.figures) for block in section.blocks] == [2] * 4
        made = make_report(two, tmp_path / "report.html", figures=tmp_path)
        lines = {f"mean_error_against_nodes_mass_{mass}" for mass in ("1", "1.1", "1.2")}
        maps = {f"mean_error_map_of_nodes_and_mass_{name}" for name in ("nominal_mpc", "perfect_mpc")}
        assert set(made["figures"]) == lines | maps
        for path in made["figures"].values():  # a column of the IEEE, 252 pt, in the letters of a paper
            content = path.read_bytes()
            assert (
                re.search(rb"/MediaBox \[ ?0 0 252 ", content)
                and b"STIXGeneral" in content
                and b"/Type3" not in content
            )

    def test_what_has_too_many_marks_is_a_picture_and_what_has_no_room_is_said(self, two, monkeypatch):
        comparison = read_comparison(two)
        monkeypatch.setattr("quadexp.plugins.page.report.panels.tabled", tuple)  # the mean error and success
        monkeypatch.setattr("quadexp.report.style.LARGEST_DRAWING", 1000)
        blocks = swept_section(comparison)[0].blocks
        assert all("data:image/png" in figure for block in blocks for figure in block.figures)
        monkeypatch.setattr("quadexp.plugins.page.report.panels.BUDGET", len(blocks[0].figures[0]) + 10)
        section, left_out, _ = swept_section(comparison)
        assert [len(block.figures) for block in section.blocks] == [1] and len(left_out) == 3
        assert left_out[0] == "mean error (mm) map of nodes and mass, which `quadexp plot` draws"


def test_refusals(results, tmp_path):
    with pytest.raises(UsageError, match="no such file"):
        make_report(tmp_path / "nothing", tmp_path / "report.html")
    with pytest.raises(UsageError, match="did not fly here"):
        make_report(results, tmp_path / "report.html", baseline="rls_mpc")
    (tmp_path / "report.html").write_text("precious")
    with pytest.raises(UsageError, match="--force"):
        make_report(results, tmp_path / "report.html")
