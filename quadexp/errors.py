"""Errors that a user can correct: one line that says what was found, where, and what is allowed."""

from __future__ import annotations

import errno
import re
from pathlib import Path

DEVICE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # failures of the device, not of the request


class QuadexpError(Exception):
    """A failure with a one-line explanation; the command line exits with `exit_code`."""

    exit_code = 1


class UsageError(QuadexpError):
    """The request itself is wrong (unknown key, value out of range, missing or refused file)."""

    exit_code = 2


class ForbiddenValueError(UsageError):
    """A value that its key does not allow, whatever the other settings are: a wrong type, or out of range."""


class ModuleError(UsageError):
    """A module of the user's cannot be imported where it is needed: it is another one there, or missing."""


class DataError(QuadexpError):
    """A file was found but cannot be used: damaged, incomplete, from another schema, or not finite."""


class WrongFileError(UsageError, DataError):
    """A file is of another kind than the one that is needed: a wrong request, not a damaged file."""


class ModelDomainError(QuadexpError):
    """A physical model was evaluated at a point where it has no solution, or more than one."""


class WriteError(QuadexpError):
    """A file could not be written because the device is full or broken: no later file could be written either."""


class RefusedWriteError(WriteError, UsageError):
    """A file could not be written because its folder does not accept files: a wrong request."""


def write_error(path: Path, error: OSError) -> WriteError:
    """The exception for a file that could not be written. Arrow gives the error number only in its message."""
    named = re.search(r"errno (\d+)", str(error))
    number = error.errno or (int(named[1]) if named else 0)
    kind = WriteError if number in DEVICE else RefusedWriteError
    return kind(f"{path}: cannot be written ({error.strerror or error})")


def stops_all(error: BaseException) -> bool:
    """Whether an error of one flight will occur in all others too, because no file can be written."""
    return isinstance(error, WriteError) or (isinstance(error, OSError) and error.errno in DEVICE)


def missing_package(what: str | Path, package: str, extra: str) -> UsageError:
    """The error for a log or a format whose package is in an extra that is not installed."""
    return UsageError(f"{what}: needs the package {package}; install it with: pip install 'quadexp[{extra}]'")
