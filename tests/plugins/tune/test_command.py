"""`quadexp tune` as a user meets it."""

import json
from pathlib import Path

from tests.cli.command import run
from tests.plugins.tune.parts import open_loop

TASK = ["plant=ideal", "trajectory=hover", "trajectory.duration=0.2", "evaluate.workers=1"]
SHARE = ["--vary", "controller.share=0.8..2", "--seeds", "1"]


def tune(*words):
    return run("tune", "controller=open_loop", *TASK, *SHARE, "--conf", "mine", "--out", "t", *words)


def test_it_tunes_in_worker_processes_says_what_was_found_and_goes_on(here):
    """The vehicle hovers with its own weight: nothing better is to be found."""
    open_loop(here / "mine")
    code, out, err = tune("--flights", "3")
    assert code == 0, err
    assert out.splitlines()[0] == "open_loop: 3 trials of 1 flights, 3 in all"
    assert "nothing better was found" in out and "t/controller/open_loop_tuned.yaml" in out
    folders = f"--conf {Path('t').absolute()} --conf {Path('mine').absolute()}"
    assert out.splitlines()[-1] == f"fly it: quadexp simulate {folders} controller=open_loop_tuned"
    code, out, _ = tune("--flights", "5", "--json")
    found = json.loads(out)
    assert code == 0 and found["flights"] == 5 and found["choice"] == "controller=open_loop_tuned"
    assert found["settings"]["controller.share"] == [1.0, 1.0]
    code, out, _ = tune("--flights", "2", "--seed", "1", "--force", "--json")
    assert code == 0 and json.loads(out)["flights"] == 2
    assert run("show", "t/history.parquet")[0] == 0
