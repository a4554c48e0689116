"""A command: words -> request -> answer -> lines.

    @command
    def simulate(overrides: Overrides = None, out: OptionalOut = None, asked: Simulate = Simulate()) -> Answer: ...

A parameter's annotation says its help (`Ask`); a record of settings, such as that of `quadexp tune`, stands for an
option each of its keys. Every command has --format and --json, and returns what it found as an Answer, which is printed
as they ask.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import typer

from quadexp.cli.options import Format, Json
from quadexp.cli.terminal import emit, fail, format_of, guarded, print_lines, print_rendered, print_table, say
from quadexp.errors import QuadexpError
from quadexp.parts.settings import Settings, declared


class Ask(NamedTuple):
    """What an option of the command line means. metavar: what stands for its value. flag: its name, where that is not
    the parameter's. complete: gives values that begin with a text. least: of a number."""

    help: str
    metavar: str | None = None
    flag: str = ""
    complete: Callable[..., list[str]] | None = None
    least: float | None = None


class Answer(NamedTuple):
    """What a command found. record: for json. rows: records of one table, or tables, for the formats of tables; a
    function, where that is work. lines: texts, paths and tables for people. notes: to the error stream. failed: why
    the exit code is 1, a line each, once all is printed. texts: format -> text, of one that is not made from the rows.
    remarks: below the lines, on the error stream."""

    record: Mapping[str, Any]
    rows: Sequence[Any] | Callable[[], Sequence[Any]]
    lines: Iterable[Any]
    notes: Sequence[str] = ()
    failed: Sequence[str] = ()
    texts: Mapping[str, Callable[[], str]] = {}
    remarks: Sequence[str] = ()


def command(function: Callable[..., Answer], **asked: Ask) -> Callable[..., Any]:
    """The function as a command of typer. asked: of keys of its records that need more than their meaning says."""
    hints = get_type_hints(function, include_extras=True)
    parameters, records = [], {}
    for name, parameter in inspect.signature(function).parameters.items():
        if isinstance(hints[name], type) and issubclass(hints[name], Settings):
            records[name] = hints[name]
            for key, one in declared(hints[name]).items():
                kind = get_type_hints(hints[name])[key]
                parameters.append(_parameter(key, kind, asked.get(key, Ask(one.setting.meaning)), one.default))
        else:
            parameters.append(_of_annotation(name, hints[name], parameter.default))
    parameters += [_of_annotation("format", Format, None), _of_annotation("json", Json, False)]

    def run(format: str | None, json: bool, **given: Any) -> None:
        form = format_of(format, json)
        for name, record in records.items():
            values = {key: given.pop(key) for key in declared(record)}
            chosen = {key: value for key, value in values.items() if value is not None}
            given[name] = record(**{k: tuple(v) if isinstance(v, list) else v for k, v in chosen.items()})
        _print(function(**given), form, function.__name__.partition("_")[0])

    run.__name__, run.__doc__, run.__module__ = function.__name__, function.__doc__, function.__module__
    started = guarded(run)
    started.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # which typer reads
    started.__annotations__ = {one.name: one.annotation for one in parameters}
    return started


def _of_annotation(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    """The parameter of an annotation: as typer has it, or with an Ask."""
    extras = get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()
    ask = next((one for one in extras if isinstance(one, Ask)), None)
    if ask is not None:
        return _parameter(name, get_args(annotation)[0], ask, default)
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _parameter(name: str, kind: Any, ask: Ask, default: Any) -> inspect.Parameter:
    """An option, or an argument where there is no default. kind: of its value; a tuple is a repeatable option."""
    if get_origin(kind) is tuple:
        kind, default = list[get_args(kind)[0]] | None, None  # type: ignore[misc]  # made at run time
    metavar = ask.metavar or ("FILE" if "Path" in str(kind) else None)
    given: dict[str, Any] = {"help": ask.help, "metavar": metavar}
    if ask.complete:
        given["autocompletion"] = ask.complete
    if default is inspect.Parameter.empty:
        info: Any = typer.Argument(**given)
    else:
        flags = ask.flag.split() or [f"--{name.replace('_', '-')}"]
        info = typer.Option(*flags, **given, min=ask.least)
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, info])


def _print(answer: Answer, form: str, what: str) -> None:
    for note in answer.notes:
        say(f"note: {note}")
    if form == "json":
        emit(dict(answer.record))
    elif form in answer.texts:
        sys.stdout.write(answer.texts[form]())
    elif form != "text":
        from quadexp.report.table import Table, records_table

        rows = answer.rows() if callable(answer.rows) else answer.rows
        print_rendered(rows if not rows or isinstance(rows[0], Table) else [records_table(rows)], form, what)
    else:
        for line in answer.lines:
            if isinstance(line, (str, Path)):
                print_lines([line])
            else:
                print_table(line)
        for remark in answer.remarks:
            say(remark)
    for error in answer.failed[:-1]:
        fail(error, 1)
    if answer.failed:
        raise QuadexpError(answer.failed[-1])


def single_values(record: Mapping[str, Any]) -> dict[str, Any]:
    """What of a record fits into a row of a table: numbers and texts."""
    return {key: value for key, value in record.items() if not isinstance(value, (dict, list, tuple))}
