"""The commands on a report's page do what they say in any folder."""

import html
import re
import shlex

import pytest

from tests.cli.command import run
from tests.models.by_hand import make_checkpoint

OWN = "defaults: [linear_drag_mpc, _self_]\n"


def printed(page):
    blocks = re.findall(r"<pre[^>]*>(.*?)</pre>", page.read_text(), re.DOTALL)
    lines = (line.strip() for block in blocks for line in html.unescape(re.sub("<[^>]+>", "", block)).splitlines())
    return [shlex.split(line) for line in lines if line.startswith("quadexp ")]


SWEEPS = {
    "an own option, a model, paths": [
        "--conf", "my conf", "trajectory=file", "trajectory.path='it\\'s a path.csv'",
        "controller=own_mpc", "model='m o/drag'",
    ],
    "a model that its option names": ["controller=linear_drag_mpc", "trajectory=hover", "trajectory.duration=0.2"],
}  # fmt: skip


@pytest.mark.parametrize("sweep", SWEEPS)
def test_every_printed_command_runs_in_another_folder(tmp_path, monkeypatch, sweep):
    here, elsewhere = tmp_path / "it's here", tmp_path / "else where"
    for folder in (here / "my conf/controller", elsewhere):
        folder.mkdir(parents=True)
    (here / "my conf/controller/own_mpc.yaml").write_text(OWN)
    (here / "it's a path.csv").write_text("x,y,z\n0,0,1\n0.3,0,1\n")
    for place in ("m o/drag", "models/drag"):
        make_checkpoint(here / place)
    monkeypatch.chdir(here)
    code, _, err = run(
        "evaluate", "--sweep", *SWEEPS[sweep], "evaluate.workers=1", "--out", "my results", "--no-figures"
    )
    assert code == 0, err
    assert run("report", "my results", "--out", "my page.html")[0] == 0
    commands = printed(here / "my page.html")
    assert {words[1] for words in commands} == {"simulate", "evaluate", "report"}
    monkeypatch.chdir(elsewhere)
    for words in commands:
        code, _, err = run(*words[1:])
        assert code == 0, f"{shlex.join(words)}: {err}"
