"""Errors a user can mend: one line that says what was found, where, and what is allowed."""

from __future__ import annotations

import errno
import re
from pathlib import Path

DEVICE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)  # the device's fault, not the request's


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


class WriteError(QuadexpError):
    """A file could not be written because the device is full or broken: what comes after it could not be either."""


class RefusedWriteError(WriteError, UsageError):
    """A file could not be written because the place takes none: a wrong request."""


def write_error(path: Path, error: OSError) -> WriteError:
    """What to raise for a file that could not be written. Arrow names the number only in its message."""
    named = re.search(r"errno (\d+)", str(error))
    number = error.errno or (int(named[1]) if named else 0)
    kind = WriteError if number in DEVICE else RefusedWriteError
    return kind(f"{path}: cannot be written ({error.strerror or error})")


def stops_all(error: BaseException) -> bool:
    """Whether an error of one flight will meet all others too: no file can be written."""
    return isinstance(error, WriteError) or (isinstance(error, OSError) and error.errno in DEVICE)
