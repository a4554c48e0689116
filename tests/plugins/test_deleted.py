"""The folder of any plug-in can be deleted: the program flies, lists and refuses without it, and the core learns,
flies a sweep and reports without all of them."""

import ast
import re
import shutil
import sys

import pytest

from quadexp.plugin import BRINGS, shipped_plugins
from tests.brought import named_in, options_of
from tests.deleted import needs
from tests.faults.command import apart
from tests.house import PACKAGE, ROOT, plugins

FLIGHT = ("controller=nominal_mpc", "trajectory=hover", "trajectory.duration=1")


@pytest.fixture
def checkout(tmp_path):
    """A copy of the program, and its command."""
    shutil.copytree(PACKAGE, tmp_path / "quadexp", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "conf", tmp_path / "conf")

    def command(*words):
        return apart(
            *words, environment={"PYTHONPATH": str(tmp_path)}, before=f"import os; os.chdir({str(tmp_path)!r})"
        )

    return tmp_path, command


def test_every_folder_of_plugins_says_what_it_brings():
    assert [*shipped_plugins()] == plugins()
    assert any(sys.modules[f"quadexp.plugins.{name}"].BRINGS for name in plugins())


@pytest.mark.parametrize("name", plugins())
def test_the_program_flies_without_it(name, checkout):
    folder, command = checkout
    shutil.rmtree(folder / "quadexp" / "plugins" / name)
    done = command("simulate", *FLIGHT, "--out", "a.parquet")
    assert done.returncode == 0, done.stderr
    listed = command("--help").stdout
    brings = sys.modules[f"quadexp.plugins.{name}"].BRINGS.get("commands", {})
    commands = set(re.findall(r"^  ([a-z-]+) ", listed, re.MULTILINE))
    assert commands >= set(BRINGS["commands"]) and not commands & set(brings)
    for word in list(brings)[:1]:
        refused = command(word, "x")
        assert refused.returncode == 2 and refused.stderr.count("\n") == 1 and word in refused.stderr, refused.stderr
        assert "Did you mean" in refused.stderr or "has it (quadexp/plugins)" in refused.stderr


@needs("logs", "check")
def test_logs_are_read_without_what_checks_them(checkout):
    from tests.plugins.logs.importers.logs import truth, ulog

    folder, command = checkout
    shutil.rmtree(folder / "quadexp" / "plugins" / "check")
    ulog(folder / "a.ulg", truth(duration=5.0))
    words = ("import", "a.ulg")
    done = command(*words, "--out", "flights")
    assert done.returncode == 0 and "not checked: no installed plug-in" in done.stdout, done.stdout + done.stderr
    for refused in (command(*words, "--bad-rows", "drop", "--out", "again"), command("import", "--describe", "a.ulg")):
        assert refused.returncode != 0 and "no installed plug-in has" in refused.stdout + refused.stderr


def test_the_core_does_its_work_without_all_of_them(checkout):
    folder, command = checkout
    shutil.rmtree(folder / "quadexp" / "plugins")
    for words in (
        ("collect", "collect.duration=20", "--out", "rows.parquet"),
        ("fit", "linear_drag", "rows.parquet", "--no-figures", "--out", "drag"),
        ("evaluate", "--sweep", "controller=nominal_mpc,linear_drag_mpc", "model=drag", *FLIGHT[1:], "--out", "a"),
        ("results", "a", "--json"),
        ("show", "drag"),
    ):
        done = command(*words)
        assert done.returncode == 0, (words, done.stderr)
    assert (folder / "a" / "results.parquet").is_file() and not (folder / "a" / "figures").exists()
    options = dict(line.split(maxsplit=1) for line in command("options").stdout.splitlines() if " " in line)
    groups = {"observer", "adaptive", "rate_loop", "delay", "battery", "ground", "import"}
    assert {"wind", "controller"} <= options.keys() and not options.keys() & groups
    there = {f"{group}/{option}" for group, names in options.items() for option in names.split()}
    assert {"controller/nominal_mpc", "wind/gust"} <= there
    assert not there & {option for name in plugins() for option in options_of(name)}
    for word in ("evaluate", "new", "collect", "fit", "show"):
        said = command(word, "--help").stdout
        assert f"quadexp {word}" in said and not [name for name in plugins() if named_in(said, name)], word
    for words, said in (
        (("simulate", *FLIGHT, "controller=pid"), "controller=pid: the plug-in quadexp/plugins/laws is not there"),
        (("evaluate", "--sweep", *FLIGHT, "--watch"), "No such option: --watch"),
        (("new", "vehicle", "racer", "--from", "a.toml"), "No such option: --from"),
        (("new", "remedy", "mine"), "new remedy: must be one of vehicle, trajectory, plant, model, controller"),
        (("simulate", *FLIGHT, "observer=disturbance"), "group (quadexp/plugins/remedies is not there)"),
        (("evaluate", "--sweep", "--figures", *FLIGHT, "--out", "again"), "--figures: no installed plug-in"),
        (("simulate", *FLIGHT, "world=everything"), "wind=dryden: the plug-in quadexp/plugins/worlds is not there"),
        (("simulate", *FLIGHT, "timing.age=0.01"), "timing.age=0.01: nothing in this configuration uses it"),
        (("evaluate", *FLIGHT, "evaluate.workers=1"), "is not used by evaluate; add --sweep"),
        (("results", "a", "--html", "a.html"), "; no installed plug-in has it (quadexp/plugins)"),
        (("show", "a", "--margins"), "No such option: --margins"),
    ):
        done = command(*words)
        assert done.returncode == 2 and said in done.stderr and done.stderr.count("\n") == 1, done.stderr


def test_fixtures_of_the_core_import_no_plugin():
    """As their modules are loaded: without that plug-in no test at all would be collected."""
    seen, waiting = set(), [*(ROOT / "tests").rglob("conftest.py")]
    while waiting:
        path = waiting.pop()
        seen.add(path)
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and node.module:
                assert not node.module.startswith("quadexp.plugins."), (path, node.module)
                file = ROOT.joinpath(*node.module.split(".")).with_suffix(".py")
                if node.module.startswith("tests.") and file.is_file() and file not in seen:
                    waiting.append(file)
    assert len(seen) > 8
