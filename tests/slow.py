"""Which of many cases of one kind run by default: those that differ most; the others in `make test-slow`."""

import pytest


def slow(*cases: object) -> list:
    """Cases of a parametrised test, each a value or a tuple of them, that run in `make test-slow` only."""
    marked = []
    for case in cases:
        values = case if isinstance(case, tuple) else (case,)
        marked.append(pytest.param(*values, marks=pytest.mark.slow))
    return marked
