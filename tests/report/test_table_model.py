"""One table in every form: the same cells in text, Markdown, LaTeX, the terminal and HTML."""

import io
import re

import pytest

from quadexp.report.table import Table

ROWS = [["flown", "", "2 of 2"], ["circle", "4", "**1.2** [1.1, 1.3]*"], ["a_b & c", "8", "10.0 <x> (1 solver_failed)"]]
TABLE = Table(["trajectory", "m/s", "gp_mpc"], ROWS, "mean error (mm)", head=1, notes=["* differs", "second"])


def test_text_is_aligned_and_holds_the_cells():
    lines = TABLE.lines()
    assert lines[0] == "mean error (mm)" and lines[-2:] == ["* differs", "second"]
    assert lines[1].split() == ["trajectory", "m/s", "gp_mpc"]
    ends = {len(line) for line in lines[1:5]}
    assert len(ends) == 1, "the last column is right-aligned"
    for line, row in zip(lines[2:5], ROWS, strict=True):
        assert re.split(r"  +", line.strip())[-1] == row[-1] and line.startswith(row[0])


def test_groups_stand_above_their_first_column():
    table = Table(["", "x", "y", "x"], [["name", "1.000", "2", "3"]], groups={1: "in sample", 3: "out"})
    above, heads, row = table.lines()
    assert above.index("in sample") == len("name") + 2 and above.endswith("in sample  out")
    assert len(heads) == len(row) == len(above) and row.index("1.000") < above.index("out") <= row.index("3")
    assert table.markdown().startswith("| ")


def test_markdown():
    assert TABLE.markdown().splitlines() == [
        "mean error (mm)",
        "",
        "| trajectory | m/s | gp_mpc |",
        "| --- | ---: | ---: |",
        *("| " + " | ".join(row).replace("<", r"\<") + " |" for row in ROWS),
        "",
        r"- \* differs",
        "- second",
    ]


def test_latex_translates_marks_and_escapes_the_rest():
    latex = TABLE.latex()
    assert r"circle & 4 & \textbf{1.2} [1.1, 1.3]$^*$ \\" in latex
    assert r"a\_b \& c & 8 & 10.0 $<$x$>$ (1 solver\_failed) \\" in latex
    assert r"\begin{tabular}{lrr}" in latex and latex.count(r"\midrule") == 2
    assert latex.splitlines()[0] == r"% mean error (mm); needs \usepackage{booktabs}"
    assert Table(TABLE.columns, ROWS).latex().startswith("% needs")
    over = Table(TABLE.columns, ROWS, TABLE.title, head=1, over="error").latex()
    assert r"\multicolumn{1}{c}{error} \\ \cmidrule(l){3-3}" in over and over.count(r"\addlinespace") == 1


@pytest.mark.parametrize("stacked", [False, True])
def test_the_terminal(stacked):
    from rich.console import Console

    console = Console(width=100, file=io.StringIO())
    console.print(TABLE.rich(stacked=stacked))
    text = console.file.getvalue()
    for word in ("1.2", "[1.1, 1.3]*", "a_b & c", "<x>"):
        assert word in text
    assert "**" not in text and ("1.2 [1.1" in text) == (not stacked)  # the interval below its value


def test_a_table_without_rows_has_its_heading():
    assert Table(["a", "b"], []).lines() == ["a  b"]
