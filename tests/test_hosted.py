"""The hosted tests run what the Makefile has."""

import re
import subprocess
from pathlib import Path

import pytest
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


@pytest.mark.parametrize("target", ["test-fast", "test-lowest", "test-interpreted", "reproduce-quick", "coverage"])
def test_files_that_a_target_names_are_there(target):
    """As `make` expands its words; pytest runs nothing where one is missing."""
    done = subprocess.run(["make", "--dry-run", "--always-make", target], cwd=ROOT, capture_output=True, text=True)
    named = set(re.findall(r"(?<!\S)tests/[\w/.]+", done.stdout))
    assert done.returncode == 0 and named and not [name for name in sorted(named) if not (ROOT / name).exists()]
