"""One Composer for all tests of a process: composing from nothing costs a tenth of a second, thousands of times.

What composes is the same; only the reading of conf/ is done once. tests/parts, which is about composing itself, works
without this, and so does everything with a --conf folder.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from quadexp.parts import compose as composing

_fresh = composing.session
_kept: list[tuple[contextlib.ExitStack, composing.Composer]] = []
_shares = [True]


@contextlib.contextmanager
def session(extra: Path | None = None) -> Iterator[composing.Composer]:
    """As quadexp.parts.compose.session, with the Composer of the calls before where that is the same."""
    if extra is not None or not _shares[0]:
        while _kept:  # a session takes the place of those before it
            _kept.pop()[0].close()
        with _fresh(extra) as composer:
            yield composer
        return
    if not _kept:
        stack = contextlib.ExitStack()
        _kept.append((stack, stack.enter_context(_fresh())))
    yield _kept[0][1]


composing.session = session


@pytest.fixture(autouse=True)
def _from_nothing() -> Iterator[None]:
    """For a conftest.py to import: every test composes from nothing."""
    _shares[0] = False
    yield
    _shares[0] = True
