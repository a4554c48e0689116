"""Results of a small sweep, for tests that edit or damage them."""

import shutil

import pytest

from tests.sweeps.quick import fly


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    out = tmp_path_factory.mktemp("flown") / "r"
    fly(out)
    return out


@pytest.fixture
def folder(flown, tmp_path):
    shutil.copytree(flown, tmp_path / "r")
    return tmp_path / "r"
