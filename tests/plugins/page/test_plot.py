"""`quadexp plot`, `results`, `compare` of many, `--format`, `export` of results, as a user meets them."""

import csv
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from quadexp.plugins.page.compare import compare
from quadexp.report.summary import held_out_rows, held_out_table
from tests.cli.command import run, run_main
from tests.report.sweeps import noise, swept

ASKED = ["controller=nominal_mpc,perfect_mpc", "controller.nodes=5,10", "trajectory.speed=4,8", "seed=range(3)"]


def error(config):
    scale = {"nominal_mpc": 0.1, "perfect_mpc": 0.001}[config.controller.name] * config.trajectory.speed
    return scale / config.controller.nodes * (1 + 0.1 * noise(config.seed, config.controller.nodes))


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plot")
    swept(folder / "r", ASKED, error)
    swept(folder / "heavy", [*ASKED, "vehicle.mass=1.5"], lambda config: 1.5 * error(config))
    swept(folder / "lossy", ASKED, lambda config: None if config.seed == 2 else 2 * error(config))
    return folder


@pytest.fixture
def results(here, flown):
    for name in ("r", "heavy", "lossy"):
        shutil.copytree(flown / name, here / name)
    return here


def rows(text):
    return list(csv.DictReader(io.StringIO(text)))


class TestPlot:
    def test_the_issues_own_command(self, results):
        asked = ("--x", "trajectory.speed", "--y", "mean_error", "--by", "controller.nodes", "--out", "a.png")
        code, out, err = run("plot", "r", *asked)
        assert (code, out) == (0, "a.png\n") and not err and Path("a.png").read_bytes().startswith(b"\x89PNG")
        record = json.loads(run("plot", "r", *asked, "--force", "--json")[1])
        assert (record["x"], record["by"], record["facet"]) == (
            "trajectory.speed",
            ["controller.nodes"],
            ["controller"],
        )
        table = pd.read_parquet("r/results.parquet")
        nodes = table["variant"].str.partition("=")[2].astype(int)
        means = table.groupby([table["controller"], nodes, table["speed"]])["mean_error"].mean()
        for point in record["points"]:
            at = point["controller"], point["controller.nodes"], point["trajectory.speed"]
            assert point["mean_error"] == pytest.approx(means[at], rel=1e-12)

    def test_for_a_paper(self, results):
        """As wide as asked for, with texts of one's own as they were given, and the notes beside it."""
        from matplotlib.image import imread

        labels = ("--label", "perfect_mpc=<b>$ours$", "--label", "mean_error=error (mm)", "--title", "<i>$Fig$")
        asked = ("plot", "lossy", "--x", "trajectory.speed", *labels, "--force")
        for width, inches in (("column", 3.5), ("page", 7.16)):
            code, _, err = run(*asked, "--width", width, "--out", "a.png")
            assert code == 0 and "were not completed" in err and abs(imread("a.png").shape[1] - 150 * inches) <= 1
        assert run(*asked, "--out", "a.html")[0] == 0
        page = Path("a.html").read_text()
        assert "&lt;i&gt;$Fig$</h2>" in page and "<b>" not in page
        for wrong, said in (("gp_mpc=GP", "--label gp_mpc: no key or value of this figure"), ("seed", "give KEY=TEXT")):
            code, _, err = run("plot", "r", "--label", wrong)
            assert code == 2 and said in err
        assert "is not one of 'column', 'page'" in run("plot", "r", "--width", "3")[2]

    def test_colours_and_a_height_of_ones_own(self, results):
        ours = ("--color", "perfect_mpc=navy", "--color", "nominal_mpc=#aa0000", "--height", "2")
        words = ("plot", "r", "--x", "trajectory.speed", "--by", "controller", "--width", "column", "--force", *ours)
        assert run(*words, "--out", "a.svg")[0] == 0
        drawn = Path("a.svg").read_text()
        assert "stroke: #000080" in drawn and "stroke: #aa0000" in drawn and 'height="144pt"' in drawn
        assert "#5f6773" not in drawn  # the colour that nominal_mpc has otherwise
        for wrong, said in (
            (("--color", "gp_mpc=navy"), "--color gp_mpc: no value of this figure"),
            (("--color", "perfect_mpc=colour"), "--color perfect_mpc=colour: give NAME=COLOR"),
            (("--height", "0"), "--height 0: must be in [1, 20] inches"),
        ):
            code, _, err = run("plot", "r", *wrong)
            assert code == 2 and said in err

    def test_where_takes_only_these_flights(self, results):
        code, out, _ = run("plot", "r", "--where", "controller == perfect_mpc and seed < 2", "--out", "a.svg", "--json")
        assert code == 0 and {point["seeds"] for point in json.loads(out)["points"]} == {2}

    @pytest.mark.parametrize(
        ("words", "said"),
        [
            (("--out", "a.jpg"), "a figure is a file .png, .pdf, .svg, .html"),
            (("--x", "controller.node"), "controller.node: no such key; did you mean controller.nodes?"),
            (("--kind", "pie"), "'pie' is not one of 'lines', 'heat'"),
            (("--where", "speed > 100"), "--where 'speed > 100': no flight fulfils it"),
            (("--kind", "heat", "--x", "seed", "--by", "a,b"), "a: no such key"),
        ],
    )
    def test_a_mistake_is_one_line_and_writes_nothing(self, results, words, said):
        done = run_main("plot", "r", *words)
        assert (done.returncode, done.stdout) == (2, "") and said in done.stderr and done.stderr.count("\n") == 1
        assert not Path("plot.png").exists()


class TestResults:
    def test_filters_sorts_and_chooses_columns(self, results):
        condition = "controller == nominal_mpc and speed > 6 and controller.nodes in [5]"
        names = "controller,controller.nodes,trajectory.speed,seed,mean_error"
        out = run("results", "r", "--where", condition, "--sort", "-mean_error", "--columns", names, "--format", "csv")[
            1
        ]
        table = pd.read_parquet("r/results.parquet")
        kept = table[
            (table["controller"] == "nominal_mpc") & (table["speed"] > 6) & table["variant"].str.endswith("=5")
        ]
        kept = kept.sort_values("mean_error", ascending=False)
        assert [float(row["mean_error"]) for row in rows(out)] == kept["mean_error"].tolist()
        assert [int(row["seed"]) for row in rows(out)] == kept["seed"].tolist()
        assert {row["controller.nodes"] for row in rows(out)} == {"5"}

    def test_a_page_that_sorts(self, results):
        code, out, _ = run("results", "r", "--html", "t.html")
        assert (code, out) == (0, "t.html\n") and Path("t.html").read_text().count("<tr>") == 25
        assert run("results", "r", "--html", "t.html")[0] == 2


class TestCompare:
    def test_three_results_with_a_picture(self, results):
        code, out, _ = run("compare", "r", "heavy", "lossy", "--out", "c.png")
        assert code == 0 and out.endswith("c.png\n") and Path("c.png").stat().st_size > 10_000
        assert out.splitlines()[0].split() == ["mean", "error", "(mm)", "r", "heavy", "lossy", "flights"]
        report = compare("r", "heavy", "lossy")
        tables = [pd.read_parquet(f"{name}/results.parquet") for name in ("r", "heavy", "lossy")]
        for label, means in report["metrics"].items():
            flown = [t[(t["controller"] + t["variant"].str.replace("controller.", " ") == label)] for t in tables]
            expected = [t[t["seed"] < 2][report["metric"]].mean() for t in flown]  # seed 2 is lost in one of them
            assert means == pytest.approx(expected, rel=1e-12)
        assert len(report["metrics"]) == 4 and {row[-1] for row in report["tables"][0].rows} == {"4"}

    def test_the_picture_of_results_has_a_line_a_folder_and_a_panel_a_controller(self, results):
        from quadexp.plugins.page.draw import results_figure

        figure = results_figure([Path("r"), Path("heavy"), Path("lossy")])
        panels = [panel for panel in figure.axes if panel.axison]
        assert [panel.get_title() for panel in panels] == ["nominal_mpc", "perfect_mpc"]
        lines = {c.get_label(): c.lines[0].get_ydata() for c in panels[0].containers}
        assert set(lines) == {"results=r", "results=heavy", "results=lossy"}
        assert np.asarray(lines["results=heavy"]) == pytest.approx(1.5 * np.asarray(lines["results=r"]))
        assert np.asarray(lines["results=lossy"]) == pytest.approx(2 * np.asarray(lines["results=r"]))


class TestShow:
    def test_held_out_scores_of_a_checkpoint(self, tmp_path):
        made = [("a_x", "gp", 0.5), ("a_x", "zero", 2.0), ("t_x", "gp", 0.001)]
        report = {"rows": [dict(zip(("output", "predictor", "rmse"), one, strict=True)) for one in made]}
        (tmp_path / "report.json").write_text(json.dumps(report))
        table = held_out_table(held_out_rows(tmp_path))
        assert table.columns == ["RMSE on held-out flights", "gp", "zero"]
        assert table.rows == [["a_x (m/s^2)", "0.500", "2.00"], ["t_x (N m)", "0.00100", "-"]]
        (tmp_path / "report.json").write_text("{'damaged")
        assert held_out_rows(tmp_path) == [] and held_out_table([]) is None
