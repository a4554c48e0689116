"""Output, errors and exit codes of the command line: results go to standard output, all else to the error stream."""

from __future__ import annotations

import codecs
import contextlib
import io
import json
import math
import os
import re
import shutil
import signal
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import typer
from typer import Abort, Exit

from quadexp.cli.early import leave
from quadexp.errors import DEVICE, QuadexpError, UsageError
from quadexp.messages import CleanStream, printable, raw
from quadexp.progress import Waiting

if TYPE_CHECKING:
    from quadexp.report.table import Table

FORMATS = ("text", "json", "csv", "markdown", "latex")
PLAIN = {"\u00a0": " ", "\u202f": " ", "\u2013": "-", "\u2212": "-", "\u00b5": "u", "\u00b1": "+-", "\u00b7": "."}
NO_MEMORY = re.compile(
    "can't allocate memory|Cannot allocate memory|failed to map segment|bad_alloc|malloc of size"
)  # messages of libraries
LONGEST = 900  # letters of a message: a value may be of any length
# What is kept when a command is interrupted, and how to go on.
AGAIN = "no file is left half written: run the same command again"
GO_ON = {
    "evaluate": "what has been flown is kept: run the same command to continue",
    "import": "the logs imported so far are kept: give the others, or all with --force",
    "identify": f"{AGAIN}, with --force if it had begun to write",
    "validate": f"{AGAIN}, with --force if it had begun to write",
    "report": f"{AGAIN}, with --force if it had begun to write",
}
_signals: list[int] = []  # received signals that ask this process to end, until it is said that they did
_spent: list[bool] = []  # whether the memory was not enough


def prepare() -> None:
    """Set up the process before any command: SIGTERM ends it as Ctrl-C does, letters that a terminal cannot show are
    replaced, control characters (which a file may contain) are written out, and a stream that is closed takes what is
    printed: otherwise the next file that is opened would."""
    _signals.clear()
    for number in (signal.SIGTERM, signal.SIGINT):
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler, leave):
            signal.signal(number, _interrupt)
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            with contextlib.suppress(OSError):
                os.fstat(descriptor)
                continue
            os.open(os.devnull, os.O_RDWR)  # takes the least number that is free
            setattr(sys, name, os.fdopen(descriptor, "r" if name == "stdin" else "w"))
    codecs.register_error("quadexp", _plain)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="quadexp")
        sys.stdout = CleanStream(sys.stdout)
    if isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr = CleanStream(sys.stderr, OSError)


def _interrupt(number: int, frame: Any) -> None:
    _signals.append(number)
    raise KeyboardInterrupt


def _plain(error: UnicodeError) -> tuple[str | bytes, int]:
    """Replacement for a letter that the output cannot encode; bytes of a path that is not UTF-8 are kept."""
    assert isinstance(error, UnicodeEncodeError)
    letter = error.object[error.start]
    if "\udc80" <= letter <= "\udcff":
        return bytes([ord(letter) - 0xDC00]), error.start + 1
    return PLAIN.get(letter, "?"), error.start + 1


def end(code: int) -> NoReturn:
    """End this process. Where the memory was not enough, what libraries would do at the end could crash: it is left."""
    code = flush_output(code)
    for number in (signal.SIGTERM, signal.SIGINT):
        if signal.getsignal(number) is _interrupt:
            signal.signal(number, lambda number, frame: os._exit(code))  # what is left to do would print tracebacks
    eval("None")  # CPython ends by SIGINT, whatever the code, where one came during the last evaluation of a text
    if _spent:
        os._exit(code)
    sys.exit(code)


def flush_output(code: int) -> int:
    """Flush standard output and return the exit code of the command; 1 where the output could not be written."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        output_failed(error)
        return code or 1
    return code


def output_failed(error: OSError) -> Exit:
    """End after a failed write to standard output. A broken pipe needs no message: the reader has stopped reading."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if isinstance(error, BrokenPipeError):
        return Exit(1)
    return fail(f"the output could not be written ({error.strerror})", 1)


@contextlib.contextmanager
def guarded(command: str) -> Iterator[None]:
    """Turn every exception of a command into one line and an exit code: 2 for a wrong request, 1 for a failure."""
    try:
        with Waiting(command):
            yield
    except QuadexpError as error:
        raise (interrupted(error) if _signals else fail(error, error.exit_code)) from error
    except KeyboardInterrupt as error:
        raise _interrupted(command) from error
    except BrokenPipeError as error:
        raise output_failed(error) from None
    except (Exit, Abort):
        raise
    except OSError as error:
        if error.filename is None and error.errno in DEVICE:  # files are written by writer.py, which names them
            raise output_failed(error) from None
        raise fail(system_error(error), 1) from error
    except (Exception, SystemExit) as error:  # of a user's part
        if isinstance(error, MemoryError) or NO_MEMORY.search(str(error)):
            _spent.append(True)
            raise fail("not enough memory", 1) from error
        if _signals:  # the signal that a library has turned into an error of its own
            raise _interrupted(command) from error
        if os.environ.get("QUADEXP_DEBUG"):
            raise
        modules = sys.modules.get("quadexp.parts.user_modules")
        what = modules.fault(error) if modules else f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"
        raise fail(f"{what} (QUADEXP_DEBUG=1 shows where)", 1) from error


def _interrupted(command: str) -> Exit:
    """End after Ctrl-C or SIGTERM: what is kept, and how to go on."""
    return interrupted(f"interrupted: {GO_ON.get(command, AGAIN)}")


def interrupted(why: object) -> Exit:
    """End after Ctrl-C or SIGTERM, with the exit code that shells expect: 128 and the number of the signal."""
    number = _signals[-1] if _signals else signal.SIGINT
    _signals.clear()
    return fail(why, 128 + number)


def is_interrupted() -> bool:
    """Whether a signal has come of which nothing was said yet."""
    return bool(_signals)


def system_error(error: OSError) -> str:
    """The message of a system error, with the file it is about."""
    reason = error.strerror or str(error) or type(error).__name__
    return reason if error.filename is None else f"{os.fsdecode(error.filename)}: {reason}"


def fail(message: object, code: int) -> Exit:
    if os.environ.get("QUADEXP_DEBUG"):
        import traceback

        traceback.print_exc()
    text = printable(" ".join(str(message).split()))
    if len(text) > LONGEST:
        text = f"{text[: LONGEST * 2 // 3]} ... {text[-LONGEST // 3 :]}"
    with contextlib.suppress(OSError):
        typer.secho(f"error: {text}", fg="red", file=raw(sys.stderr))
    return Exit(code)


def say(text: str) -> None:
    """Print a message, one line, to the error stream, so that standard output holds results only."""
    text = printable(text)
    if sys.stderr.isatty():
        text = fitted(text, shutil.get_terminal_size().columns)
    print(text, file=sys.stderr, flush=True)


def print_lines(lines: Iterable[object]) -> None:
    """Print texts, paths too, a line each; on a terminal they are broken at blanks to its width, and go on below their
    text."""
    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else None
    for line in lines:
        text = printable(line)
        print(text if width is None or isinstance(line, Path) else fitted(text, width))


def fitted(line: str, width: int) -> str:
    """A line broken at blanks to a width; what follows is indented to where the text after a label begins. A table of
    Markdown and a line of one word, such as a path, are left as they are."""
    if len(line) <= width or line.lstrip().startswith("|") or " " not in line.strip():
        return line
    label = re.match(r"\s*(?:\S+(?: \S+)?\s{2,})?", line)
    indent = len(label[0]) if label and len(label[0]) <= width // 3 else 2
    words = line[indent:] if label and indent == len(label[0]) else line
    start = line[:indent] if words is not line else ""
    return textwrap.fill(
        words, width, initial_indent=start, subsequent_indent=" " * max(indent, 2),
        break_long_words=False, break_on_hyphens=False, drop_whitespace=True,
    )  # fmt: skip


def emit(record: dict[str, Any]) -> None:
    print(json.dumps(_finite(record), allow_nan=False))


def _finite(value: Any) -> Any:
    """The value as JSON types; NaN and infinity, which JSON lacks, become null."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value.item() if hasattr(value, "item") else value


def format_of(form: str | None, json: bool) -> str:
    """What --format and --json ask for: text, json, csv, markdown or latex; UsageError for anything else."""
    if form is not None and form not in FORMATS:
        raise UsageError(f"--format {form}: must be one of {', '.join(FORMATS)}")
    if json and form not in (None, "json"):
        raise UsageError(f"--json and --format {form}: give one of them")
    return "json" if json else form or "text"


def print_rendered(tables: Sequence[Table], form: str, what: str) -> None:
    """Print tables as csv, markdown or latex, a blank line between them; UsageError where there is none."""
    if not tables:
        raise UsageError(f"{what}: there is no table to print as {form}; --format json has everything")
    sys.stdout.write("\n".join(table.rendered(form) for table in tables))


def print_table(table: Table) -> None:
    """Print a table with its notes; stacked where the terminal is too narrow."""
    from rich.console import Console

    stream = raw(sys.stdout)  # tables write out control characters themselves
    out = Console(file=stream, width=None if stream.isatty() else 200, highlight=False)
    shown = table.rich()
    if out.measure(shown, options=out.options.update(max_width=10_000)).maximum > out.width:
        shown = table.rich(stacked=True)
    out.print(shown)
    print_lines(table.notes)
