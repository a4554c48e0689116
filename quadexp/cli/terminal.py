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
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import typer

from quadexp.errors import QuadexpError
from quadexp.messages import CleanStream, clean, raw

PLAIN = {"\u00a0": " ", "\u202f": " ", "\u2013": "-", "\u2212": "-", "\u00b5": "u", "\u00b1": "+-", "\u00b7": "."}
NO_MEMORY = re.compile("can't allocate memory|Cannot allocate memory|bad_alloc")  # as libraries say it
_signals: list[int] = []  # that asked this process to end


def prepare() -> None:
    """Before any command: SIGTERM ends it as Ctrl-C does, a terminal gets what letters it can show, and no control
    characters from a file."""
    usual = {signal.SIGTERM: signal.SIG_DFL, signal.SIGINT: signal.default_int_handler}
    for number, handler in usual.items():
        if signal.getsignal(number) is handler:
            signal.signal(number, _interrupt)
    codecs.register_error("quadexp", _plain)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="quadexp")
        sys.stdout = CleanStream(sys.stdout)
    if isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr = CleanStream(sys.stderr)


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
    typer.secho(f"error: {clean(' '.join(str(message).split()))}", fg="red", file=raw(sys.stderr))
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


def console() -> Any:
    """A rich console on standard output, wide where that is no terminal; what it prints is clean like all the rest."""
    from rich.console import Console

    made = Console(file=raw(sys.stdout))
    if not made.is_terminal:
        made = Console(file=raw(sys.stdout), width=200)
    made.push_render_hook(cast(Any, _CleanHook()))
    return made


class _CleanHook:
    """Has every piece of text cleaned before rich adds its colours."""

    def process_renderables(self, renderables: list[Any]) -> list[Any]:
        return [_Clean(one) for one in renderables]


class _Clean:
    """renderable: of rich."""

    def __init__(self, renderable: Any) -> None:
        self.renderable = renderable

    def __rich_console__(self, console: Any, options: Any) -> Iterator[Any]:
        from rich.segment import Segment

        for piece in console.render(self.renderable, options):
            yield piece if piece.control else Segment(clean(piece.text), piece.style)


def print_table(table: Any) -> None:
    from quadexp.report.tables import to_rich

    out = console()
    shown = to_rich(table)
    if out.measure(shown, options=out.options.update(max_width=10_000)).maximum > out.width:
        shown = to_rich(table, stacked=True)
    out.print(shown)
    for note in table.notes:
        out.print(note, markup=False, highlight=False, soft_wrap=True)
