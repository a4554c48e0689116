"""What the command line says and how it ends: results on standard output, everything else on the error stream."""

from __future__ import annotations

import functools
import json
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import typer

from quadexp.errors import QuadexpError


def guarded(function: Callable) -> Callable:
    """Turn what goes wrong in a command into one line and an exit code: 2 usage, 1 failure."""

    @functools.wraps(function)
    def command(*args: Any, **kwargs: Any) -> Any:
        try:
            return function(*args, **kwargs)
        except QuadexpError as error:
            raise fail(error, error.exit_code) from error
        except KeyboardInterrupt as error:
            raise fail("interrupted", 1) from error
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            raise typer.Exit(1) from None
        except (typer.Exit, typer.Abort):
            raise
        except Exception as error:
            if os.environ.get("QUADEXP_DEBUG"):
                raise
            text = " ".join(str(error).split())[:300]
            message = f"{type(error).__name__}: {text} (QUADEXP_DEBUG=1 shows where)"
            raise fail(message, 1) from error

    return command


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
