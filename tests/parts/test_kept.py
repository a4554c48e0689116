"""What Hydra composed is kept between runs, is never stale, and is made anew where it was damaged."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from quadexp.errors import UsageError
from quadexp.files.cache import CONFIGURATIONS
from quadexp.parts import hydra_files
from quadexp.parts.compose import compose
from quadexp.parts.kept import MOST_FILES, KeptCompositions
from quadexp.parts.schema import conf_folder
from quadexp.parts.settings import record

ROOT = Path(__file__).resolve().parents[2]
ASKED = ["trajectory=lemniscate", "controller=gp_mpc", "trajectory.speed=7"]


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("QUADEXP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / CONFIGURATIONS


@pytest.fixture
def composed(monkeypatch):
    """What Hydra is asked to compose."""
    asked, usual = [], hydra_files.composed_files
    monkeypatch.setattr(hydra_files, "composed_files", lambda name, *rest: asked.append(name) or usual(name, *rest))
    return asked


def test_the_second_time_nothing_is_composed(cache, composed):
    first = compose(ASKED)
    assert composed and list(cache.iterdir())
    composed.clear()
    assert compose(ASKED) == first and record(compose([*ASKED, "seed=4"])) == record(first) | {"seed": 4}
    assert not composed


def test_a_changed_file_is_composed_anew(cache, composed, tmp_path):
    folder = tmp_path / "mine"
    (folder / "trajectory").mkdir(parents=True)
    file = folder / "trajectory" / "slow.yaml"
    for speed in (2.5, 3.5, 2.5):
        file.write_text(f"defaults: [circle, _self_]\nname: slow\nspeed: {speed}\n")
        assert compose(["trajectory=slow"], folder).trajectory.speed == speed
    assert len(composed) == 2  # the third is the first again


def test_a_file_of_the_folder_that_an_option_extends_counts_too(cache, tmp_path):
    folder = tmp_path / "mine"
    shutil.copytree(conf_folder() / "trajectory", folder / "trajectory")
    base = folder / "trajectory" / "base.yaml"
    (folder / "trajectory" / "mine.yaml").write_text("defaults: [base, _self_]\nname: mine\n")
    for radius in (3.0, 4.0):
        base.write_text(f"defaults: [circle, _self_]\nradius: {radius}\nspeed: 2.0\n")
        assert compose(["trajectory=mine"], folder).trajectory.radius == radius


@pytest.mark.parametrize("damage", [lambda text: text[:-5], lambda text: "", lambda text: text.replace("name", "nome")])
def test_a_damaged_entry_is_made_anew(cache, composed, damage):
    first = compose(ASKED)
    for entry in cache.iterdir():
        entry.write_text(damage(entry.read_text()))
    composed.clear()
    assert compose(ASKED) == first and composed
    composed.clear()
    assert compose(ASKED) == first and not composed


def test_where_nothing_can_be_kept_it_is_composed_every_time(monkeypatch, tmp_path, composed):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("QUADEXP_CACHE", str(tmp_path / "file" / "below"))
    assert compose(ASKED) == compose(ASKED)
    assert len(composed) == 2


def test_mistakes_are_not_kept(cache, tmp_path):
    folder = tmp_path / "mine"
    (folder / "trajectory").mkdir(parents=True)
    file = folder / "trajectory" / "odd.yaml"
    file.write_text("name: odd\nspeed: [\n")
    for _ in range(2):
        with pytest.raises(UsageError, match=r"odd.yaml, line 3, column 1: not valid YAML"):
            compose(["trajectory=odd"], folder)
    file.write_text("defaults: [circle, _self_]\nname: odd\nspeed: 3\n")
    assert compose(["trajectory=odd"], folder).trajectory.speed == 3.0


def test_what_json_cannot_hold_is_not_kept(cache, tmp_path):
    kept = KeptCompositions([tmp_path])
    for number, content in enumerate(({"a": {1: 2}}, {"a": float("nan")}, {"a": {1, 2}}, {"a": (1, 2)})):
        kept.put(["x", number], content)
        assert kept.get(["x", number]) is None
    kept.put(["x", 9], {"a": [1, 2.5, None, True, "b"]})
    assert KeptCompositions([tmp_path]).get(["x", 9]) == {"a": [1, 2.5, None, True, "b"]}


def test_a_large_folder_is_not_searched(cache, tmp_path):
    """A --conf folder may lie in a project with anything else in it."""
    for i in range(MOST_FILES + 1):
        (tmp_path / f"{i}.yaml").touch()
    kept = KeptCompositions([tmp_path])
    kept.put(["x"], {"a": 1})
    assert kept.get(["x"]) is None


def test_a_plain_command_composes_without_hydra(cache):
    code = (
        "import sys; from quadexp.parts.compose import session\n"
        f"with session() as composer: list(composer.expand({[*ASKED, 'seed=range(4)', 'controller.nodes=8,10']!r}))\n"
        "print([name for name in ('hydra', 'omegaconf', 'antlr4') if name in sys.modules])"
    )
    said = []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=dict(os.environ)
        )
        said.append(done.stdout.strip())
    assert said[1] == "[]" and "hydra" in said[0], (said, done.stderr)
