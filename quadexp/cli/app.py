"""The command line: every command parses, composes the configuration, calls one function, prints where the result is.

Each command is a module of this room. At the top it imports only typer and light modules, and the rest inside the
command, so that --help takes no time.
"""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

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

app = typer.Typer(
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
    """Fly, learn, compare: aerodynamics-aware quadrotor control, side by side on one simulation.

    \b
    quadexp simulate    one flight                          -> runs/*.parquet
    quadexp import      logs of real flights                -> flights/*.parquet
    quadexp check       wrong units, frames or clocks in flights
    quadexp collect     flights for learning                -> data/residuals.parquet
    quadexp fit-gp      Gaussian processes from a data set  -> models/gp
    quadexp identify    thrust, drag and air from flights   -> models/*
    quadexp validate    models against flights left out of the fit
    quadexp evaluate    controllers compared                -> results/*
    quadexp tune        settings of a controller by flights -> tuned/*
    quadexp plot        results over any key                -> plot.png
    quadexp bench       controllers ranked by one protocol  -> results/bench*
    quadexp report      results as one page                 -> report.html
    quadexp options     what there is to choose and to set
    quadexp new         a part of your own                  -> my_parts/
    """


INTERRUPTED = 130  # what typer returns for Ctrl-C
COMMANDS = {
    "simulate": simulate,
    "collect": collect,
    "fit-gp": fit_gp,
    "fit-drag": fit_drag,
    "fit-nn": fit_nn,
    "evaluate": evaluate,
    "show": show,
    "check": check,
    "identify": identify,
    "import": import_flights,
    "results": results,
    "validate": validate,
    "compare": compare_two,
    "plot": plot,
    "report": report,
    "export": export,
    "animate": animate,
    "tune": tune,
    "bench": bench,
    "new": new,
    "options": options,
    "cache": cache,
}
for name, command in COMMANDS.items():
    app.command(name)(command)


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
