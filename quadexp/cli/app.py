"""The command line: every command parses, composes the configuration, calls one function, prints where the result is.

Each command is a module of this room. At the top it imports only typer and light modules, and the rest inside the
command, so that --help takes no time.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from quadexp import __version__
from quadexp.cli.bench import bench
from quadexp.cli.cache import cache
from quadexp.cli.check import check
from quadexp.cli.choices import options
from quadexp.cli.files import animate, compare_two, export, report, show
from quadexp.cli.fit import fit_drag, fit_gp, fit_nn
from quadexp.cli.fly import collect, evaluate, simulate
from quadexp.cli.identify import identify
from quadexp.cli.importing import import_flights
from quadexp.cli.new import new
from quadexp.cli.plot import plot
from quadexp.cli.results import results
from quadexp.cli.terminal import end, fail, output_failed, prepare
from quadexp.cli.tune import tune
from quadexp.cli.validate import validate


class Grouped(TyperGroup):
    """Commands in the help by what they are for."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Called by typer."""
        for heading, commands in GROUPS.items():
            with formatter.section(heading):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(200)) for name in commands])


app = typer.Typer(
    cls=Grouped,
    name="quadexp",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)


def _version(wanted: bool) -> None:
    if wanted:
        print(f"quadexp {__version__}")
        raise typer.Exit()


def _debug(wanted: bool) -> None:
    if wanted:
        os.environ["QUADEXP_DEBUG"] = "1"


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", callback=_debug, help="Show where an error came from.")] = False,
) -> None:
    """Fly, learn, compare: aerodynamics-aware quadrotor control, side by side on one simulation."""


INTERRUPTED = 130  # what typer returns for Ctrl-C
GROUPS: dict[str, dict[str, Callable[..., Any]]] = {
    "Fly": {"simulate": simulate, "evaluate": evaluate, "tune": tune, "bench": bench},
    "Learn": {
        "import": import_flights, "check": check, "collect": collect, "fit-gp": fit_gp, "fit-drag": fit_drag,
        "fit-nn": fit_nn, "identify": identify, "validate": validate,
    },
    "Look": {
        "show": show, "compare": compare_two, "results": results, "plot": plot, "report": report, "animate": animate,
        "export": export,
    },
    "Extend": {"options": options, "new": new, "cache": cache},
}  # fmt: skip
COMMANDS = {name: function for commands in GROUPS.values() for name, function in commands.items()}
for name, function in COMMANDS.items():
    app.command(name)(function)


def main() -> None:
    """Entry point. Wrong options, too, give one line and exit code 2."""
    prepare()
    end(_run())


def _as_setting(option: str) -> str:
    """Where an option that there is not has the name of a setting, how that is given; "" otherwise."""
    from quadexp.parts.completion import keys
    from quadexp.parts.option_files import groups

    name = option.lstrip("-").replace("-", "_")
    if name in keys("") or name in groups():
        return f"; a setting is given without dashes: {name}=VALUE"
    return ""


def _run() -> int:
    code: object
    try:
        code = app(standalone_mode=False, prog_name="quadexp")
        if code == INTERRUPTED:  # Ctrl-C before the command began
            code = fail("interrupted before anything was done: run the same command again", 1).exit_code
    except typer.Abort:
        code = 1
    except OSError as error:
        code = output_failed(error).exit_code  # from help or version; the commands themselves are guarded
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        if type(error).__name__ == "NoArgsIsHelpError":
            print(error.format_message(), file=sys.stderr)
            code = 2
        else:
            fail(f"{error.format_message()}{_as_setting(getattr(error, 'option_name', ''))}", 2)
            code = getattr(error, "exit_code", 2)
    return code if isinstance(code, int) else 0
