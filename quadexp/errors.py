"""Errors a user can mend: one line that says what was found, where, and what is allowed."""

from __future__ import annotations


class QuadexpError(Exception):
    """A failure with a one-line explanation; the command line exits with `exit_code`."""

    exit_code = 1


class UsageError(QuadexpError):
    """The request itself is wrong (unknown key, value out of range, missing or refused file)."""

    exit_code = 2


class DataError(QuadexpError):
    """A file was found but cannot be used: damaged, incomplete, from another schema, or not finite."""


class ModelDomainError(QuadexpError):
    """A physical model was asked for a point where it has no answer, or more than one."""
