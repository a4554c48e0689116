"""The command line: every command parses, makes one request, and prints the answer.

The commands stand in the modules fly, learn, look and extend. At the top they import only light modules, and the rest
inside the command, so that --help takes no time.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import click
from click.exceptions import Abort, Exit

from quadexp import __version__
from quadexp.cli import extend, fly, learn, look
from quadexp.cli.terminal import end, fail, output_failed, prepare

GROUPS: dict[str, tuple[click.Command, ...]] = {
    "Fly": (fly.simulate, fly.evaluate, fly.tune, fly.bench),
    "Learn": (
        learn.import_, learn.check, learn.collect, learn.fit_gp, learn.fit_drag, learn.fit_nn, learn.identify,
        learn.validate,
    ),
    "Look": (look.show, look.compare, look.results, look.plot, look.report, look.animate, look.export),
    "Extend": (extend.options, extend.new, extend.cache),
}  # fmt: skip


class Grouped(click.Group):
    """Commands in the help by what they are for."""

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Called by click."""
        for heading, commands in GROUPS.items():
            with formatter.section(heading):
                formatter.write_dl([(str(each.name), each.get_short_help_str(200)) for each in commands])


def _debug(context: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    if wanted:
        os.environ["QUADEXP_DEBUG"] = "1"


def _completion(context: click.Context, parameter: click.Parameter, wanted: bool) -> None:
    """Say the line that makes the user's shell complete words."""
    if wanted:
        shell = Path(os.environ.get("SHELL", "bash")).name
        source = f"_QUADEXP_COMPLETE={shell}_source quadexp"
        print(f"{source} | source" if shell == "fish" else f'eval "$({source})"')
        print(f"put this line into the file that {shell} reads when it starts", file=sys.stderr)
        raise Exit()


@click.group(
    cls=Grouped,
    name="quadexp",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
@click.version_option(__version__, message="quadexp %(version)s", help="Print the version.")
@click.option("--debug", is_flag=True, expose_value=False, callback=_debug, help="Show where an error came from.")
@click.option(
    "--install-completion", is_flag=True, expose_value=False, is_eager=True, callback=_completion,
    help="Print the line that makes the shell complete words.",
)  # fmt: skip
def app() -> None:
    """Fly, learn, compare: aerodynamics-aware quadrotor control, side by side on one simulation."""


for command in (command for commands in GROUPS.values() for command in commands):
    app.add_command(command)


def main() -> None:
    """Entry point. Wrong options, too, give one line and exit code 2."""
    prepare()
    end(_run())


def _run() -> int:
    code: Any
    try:
        code = app(standalone_mode=False, prog_name="quadexp")
    except Abort:  # Ctrl-C before the command began
        code = fail("interrupted before anything was done: run the same command again", 1).exit_code
    except OSError as error:
        code = output_failed(error).exit_code  # from help or version; the commands themselves are guarded
    except click.exceptions.NoArgsIsHelpError as error:
        print(error.format_message(), file=sys.stderr)
        code = error.exit_code
    except click.ClickException as error:
        hint = _as_setting(getattr(error, "option_name", ""))
        code = fail(error.format_message().rstrip(".") + hint, error.exit_code).exit_code
    return code if isinstance(code, int) else 0


def _as_setting(option: str) -> str:
    """Where an option that there is not has the name of a setting, how that is given; "" otherwise."""
    from quadexp.parts.listing import key_words
    from quadexp.parts.options import groups

    name = option.lstrip("-").replace("-", "_")
    if name in key_words("") or name in groups():
        return f"; a setting is given without dashes: {name}=VALUE"
    return ""
