from __future__ import annotations

from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[4] / "shared" / "data"


@pytest.fixture(scope="session")
def nanobench() -> Path:
    return _folder("nanobench")


@pytest.fixture(scope="session")
def blackbird() -> Path:
    return _folder("blackbird_clover")


def _folder(name: str) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"the flights of {name} are not beside the repository (../shared/data/{name})")
    return DATA / name
