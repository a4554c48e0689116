"""--format json, csv, markdown and latex: every command has it, and says the same in each of them."""

import csv
import io
import json

import pytest
from typer.main import get_command

from quadexp.cli.app import app
from quadexp.log.store import write_flight
from tests.cli.command import run
from tests.models.recorded_flights import crazyflie, recorded_flight
from tests.plugins.bench.rows import board
from tests.plugins.tune.parts import open_loop
from tests.report.sweeps import noise, swept

GROUP = get_command(app)
BARE = ("controller.backend=interpreted", "plant.backend=interpreted")
SHORT = ("trajectory=step", "trajectory.duration=0.4", "trajectory.step_time=0.2", *BARE)
HOVER = ("trajectory=hover", "trajectory.duration=0.4")
CALLS = {  # of each command: a call that answers with a table
    "simulate": ("simulate", *SHORT, "--out", "s.parquet", "--force"),
    "collect": ("collect", "--flight", "a.parquet", "--out", "c.parquet", "--force"),
    "fit": ("fit", "gp", "data.parquet", "model.inducing=5", "--no-figures", "--out", "gp", "--force"),
    "fit-gp": ("fit-gp", "data.parquet", "gp.inducing=5", "--no-figures", "--out", "gp", "--force"),
    "fit-drag": ("fit-drag", "data.parquet", "--out", "drag", "--force"),
    "fit-nn": ("fit-nn", "data.parquet", "nn.hidden=[4]", "nn.max_iterations=5", "--out", "nn", "--force"),
    "evaluate": ("evaluate", *SHORT, "--out", "r", "--keep-old"),
    "show": ("show", "results"),
    "check": ("check", "a.parquet"),
    "identify": ("identify", "logged.parquet", "--no-figures", "--out", "e", "--force"),
    "import": ("import", "a.csv", "--keep", "--out", "flights", "--force"),
    "results": ("results", "results"),
    "validate": ("validate", "models/vehicle", "--flights", "logged.parquet", "--horizons", "0.1"),
    "compare": ("compare", "results", "other"),
    "table": ("table", "results", "--intervals", "pm"),
    "plot": ("plot", "results", "--x", "controller.nodes", "--out", "p.svg", "--force"),
    "archive": ("archive", "results", "--out", "a.zip", "--force"),
    "report": ("report", "results", "--out", "page.html", "--figures", "paper", "--force"),
    "export": ("export", "a.parquet", "--to", "csv", "--out", "x.csv", "--force"),
    "replay-test": ("replay-test", "logged.parquet", "models/vehicle", "controller=geometric", "--members", "1"),
    "export-controller": ("export-controller", "controller=geometric", *HOVER, "--out", "c", "--force"),
    "animate": ("animate", "a.parquet", "--rate", "5", "--to", "0.4", "--out", "g.gif", "--force"),
    "tune": ("tune", "controller=open_loop", "--conf", "mine", "plant=ideal", "trajectory=hover",
             "trajectory.duration=0.2", "evaluate.workers=1", "--vary", "controller.share=0.8..2",
             "--seeds", "1", "--flights", "2", "--out", "t"),
    "bench": ("bench", "--only", "--add", "board.parquet", "--out", "b"),
    "new": ("new", "vehicle", "mine_{}", "--to", "parts"),
    "cache": ("cache",),
    "options": ("options", "wind=gust"),
}  # fmt: skip

# Checked in two forms: what prints is the same for all.
LONG = (
    "replay-test", "export-controller", "fit", "fit-gp", "fit-nn", "identify", "collect", "report", "plot", "archive",
    "validate", "tune", "animate",
)  # fmt: skip
HEADS = {"evaluate": 1}  # rows of a heading, which CSV has not


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """What the calls read."""
    from quadexp.plugins.bench.board import write_board
    from quadexp.plugins.bench.protocol import read_protocol

    made = tmp_path_factory.mktemp("formats")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(made)
        assert run("simulate", *SHORT, "--out", "a.parquet")[0] == 0
        assert run("export", "a.parquet", "--to", "csv", "--out", "a.csv")[0] == 0
        write_flight("logged.parquet", recorded_flight(1, crazyflie(), duration=8))
        assert run("identify", "logged.parquet", "--no-figures", "--out", "models/vehicle")[0] == 0
        assert run("collect", "collect.duration=12", "--out", "data.parquet")[0] == 0
        asked = ["controller=nominal_mpc,perfect_mpc", "controller.nodes=5,10", "seed=0,1"]
        for name, scale in (("results", 1.0), ("other", 1.1)):
            swept(made / name, asked, lambda c, k=scale: 0.01 * k * c.controller.nodes * (1 + noise(c.seed)))
        open_loop(made / "mine")
        rows = board(
            {"nominal_mpc": lambda t, s: 0.2, "other": lambda t, s: 0.1}, protocol_sha256=read_protocol().sha256
        )
        write_board("board.parquet", rows, {})
    return made


def test_every_command_is_here_and_has_the_option():
    assert set(CALLS) == set(GROUP.commands) - {
        "fly",
        "reproduce",
    }  # need an autopilot, and data: tests/plugins/vehicle, tests/plugins/public

    for name, command in GROUP.commands.items():
        options = {option for parameter in command.params for option in parameter.opts}
        assert {"--format", "--json"} <= options, name


@pytest.mark.parametrize("name", CALLS)
def test_every_form_of_an_answer(name, folder, monkeypatch):
    """JSON is one object; the others hold a table, Markdown as many rows as CSV."""
    monkeypatch.chdir(folder)
    forms = {}
    for form in ("json", "csv") if name in LONG else ("json", "csv", "markdown", "latex"):
        code, forms[form], err = run(*(word.format(form) for word in CALLS[name]), "--format", form)
        assert code == 0, err
    assert isinstance(json.loads(forms["json"]), dict)
    rows = list(csv.reader(io.StringIO(forms["csv"].split("\n\n")[0])))
    assert len(rows) > 1 and len({len(row) for row in rows}) == 1, rows
    if name not in LONG:
        lines = next(part for part in forms["markdown"].split("\n\n") if part.startswith("|")).splitlines()
        assert lines[1].startswith("| ---") and len(lines) == len(rows) + 1 + HEADS.get(name, 0)
        assert forms["latex"].count(r"\begin{tabular}") == forms["latex"].count(r"\end{tabular}") >= 1


@pytest.mark.parametrize("name", CALLS)
def test_a_form_that_there_is_not_is_refused_before_anything_is_done(name, folder, monkeypatch):
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    code, out, err = run(*CALLS[name], "--format", "xml")
    assert (code, out) == (2, "") and "--format xml: must be one of text, json, csv, markdown, latex" in err
    assert run(*CALLS[name], "--format", "csv", "--json")[0] == 2 and sorted(folder.rglob("*")) == before
