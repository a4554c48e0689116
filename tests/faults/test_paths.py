"""Paths as people have them: letters that the grammar of overrides, the file system or a terminal trips over."""

import os
import stat

import pytest

from quadexp.errors import UsageError
from quadexp.parts.compose import compose, expand, session
from quadexp.writer import check_output

NAMES = (
    "a=b", "jürgen", "飛行", "a#b", "q'uo", "back\\slash", "end\\", "mix\\'x", "(copy)", "~t", "run [2]", "{x}",
    "2024_01", "007", "1e3", "true", "7", "a b", "a:b", "50%", "new\nline",
)  # fmt: skip


@pytest.fixture(scope="module")
def composer():
    with session() as composer:
        yield composer


@pytest.mark.parametrize("name", NAMES)
def test_a_path_stands_for_itself(composer, name):
    """Folders named 2024_01 and 1e3 are not the numbers 202401 and 1000."""
    assert composer.compose([f"model={name}"]).model == name
    assert composer.compose([f"model=/lab/{name}/gp"]).model == f"/lab/{name}/gp"


def test_in_a_sweep_commas_part_paths():
    cells = expand(["model=jürgen/a(1),2024_01", "controller=linear_drag_mpc", "seed=0,1"])
    assert [cell.config.model for cell in cells] == ["jürgen/a(1)"] * 2 + ["2024_01"] * 2
    assert expand(["model='a,b'", "seed=0"])[0].config.model == "a,b"
    with pytest.raises(UsageError, match="several values for one key"):
        compose(["model=a,b"])


def test_what_is_no_path_keeps_its_grammar():
    with pytest.raises(UsageError, match="signs that need quotes"):
        compose(["trajectory.speed=(8"])
    assert compose(["model=null"]).model is None


@pytest.mark.parametrize("force", [False, True])
def test_what_is_no_file_is_never_replaced(tmp_path, force):
    """--force --out /dev/null, as the superuser, would take the device away from everybody."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UsageError, match="not a file"):
        check_output(tmp_path / "pipe", force=force)
    assert stat.S_ISFIFO((tmp_path / "pipe").stat().st_mode)


@pytest.mark.parametrize("target", ["nowhere", "link"])
def test_a_link_to_nowhere_is_something_that_exists(tmp_path, target):
    (tmp_path / "link").symlink_to(tmp_path / target)
    with pytest.raises(UsageError, match="exists already"):
        check_output(tmp_path / "link")


@pytest.mark.parametrize("name", ["x" * 300, "/".join(["y" * 200] * 25)])
def test_names_that_are_too_long(tmp_path, name):
    for folder in (False, True):
        with pytest.raises(UsageError, match="cannot be written there"):
            check_output(tmp_path / name, folder=folder)


def test_a_name_that_is_not_utf_8(tmp_path):
    with pytest.raises(UsageError, match=r"Fl\\xfcge: the name is not UTF-8"):
        check_output(tmp_path / os.fsdecode(b"Fl\xfcge"))
    assert not list(tmp_path.iterdir())
