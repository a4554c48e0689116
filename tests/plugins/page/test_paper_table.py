"""`quadexp table`, table.tex and comparison.tex: the right numbers, in a width that a paper has."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
from matplotlib.font_manager import FontProperties, findfont
from matplotlib.ft2font import FT2Font

from quadexp.errors import UsageError
from quadexp.plugins.page.fitted import GAP, MOST_LINES, WIDTHS, fitted_latex, tabulars, text_width
from quadexp.plugins.page.paper_cells import number_text
from quadexp.plugins.page.paper_table import paper_table
from quadexp.report.frame import SweepFrame
from quadexp.report.statistics import results_statistics
from quadexp.report.table import Table
from quadexp.report.tables import comparison_texts
from tests.cli.command import run
from tests.report.results import ERRORS, make_results

LATEX = shutil.which("pdflatex")
CLASSES = {"IEEEtran": "journal", "article": "twocolumn"}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return make_results(tmp_path_factory.mktemp("paper") / "r")


def of(frame, place, metric="mean_error"):
    """Values of the flights of a controller, trajectory and speed, by seed; of all where it is None."""
    rows = [row for row in frame.rows if place in (None, (row["controller"], row["trajectory"], row["speed"]))]
    return {(row["trajectory"], row["speed"], row["seed"]): row[metric] for row in rows if row["outcome"] == "ok"}


def test_a_cell_is_the_mean_over_the_seeds_that_all_completed(results):
    frame = SweepFrame.read(results)
    table = paper_table(frame, rows=["trajectory", "speed"], columns=["controller"], digits=4)
    assert table.columns == ["trajectory", "speed (m/s)", *ERRORS] and table.over == "mean error (mm)"
    assert [row[:2] for row in table.rows] == [
        ["circle", "4"],
        ["circle", "8"],
        ["lemniscate", "4"],
        ["lemniscate", "8"],
    ]
    for row in table.rows:
        for name, cell in zip(ERRORS, row[2:], strict=True):
            seeds = of(frame, (name, row[0], float(row[1])))
            kept = [error for (*_, seed), error in seeds.items() if (row[0], row[1], seed) != ("lemniscate", "8", 3)]
            assert float(re.match(r"[*]*([\d.]+)", cell)[1]) == pytest.approx(1e3 * np.mean(kept), rel=1e-3)
            lost = name == "linear_drag_mpc" and row[:2] == ["lemniscate", "8"]
            assert ("(5/6)" in cell) == lost


def test_what_was_swept_and_has_no_place_is_averaged_and_named(results):
    frame = SweepFrame.read(results)
    table = paper_table(frame.where([row["controller"] == "gp_mpc" for row in frame.rows]), rows=["speed"], digits=5)
    rows = [row for row in frame.rows if row["controller"] == "gp_mpc"]
    for line in table.rows:
        errors = [row["mean_error"] for row in rows if row["speed"] == float(line[0])]
        assert float(line[1]) == pytest.approx(1e3 * np.mean(errors), rel=1e-4)
    assert "mean over trajectory: circle, lemniscate" in table.notes


def test_every_key_of_who_flies_has_a_place(results):
    """The mean of two controllers is the error of none."""
    table = paper_table(SweepFrame.read(results), rows=["trajectory"], columns=["speed"])
    assert table.columns[:2] == ["trajectory", "controller"] and len(table.rows) == 2 * len(ERRORS)


@pytest.mark.parametrize(
    ("how", "text"),
    [
        (("none", None), ("12.3", "")),
        (("pm", None), ("12.35", " ± 0.05")),
        (("brackets", None), ("12.35", " [12.29, 12.40]")),
        (("brackets", 2), ("12", " [12, 12]")),
        (("pm", 5), ("12.345", " ± 0.055")),
    ],
)
def test_intervals_and_digits(how, text):
    intervals, digits = how
    assert number_text(12.3451, 12.29, 12.4, intervals, digits) == text


def test_marks_are_those_of_the_error_table(tmp_path):
    frame = SweepFrame.read(make_results(tmp_path / "two", controllers=("nominal_mpc", "gp_mpc"), lost=False))
    frame = frame.where([row["trajectory"] == "circle" and row["speed"] == 8 for row in frame.rows])
    plain = paper_table(frame, intervals="none")
    asked = paper_table(frame, rows=["trajectory", "speed"], columns=["controller"])
    stars = [[(cell[:2] == "**", "*" in cell.rstrip()[-1:]) for cell in row[2:]] for row in plain.rows]
    assert stars == [[(cell[:2] == "**", "*" in cell.rstrip()[-1:]) for cell in row[2:]] for row in asked.rows]
    assert any(star for row in stars for _, star in row)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"rows": ["speeed"]}, "speeed: no such key; did you mean"),
        ({"rows": ["speed"], "columns": ["trajectory.speed"]}, "trajectory.speed: stands twice"),
        ({"names": {"gpmpc": "GP"}}, "--label gpmpc: no key or value of this table; did you mean"),
        ({"metric": "success", "intervals": "pm"}, "not symmetric"),
    ],
)
def test_what_cannot_be_is_one_line(results, given, message):
    with pytest.raises(UsageError, match=message):
        paper_table(SweepFrame.read(results), **given)


def test_the_command_writes_three_formats_and_texts_of_ones_own(results, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    label = ("--label", "gp_mpc=GP (ours)", "--label", "mean_error=error (mm)")
    for suffix, sign in (("tex", r"\toprule"), ("md", "| ---: |"), ("csv", "trajectory,m/s,")):
        code, said, err = run("table", str(results), *label, "--intervals", "pm", "--out", f"t.{suffix}")
        assert code == 0 and f"t.{suffix}" in said, err
        text = (tmp_path / f"t.{suffix}").read_text()
        assert sign in text and "GP (ours)" in text and "gp_mpc" not in text.split("toprule")[-1]
    assert r"$\pm$" in (tmp_path / "t.tex").read_text()
    assert run("table", str(results), "--out", "t.pdf")[0] == 2
    assert run("table", str(results), "--out", "t.tex")[0] != 0  # it is there
    code, text, _ = run("table", str(results), "--metric", "success", "--rows", "controller", "--json")
    assert code == 0 and json.loads(text)["rows"][1][:1] == ["linear_drag_mpc"]


# ------------------------------------------------------------------------------------------------------------- fitted
def wide(columns=14, rows=70, words="gp_mpc residual=gaussian_process @quad_bench"):
    """A table that nobody fits by hand."""
    heads = ["trajectory", "m/s", "plant", *(f"{words} {k}" for k in range(columns))]
    body = [
        ["lemniscate, payload 0.1 kg", "12", "simplified/everything", *["1240.5 [1240.4, 1241.6]* (3/4)"] * columns]
    ]
    return Table(heads, body * rows, "", frozenset({0, 2}), over="mean error of position (mm)", beside=3)


TABLES = {
    "wide": wide(),
    "one column": wide(1, 3),
    "bold": Table(["a", "b"], [["W" * 30, "**1240.5** ± 0.2*"]], over="x" * 90, beside=1),
    "capitals": Table(["MMM WWW", "QQ GG"], [["%&#_$ {}~^\\", "8888.8888"]] * 5, beside=1),
    "no labels": Table(["gp", "pid"], [["1.0", "2.0"]], beside=0, left=frozenset()),
}


@pytest.mark.parametrize(
    "text", ["1240.53 [1240.44, 1241.61]*", "gp_mpc residual=wind, MPC", "lemniscate, 8 m/s (3/4)"]
)
def test_the_estimate_of_a_width_is_above_that_of_a_font_with_the_widths_of_times(text):
    font = FT2Font(findfont(FontProperties(family="STIXGeneral")))
    font.set_size(8, 72)
    font.set_text(text)
    assert font.get_width_height()[0] / 64 <= text_width(text) <= 1.6 * font.get_width_height()[0] / 64


@pytest.mark.parametrize("width", WIDTHS.values())
@pytest.mark.parametrize("name", TABLES)
def test_every_column_stands_once_in_a_tabular_that_fits(name, width):
    table = TABLES[name]
    text = fitted_latex(table, width)
    n = table.beside
    placed = [i for columns in tabulars(table, width) for i in columns[n:]]
    assert placed == [*range(n, len(table.columns))]
    for part in text.split(r"\begin{tabular}")[1:]:
        rows = [line for line in part.splitlines() if line.endswith(r"\\") and "multicolumn" not in line]
        assert len(rows) <= MOST_LINES + 12
        cells = [[c.strip() for c in re.split(r"(?<!\\)&", row[:-2])] for row in rows]
        unescaped = [
            [re.sub(r"\\textbf\{(.*?)\}", r"\1", c).replace("\\", "").replace("$", "") for c in row] for row in cells
        ]
        widths = [max(text_width(row[i]) for row in unescaped) for i in range(len(unescaped[0]))]
        unclear = name in ("bold", "capitals")  # thirty capitals without a place to break; commands of LaTeX
        assert unclear or sum(widths) + GAP * (len(widths) - 1) <= width


def compiled(folder, name, text, document, width):
    """The lines of LaTeX that say something does not fit, and the number of pages."""
    options = CLASSES[document]
    text = text if width == "column" else r"\onecolumn " + text
    (folder / f"{name}.tex").write_text(
        rf"\documentclass[{options}]{{{document}}}\usepackage{{booktabs}}"
        + (r"\usepackage[letterpaper,textwidth=516pt,columnsep=12pt]{geometry}" if document == "article" else "")
        + rf"\begin{{document}}{text}\end{{document}}"
    )
    command = [LATEX, "-interaction=nonstopmode", "-halt-on-error", f"{name}.tex"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    log = (folder / f"{name}.log").read_text(errors="replace")
    assert done.returncode == 0, log[-2000:]
    return [line for line in log.splitlines() if "Overfull" in line]


@pytest.mark.skipif(LATEX is None, reason="needs pdflatex")
@pytest.mark.parametrize("document", CLASSES)
@pytest.mark.parametrize("width", WIDTHS)
def test_latex_says_that_it_fits(width, document, tmp_path, results):
    if document == "IEEEtran" and not subprocess.run(["kpsewhich", "IEEEtran.cls"], capture_output=True).stdout:
        pytest.skip("needs IEEEtran")
    tables = {name: table for name, table in TABLES.items() if name != "bold"}
    frame = SweepFrame.read(results)
    tables["swept"] = paper_table(frame, intervals="brackets")
    tables["asked"] = paper_table(frame, rows=["trajectory"], columns=["controller", "speed"], intervals="pm")
    for name, table in tables.items():
        assert not compiled(tmp_path, name.replace(" ", ""), fitted_latex(table, WIDTHS[width]), document, width), name


@pytest.mark.skipif(LATEX is None, reason="needs pdflatex")
def test_the_tables_of_a_sweep_fit_a_page(tmp_path, results):
    rows = SweepFrame.read(results).rows
    rows = [row | {"plant": f"simplified/world_{k}"} for k in range(12) for row in rows]
    _, texts = comparison_texts(results_statistics(rows), "mean_error")
    for name in ("table.tex", "comparison.tex"):
        assert not compiled(tmp_path, name[:-4], texts[name], "article", "page")
        assert texts[name].count(r"\begin{tabular}") > (name == "comparison.tex")
