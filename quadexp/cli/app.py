"""The command line: every command parses, makes one request, and prints the answer.

The commands of the core stand in the modules fly, learn, look and extend, and are found through quadexp/plugin.py, as
those of plug-ins. At the top they import light modules, and the rest inside the command, so that --help takes no
time.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterable
from functools import cache
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from quadexp import __version__
from quadexp.cli.command import PLUGINS, Command
from quadexp.cli.early import NOTHING
from quadexp.cli.terminal import end, fail, interrupted, is_interrupted, output_failed, prepare
from quadexp.errors import QuadexpError, UsageError
from quadexp.plugin import brought, places, shipped_places

HEADINGS = ("Fly", "Learn", "Look", "Extend", PLUGINS)  # of the help, in this order
INTERRUPTED = 130  # what typer returns for Ctrl-C


class Grouped(TyperGroup):
    """Commands in the help by what they are for."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Called by typer."""
        headings: dict[str, list[str]] = {heading: [] for heading in HEADINGS}
        for name in self.commands:
            heading = command_of(name).heading
            headings[heading if heading in headings else PLUGINS].append(name)
        for heading, names in headings.items():
            if names:
                with formatter.section(heading):
                    formatter.write_dl([(name, self.commands[name].get_short_help_str(200)) for name in names])


def command_of(name: str) -> Command:
    """The command of a name. Raises UsageError where a package from outside brings something else."""
    brought_command = brought("commands", name)
    if not isinstance(brought_command, Command):
        raise UsageError(f"command {name}: {places('commands')[name]} is no command of quadexp.cli.command")
    return brought_command


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


def application(names: Iterable[str] = ()) -> typer.Typer:
    """The program with some commands, or with all."""
    program = typer.Typer(
        cls=Grouped, name="quadexp", no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    )  # fmt: skip
    program.callback()(root)
    for name in names or places("commands"):
        program.command(name)(command_of(name).typed())
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
        asked = [word for word in sys.argv[1:2] if word in shipped_places("commands")]
        code = application(asked)(standalone_mode=False, prog_name="quadexp")
        if code == INTERRUPTED and is_interrupted():  # before the command began
            raise KeyboardInterrupt
    except (typer.Abort, KeyboardInterrupt):
        code = interrupted(NOTHING).exit_code
    except QuadexpError as error:  # of a package from outside; those of the commands themselves are guarded
        fail(str(error), error.exit_code)
        code = error.exit_code
    except OSError as error:
        code = output_failed(error).exit_code  # from help or version; the commands themselves are guarded
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        if type(error).__name__ == "NoArgsIsHelpError":
            print(error.format_message(), file=sys.stderr)
            code = 2
        else:
            fail(f"{error.format_message().rstrip('.')}{_beside(error)}", 2)
            code = getattr(error, "exit_code", 2)
    return code if isinstance(code, int) else 0


def _beside(error: Any) -> str:
    """Of an option that there is not and that has the name of a setting, how that is given; of another one, and of a
    command, that nothing is like, where it may have come from; "" otherwise."""
    from quadexp.parts.listing import key_words
    from quadexp.parts.options import groups

    name = getattr(error, "option_name", "").lstrip("-").replace("-", "_")
    if name in key_words("") or name in groups():
        return f"; a setting is given without dashes: {name}=VALUE"
    unknown = re.fullmatch(r"No such (command|option:) [^?]+", error.format_message())
    return "; no installed plug-in has it (quadexp/plugins)" if unknown else ""
