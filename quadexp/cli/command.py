"""A command: words -> request -> answer -> lines.

    @command
    def simulate(overrides: Overrides = None, out: OptionalOut = None, asked: Simulate = Simulate()) -> Answer: ...

A parameter's annotation says its help (`Ask`); a record of settings stands for an option each of its keys. Every
command has --format and --json, and returns what it found as an Answer, which is printed as they ask.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext, redirect_stdout
from dataclasses import dataclass
from functools import cached_property
from keyword import iskeyword
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import typer

from quadexp.cli.terminal import emit, fail, format_of, guarded, print_lines, print_rendered, print_table, say
from quadexp.errors import QuadexpError, UsageError
from quadexp.messages import note
from quadexp.parts.settings import Settings, declared
from quadexp.plugin import brought, shipped_places


class Ask(NamedTuple):
    """What a word or an option of the command line means. metavar: what stands for its value. flag: its names, where
    they are not the parameter's. complete: gives values from the words before and the beginning of one. least: of a
    number. word: whether it is given without a name, as is what has no default."""

    help: str
    metavar: str | None = None
    flag: str = ""
    complete: Callable[[typer.Context, str], list[str]] | None = None
    least: float | None = None
    word: bool = False


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


def complete(context: typer.Context, incomplete: str) -> list[str]:
    """Candidates for an override."""
    from quadexp.parts.listing import candidates

    return candidates(list(context.params.get("overrides") or ()), incomplete, context.params.get("conf"))


# Words and options that several commands have.
Overrides = Annotated[
    tuple[str, ...], Ask("Settings, such as trajectory.speed=8", "KEY=VALUE", complete=complete, word=True)
]
_OUT = Ask("Where to write.", "PATH", "--out -o")
Out = Annotated[Path, _OUT]
OptionalOut = Annotated[Path | None, _OUT]
Conf = Annotated[
    tuple[Path, ...],
    Ask("A configuration folder of your own, before the shipped one; repeatable, the first comes first.", "DIR"),
]
Force = Annotated[bool, Ask("Replace existing output.", flag="--force -f")]
Figures = Annotated[bool, Ask("Draw figures.", flag="--figures/--no-figures")]
PLUGINS = "Plug-ins"  # heading of commands whose module states none
FORMAT = Ask("Print json, csv, markdown or latex instead of text.", "FORMAT", "--format")
JSON = Ask("One JSON object on standard output.")


@dataclass(frozen=True)
class Command:
    """A command. function: answers it. asked: of keys of its records that need more than their meaning says. heading:
    of the help, which its module states as HEADING."""

    name: str
    function: Callable[..., Answer]
    asked: Mapping[str, Ask]
    heading: str

    @cached_property
    def alternatives(self) -> dict[str, Callable[..., Answer]]:
        """What plug-ins have this command do instead, by the parameter that asks for it."""
        prefix = f"{self.name} --"
        keys = [key for key in shipped_places("alternatives") if key.startswith(prefix)]
        names = {key: key.removeprefix(prefix) for key in keys}
        return {name + "_" * iskeyword(name): brought("alternatives", key) for key, name in names.items()}

    def typed(self) -> Callable[..., None]:
        """As a function that typer takes, whose signature has its words and options, and those of its alternatives."""
        parameters: dict[str, inspect.Parameter] = {}
        records = {}
        for function in (self.function, *self.alternatives.values()):
            hints = get_type_hints(function, include_extras=True)
            for name, parameter in inspect.signature(function).parameters.items():
                hint = hints.get(name)
                if name in parameters or name == "form":  # set from --format and --json
                    continue
                if isinstance(hint, type) and issubclass(hint, Settings):
                    records[name] = hint
                    keys = get_type_hints(hint)
                    for key, about in declared(hint).items():
                        ask = self.asked.get(key, Ask(about.setting.meaning))
                        parameters[key] = _parameter(key, keys[key], ask, about.default)
                elif hint is typer.Context:
                    parameters[name] = inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=hint)
                else:
                    arguments = get_args(hint)
                    if len(arguments) != 2 or not isinstance(arguments[1], Ask):
                        raise UsageError(
                            f"command {self.name}: {name} needs a type: {name}: Annotated[TYPE, Ask(TEXT)]"
                        )
                    kind, ask = arguments
                    parameters[name] = _parameter(name, kind, ask, parameter.default)
        parameters["form"] = _parameter("form", str | None, FORMAT, None)
        parameters["json"] = _parameter("json", bool, JSON, False)
        several = {name for name, each in parameters.items() if "list[" in str(each.annotation)}

        def run(form: str | None, json: bool, **values: Any) -> None:
            from quadexp.parts.options import given_folders

            with guarded(self.name):
                note.cache_clear()
                shown = format_of(form, json)
                values |= {key: tuple(values[key] or ()) for key in several}
                given_folders(values.get("conf"))
                for argument, record in records.items():
                    values[argument] = record(**{key: values.pop(key) for key in declared(record)})
                # What a part of the user's prints is no result.
                with nullcontext() if shown == "text" else redirect_stdout(sys.stderr):
                    answer = self._answer(values | {"form": shown})
                _print(answer, shown, self.name)

        run.__name__ = self.name
        run.__doc__ = self._help()
        run.__signature__ = inspect.Signature([*parameters.values()])  # type: ignore[attr-defined]  # which typer reads
        run.__annotations__ = {name: each.annotation for name, each in parameters.items()}
        return run

    def _answer(self, values: Mapping[str, Any]) -> Answer:
        """The answer of the command, or of the alternative that is asked for. Raises UsageError where two are, or where
        something is given that only another one takes."""
        asked = [name for name in self.alternatives if values[name]]
        if len(asked) > 1:
            raise UsageError(f"{self.name}: {' and '.join(map(_flag, asked))}: one at a time")
        function = self.alternatives[asked[0]] if asked else self.function
        takes = inspect.signature(function).parameters
        for name, value in values.items():
            if value and name not in (*takes, "form"):
                self._refuse(name, value, _flag(asked[0]) if asked else "")
        answer = function(**{name: values[name] for name in takes})
        if not isinstance(answer, Answer):
            raise UsageError(f"command {self.name}: must return an Answer, not {type(answer).__name__}")
        return answer

    def _refuse(self, name: str, value: Any, asked: str) -> None:
        """UsageError for a parameter that what was asked for does not take. asked: its option, "" for none."""
        given = _flag(name) if value is True else f"{_flag(name)} {value}"
        if isinstance(value, tuple):
            given = " ".join(map(str, value))
        if asked and name in inspect.signature(self.function).parameters:
            raise UsageError(f"{self.name}: {given}: is not used by {asked}; give that alone")
        takes = [_flag(n) for n, f in self.alternatives.items() if name in inspect.signature(f).parameters]
        raise UsageError(f"{self.name}: {given}: is for {' or '.join(takes)}")

    def _help(self) -> str:
        """Of the command, with what its alternatives say; the examples of all stand at its end."""
        texts = []
        examples = []
        for function in (self.function, *self.alternatives.values()):
            text, _, example = (inspect.getdoc(function) or "").partition("\b\n")
            texts.append(text.strip())
            examples.append(example.strip())
        shown = "\n".join(filter(None, examples))
        return "\n\n".join([*texts, f"\b\n{shown}"] if shown else texts)


def command(function: Callable[..., Answer], **asked: Ask) -> Command:
    """The function as a command under its name; `import_` is `import`."""
    name = function.__name__.rstrip("_").replace("_", "-")
    return Command(name, function, asked, function.__globals__.get("HEADING", PLUGINS))


def _flag(name: str) -> str:
    """The option of a parameter; that of `if_` is --if."""
    return f"--{name.rstrip('_').replace('_', '-')}"


def _parameter(name: str, kind: Any, ask: Ask, default: Any) -> inspect.Parameter:
    """An option, or a word. kind: of its value; a tuple is repeatable."""
    if get_origin(kind) is tuple:
        kind = list[get_args(kind)[0]]  # type: ignore[misc]  # made at run time
        if default is not inspect.Parameter.empty:
            kind = kind | None
            default = None
    options: dict[str, Any] = {"help": ask.help, "metavar": ask.metavar or ("FILE" if "Path" in str(kind) else None)}
    if ask.complete:
        options["autocompletion"] = ask.complete
    if ask.word or (default is inspect.Parameter.empty and not ask.flag):
        about: Any = typer.Argument(**options)
    else:
        about = typer.Option(*(ask.flag.split() or [_flag(name)]), **options, min=ask.least)
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, about])


def _print(answer: Answer, form: str, what: str) -> None:
    for line in answer.notes:
        say(f"note: {line}")
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


def file_rows(files: Mapping[str, Path]) -> list[dict[str, Any]]:
    """A row a file that was written."""
    return [{"file": name, "path": path} for name, path in files.items()]
