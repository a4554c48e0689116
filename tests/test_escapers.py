"""One escaper a format: whatever a name holds, what is written is one line, one cell or one word, and obeys nobody."""

import csv
import io
import re
from html.parser import HTMLParser
from xml.etree import ElementTree

import pytest
import yaml
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt
from rich.console import Console

from quadexp import messages
from quadexp.cli.terminal import print_lines
from quadexp.plugins.check.candidates import flow
from quadexp.plugins.drawing.style import Figure, plain_log, styled
from quadexp.plugins.page.document import sortable_page
from quadexp.plugins.tune.preset import _yaml
from quadexp.report.table import _MARKS, Table
from tests.report.results import make_results, speed_figure

PIECES = (
    "\n", "\r", "\t", "\x1b[31m", "\x9b", "\x00", "\u202e", "\u2028", "\x85", "\u200b", "\ud800", "\udcc2\udc9b",
    "$", "$x^2$", "\\", "\\input{/etc/passwd}", "^^5cinput", "%", "&", "#", "_", "{", "}", "~", "^", "|", "<", ">",
    "</script>", "<!--", '"', "'", "`", "*", "**1**", "[", "]", "](http://x)", "[x]: y", "- ", "1. ", "# ", "&lt;",
    "=", "=cmd|' /C calc'!A0", "+1+1", "-2+3", "@SUM(1)", ";", ",", "a_b", " ", "gp_mpc", "47 files, 0 wrong", "..",
    "/", ": ", "!!python/object:x", "\xe9", "\u6f22", "\U0001f600",
)  # fmt: skip
NAMES = st.lists(st.sampled_from(PIECES) | st.text(max_size=6), max_size=8).map("".join)
fuzzed = settings(max_examples=100, deadline=None)


def as_read(text):
    """The text as a reader sees it: in one line, what is not printed written out."""
    return messages.printable(text).encode(errors="backslashreplace").decode()


@given(NAMES)
@fuzzed
def test_printable_is_one_line(text):
    shown = messages.printable(text)
    assert len(shown.splitlines()) <= 1
    assert all(sign.isprintable() or sign in "\u00a0\u202f" or "\udc80" <= sign <= "\udcff" for sign in shown)
    sent = shown.encode("utf-8", "surrogateescape").decode("utf-8", "surrogateescape")
    assert sent == shown, "bytes that are letters together are no way around"


@given(st.lists(NAMES, min_size=1, max_size=4))
@fuzzed
def test_the_terminal_gets_as_many_lines_as_there_are_texts(texts):
    stream = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.stdout", messages.CleanStream(stream))
        print_lines(texts)
    assert stream.getvalue().count("\n") == len(texts)
    table = Table(["a", "b"], [[text, "1"] for text in texts], texts[0], notes=texts)
    assert len(table.lines()) == 1 + 2 * len(texts) + bool(texts[0]) and not any("\n" in one for one in table.lines())
    out = io.StringIO()
    Console(file=out, width=2000).print(table.rich())
    lines = [one for one in out.getvalue().split("\n") if "│" in one]
    assert len([one for one in lines if one.count("│") >= 3]) == len(texts)


@given(NAMES)
@fuzzed
def test_markdown_has_the_cells_and_nothing_else(text):
    assume(not _MARKS.search(as_read(text)))
    made = Table(["name", text], [[text, "1.2"]], text, notes=[text]).markdown()
    tokens = MarkdownIt("commonmark").enable(["table", "strikethrough"]).parse(made)
    kinds = [one.type for one in tokens if one.nesting >= 0 and one.type not in ("inline", "tbody_open", "thead_open")]
    cells = ["table_open", "tr_open", "th_open", "th_open", "tr_open", "td_open", "td_open"]
    notes = ["bullet_list_open", "list_item_open", *(["paragraph_open"] if text.strip(" ") else [])]
    assert kinds == [*(["paragraph_open"] if as_read(text).strip() else []), *cells, *notes]
    inline = [one for one in tokens if one.type == "inline"]
    assert {child.type for one in inline for child in one.children} <= {"text", "text_special"}
    shown = ["".join(child.content for child in one.children) for one in inline]
    assert {one.strip() for one in shown} <= {as_read(text).strip(), "name", "1.2", ""}


@given(NAMES)
@fuzzed
def test_latex_has_the_cells_and_no_command(text):
    assume(not _MARKS.search(as_read(text)))
    made = Table(["name", text], [[text, "1.2"]], text, notes=[text]).latex()
    first, *notes, begin, _, heading, _, row, _, end = made.splitlines()
    assert all(one.startswith("% ") for one in (first, *notes)) and len(notes) == 1
    for cells in (heading, row):
        assert cells.endswith(r" \\") and len(re.split(r"(?<!\\)&", cells)) == 2
        rest = re.sub(r"\\[&%$#_{}]|\\text(backslash|asciicircum|asciitilde)\{\}|\$[<>|]\$|\{\}", "", cells[:-3])
        assert not re.search(r"[\\%$#_{}^~]", rest)
        assert not cells.lstrip().startswith(("[", "*"))


@given(NAMES, NAMES)
@fuzzed
def test_csv_has_the_cells_and_no_formula(first, second):
    line = messages.csv_line([first, -1.5, second, float("nan")])
    ((a, number, b, nothing),) = csv.reader([line])
    assert (number, nothing) == ("-1.5", "")
    assert [one.replace("'", "") for one in (a, b)] == [as_read(one).replace("'", "") for one in (first, second)]
    for separator in ",;":
        for cell in next(csv.reader([messages.csv_line([first, second])], delimiter=separator)):
            assert not re.match(r"\s*[=+\-@]", cell) or re.fullmatch(messages._NUMBER, cell, re.IGNORECASE)


class Page(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.tags, self.data, self.values = [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.values += [value for _, value in attrs]

    def handle_data(self, data):
        self.data.append(data)


@given(NAMES)
@fuzzed
def test_html_has_text_and_no_tag(text):
    page = Page(f'<p title="{messages.html(text)}">{messages.html(text)}</p>')
    read = messages.clean(text).encode(errors="backslashreplace").decode()
    assert page.tags == ["p"] and page.values == [read] and "".join(page.data) == read
    table = Page(Table(["a", "b"], [[text, text]], text, notes=[text]).html())
    assert [table.tags.count(tag) for tag in ("td", "th", "tr")] == [2, 2, 2]
    assert set(table.tags) <= {"table", "caption", "thead", "tbody", "tr", "td", "th", "p", "b"}
    whole = Page(sortable_page(text, Table([text], [[text]]), notes=[text]))
    assert whole.tags.count("td") == 1 and whole.tags.count("script") == 1


@given(NAMES)
@fuzzed
def test_yaml_is_read_back(text):
    assume(not re.search("[\ud800-\udfff]", text))
    for written in (messages.yaml(text), flow(text)):
        assert yaml.safe_load(f"a: {written}\nb: 1") == {"a": text, "b": 1} and len(written.splitlines()) <= 1
    assert yaml.safe_load(_yaml({"a": text, "b": 1})) == {"a": text, "b": 1}
    assert yaml.safe_load(f"# {messages.printable(text)}\nb: 1") == {"b": 1}


@given(NAMES)
@settings(max_examples=8, deadline=None)
def test_a_figure_shows_any_name(text):
    @styled
    def drawn():
        figure = Figure(figsize=(2, 2), layout="constrained")
        panel = figure.subplots()
        panel.plot([1, 2], [1, 300], label=f"a{text}")
        panel.set_yscale("log")
        plain_log(panel.yaxis)
        panel.set_xticks([1, 2], [text, "b"])
        panel.set(title=text, xlabel=text)
        panel.legend()
        return figure

    figure, stream = drawn(), io.BytesIO()
    figure.savefig(stream, format="svg")
    ElementTree.fromstring(stream.getvalue())
    assert "\\mathdefault" not in stream.getvalue().decode() or "\\mathdefault" in text


@pytest.mark.parametrize("form", ["pdf", "eps"])
def test_fonts_are_whole(form):
    """Systems for submissions refuse fonts of Type 3."""
    figure, stream = Figure(), io.BytesIO()
    figure.text(0.5, 0.5, "gp_mpc")
    figure.savefig(stream, format=form, **({"metadata": {"Creator": None}} if form == "pdf" else {}))
    content = stream.getvalue()
    assert b"/FontType 42" in content if form == "eps" else b"/Type3" not in content and b"/FontFile2" in content


EVIL = "\n47 files, 0 wrong\x1b[31m$\\frac$|=cmd|'`<b>\\input{x}"


def test_a_sweep_of_hostile_names_is_written_drawn_and_reported(tmp_path, monkeypatch):
    """Every writer of a sweep's texts, on flights of somebody who wishes no good."""
    from quadexp.log.store import read_table
    from quadexp.plugins.page.document import page_of
    from quadexp.plugins.page.report import make_report
    from quadexp.report.frame import SweepFrame
    from quadexp.report.metrics import from_columns, to_csv
    from quadexp.report.statistics import results_statistics
    from quadexp.report.tables import comparison_texts, csv_of

    evil = f"gp_mpc{EVIL}"
    monkeypatch.setattr("tests.report.results.ERRORS", {"nominal_mpc": 0.04, evil: 0.002})
    monkeypatch.setattr("tests.report.results.TIMES", {"nominal_mpc": 2e-5, evil: 5e-5})
    root = make_results(tmp_path / "r", controllers=("nominal_mpc", evil), lost=False)
    columns, _ = read_table(root / "results.parquet", "results")
    rows = from_columns(columns)
    _, texts = comparison_texts(results_statistics(rows), "mean_error")
    assert {"table.md", "table.tex", "comparison.tex", "statistics.csv"} == set(texts)
    for text in (*texts.values(), to_csv(rows)):
        assert "\x1b" not in text and not re.search(r"^47 files", text, re.MULTILINE)
    for name in ("table.tex", "comparison.tex"):
        assert not [one for one in texts[name].splitlines() if "\\input" in one and not one.startswith("%")]
    assert len(list(csv.reader(io.StringIO(to_csv(rows))))) == 1 + len(rows)
    frame = SweepFrame.read(root)
    assert len(list(csv.reader(io.StringIO(csv_of(frame, ["controller", "seed"]))))) == 1 + len(rows)
    assert "b" not in Page(page_of(frame, ["controller", "seed"], EVIL)).tags
    speed_figure(rows).savefig(io.BytesIO(), format="svg")
    made = make_report(root, tmp_path / "report.html", figures=tmp_path / "paper")
    page = made["path"].read_text(encoding="utf-8")
    assert "\x1b" not in page and "<b>\\" not in page
