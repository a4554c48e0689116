"""The hosted tests run what the Makefile has."""

import re
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[1]


def test_hosted_tests_run_targets_of_the_makefile():
    jobs = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8"))["jobs"]
    asked = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    others = [one["target"] for one in jobs["other"]["strategy"]["matrix"]["include"]]
    targets = {words.partition("make ")[2] for words in asked if words.startswith("make ") and "$" not in words} | set(
        others
    )
    there = re.findall(r"^([\w-]+(?: [\w-]+)*):", (ROOT / "Makefile").read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert len(targets) == 7 and targets <= {name for names in there for name in names.split()}
