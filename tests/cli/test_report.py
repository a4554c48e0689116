"""`quadexp report` and `quadexp export` as a user meets them."""

from __future__ import annotations

import json

from tests.cli.command import run

QUICK = ("trajectory=hover", "trajectory.duration=0.3", "controller.backend=interpreted", "plant.backend=interpreted")


def test_from_a_sweep_to_a_page(here):
    sweep = ("controller=nominal_mpc,perfect_mpc", "seed=0,1", "--no-figures", "--out", "results/hover")
    assert run("evaluate", "--sweep", *QUICK, *sweep)[0] == 0
    code, out, _ = run("report", "results/hover", "--out", "page.html", "--figures", "paper")
    lines = out.splitlines()
    assert code == 0 and lines[-1] == "page.html" and "All 4 flights were completed." in out
    assert "paper/error_against_time.pdf" in lines
    text = (here / "page.html").read_text(encoding="utf-8")
    assert "All 4 flights were completed." in text
    assert "quadexp evaluate --sweep trajectory=hover" in text and str(here) not in text
    assert run("report", "results/hover", "--out", "page.html")[0] == 2  # it is there
    code, out, _ = run("report", "results/hover", "--out", "page.html", "--force", "--json")
    record = json.loads(out)
    assert code == 0 and record["path"] == "page.html" and len(record["answer"]) == 2
