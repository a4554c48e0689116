"""What the command line says and how it ends: results on standard output, everything else on the error stream."""

from __future__ import annotations

import codecs
import functools
import io
import json
import math
import os
import re
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import typer

from quadexp.errors import QuadexpError

PLAIN = {"\u00a0": " ", "\u202f": " ", "\u2013": "-", "\u2212": "-", "\u00b5": "u", "\u00b1": "+-", "\u00b7": "."}
NO_MEMORY = re.compile("can't allocate memory|Cannot allocate memory|bad_alloc")  # as libraries say it
_signals: list[int] = []  # that asked this process to end


def prepare() -> None:
    """Before any command: SIGTERM ends it as Ctrl-C does, and a terminal of few letters gets what it can show."""
    usual = {signal.SIGTERM: signal.SIG_DFL, signal.SIGINT: signal.default_int_handler}
    for number, handler in usual.items():
        if signal.getsignal(number) is handler:
            signal.signal(number, _interrupt)
    codecs.register_error("quadexp", _plain)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="quadexp")


def _interrupt(number: int, frame: Any) -> None:
    _signals.append(number)
    raise KeyboardInterrupt


def _plain(error: UnicodeError) -> tuple[str | bytes, int]:
    """Bytes of a path that are no text as they came, other letters in plain ones."""
    assert isinstance(error, UnicodeEncodeError)
    letter = error.object[error.start]
    if "\udc80" <= letter <= "\udcff":
        return bytes([ord(letter) - 0xDC00]), error.start + 1
    return PLAIN.get(letter, "?"), error.start + 1


def settled(code: int) -> int:
    """The exit code of a command, once what it printed has been taken; 1 where that could not be."""
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        unwritten(error)
        return code or 1
    return code


def unwritten(error: OSError) -> typer.Exit:
    """Standard output takes no more: nothing else is sent there, and who reads no further knows why."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if isinstance(error, BrokenPipeError):
        return typer.Exit(1)
    return fail(f"the output could not be written ({error.strerror})", 1)


def guarded(function: Callable[..., Any]) -> Callable[..., Any]:
    """Turn what goes wrong in a command into one line and an exit code: 2 usage, 1 failure."""

    @functools.wraps(function)
    def command(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except QuadexpError as error:
            raise fail(error, error.exit_code) from error
        except KeyboardInterrupt as error:
            raise fail("interrupted", 1) from error
        except BrokenPipeError as error:
            raise unwritten(error) from None
        except (typer.Exit, typer.Abort):
            raise
        except OSError as error:
            raise fail(of_system(error), 1) from error
        except Exception as error:
            if isinstance(error, MemoryError) or NO_MEMORY.search(str(error)):
                raise fail("not enough memory", 1) from error
            if _signals:  # which a library took for an error of its own
                raise fail("interrupted", 1) from error
            if os.environ.get("QUADEXP_DEBUG"):
                raise
            text = " ".join(str(error).split())[:300]
            message = f"{type(error).__name__}: {text} (QUADEXP_DEBUG=1 shows where)"
            raise fail(message, 1) from error

    return command


def of_system(error: OSError) -> str:
    """What the system refused, and of which file."""
    reason = error.strerror or str(error) or type(error).__name__
    return reason if error.filename is None else f"{os.fsdecode(error.filename)}: {reason}"


def fail(message: object, code: int) -> typer.Exit:
    if os.environ.get("QUADEXP_DEBUG"):
        import traceback

        traceback.print_exc()
    typer.secho(f"error: {' '.join(str(message).split())}", fg="red", err=True)
    return typer.Exit(code)


def say(text: str) -> None:
    """A message: to the error stream, so that standard output holds results only."""
    print(text, file=sys.stderr, flush=True)


def emit(record: dict[str, Any]) -> None:
    print(json.dumps(_finite(record), allow_nan=False))


def _finite(value: Any) -> Any:
    """JSON has no NaN: null stands for it."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value.item() if hasattr(value, "item") else value


def print_table(table: Any) -> None:
    from rich.console import Console

    from quadexp.report.tables import to_rich

    console = Console()
    if not console.is_terminal:
        console = Console(width=200)
    shown = to_rich(table)
    if console.measure(shown, options=console.options.update(max_width=10_000)).maximum > console.width:
        shown = to_rich(table, stacked=True)
    console.print(shown)
    for note in table.notes:
        console.print(note, markup=False, highlight=False, soft_wrap=True)
