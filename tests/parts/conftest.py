"""Every test here composes from nothing."""

from tests.composing import _from_nothing as from_nothing  # noqa: F401
