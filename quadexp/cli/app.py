"""The command line: every command parses, makes one request, and prints the answer.

The commands stand in the modules fly, logs, learn, look and extend. At the top they import light modules, and the rest
inside the command, so that --help takes no time.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from functools import cache
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from quadexp import __version__
from quadexp.cli import extend, fly, learn, logs, look
from quadexp.cli.command import Command
from quadexp.cli.early import NOTHING
from quadexp.cli.terminal import end, fail, interrupted, is_interrupted, output_failed, prepare

GROUPS: dict[str, tuple[Command, ...]] = {
    "Fly": (fly.simulate, fly.evaluate, fly.tune, fly.bench),
    "Learn": (
        logs.import_, logs.check, learn.collect, learn.fit_gp, learn.fit_drag, learn.fit_nn, learn.identify,
        learn.validate,
    ),
    "Look": (look.show, look.compare, look.results, look.plot, look.report, look.animate, look.export),
    "Extend": (extend.options, extend.new, extend.cache),
}  # fmt: skip
COMMANDS = {each.name: each for group in GROUPS.values() for each in group}
INTERRUPTED = 130  # what typer returns for Ctrl-C


class Grouped(TyperGroup):
    """Commands in the help by what they are for."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Called by typer."""
        for heading, commands in GROUPS.items():
            with formatter.section(heading):
                names = [each.name for each in commands]
                formatter.write_dl([(name, self.commands[name].get_short_help_str(200)) for name in names])


def _version(wanted: bool) -> None:
    if wanted:
        print(f"quadexp {__version__}")
        raise typer.Exit()


def _debug(wanted: bool) -> None:
    if wanted:
        os.environ["QUADEXP_DEBUG"] = "1"


def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", callback=_debug, help="Show where an error came from.")] = False,
) -> None:
    """Fly, learn, compare: aerodynamics-aware quadrotor control, side by side on one simulation."""


def application(commands: Iterable[Command] = COMMANDS.values()) -> typer.Typer:
    """The program with these commands; all of them take 25 ms of processor time."""
    program = typer.Typer(
        cls=Grouped, name="quadexp", no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    )  # fmt: skip
    program.callback()(root)
    for each in commands:
        program.command(each.name)(each.typed())
    return program


@cache
def __getattr__(name: str) -> Any:
    if name != "app":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return application()


def main() -> None:
    """Entry point. Wrong options, too, give one line and exit code 2."""
    prepare()
    end(_run())


def _run() -> int:
    code: object
    try:
        asked = [COMMANDS[word] for word in sys.argv[1:2] if word in COMMANDS]
        code = application(asked or COMMANDS.values())(standalone_mode=False, prog_name="quadexp")
        if code == INTERRUPTED and is_interrupted():  # before the command began
            raise KeyboardInterrupt
    except (typer.Abort, KeyboardInterrupt):
        code = interrupted(NOTHING).exit_code
    except OSError as error:
        code = output_failed(error).exit_code  # from help or version; the commands themselves are guarded
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        if type(error).__name__ == "NoArgsIsHelpError":
            print(error.format_message(), file=sys.stderr)
            code = 2
        else:
            fail(f"{error.format_message().rstrip('.')}{_as_setting(getattr(error, 'option_name', ''))}", 2)
            code = getattr(error, "exit_code", 2)
    return code if isinstance(code, int) else 0


def _as_setting(option: str) -> str:
    """Where an option that there is not has the name of a setting, how that is given; "" otherwise."""
    from quadexp.parts.listing import key_words
    from quadexp.parts.options import groups

    name = option.lstrip("-").replace("-", "_")
    if name in key_words("") or name in groups():
        return f"; a setting is given without dashes: {name}=VALUE"
    return ""
