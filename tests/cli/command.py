"""The command line in this process."""

import io
import signal
import subprocess
import sys

from typer.testing import CliRunner

from quadexp.cli.app import app, main
from tests.deleted import skip_if_it_says_so


def run(*arguments):
    """Exit code, output, error output."""
    done = CliRunner().invoke(app, [str(argument) for argument in arguments])
    skip_if_it_says_so(done.stderr)
    return done.exit_code, done.stdout, done.stderr


def run_main(*words) -> subprocess.CompletedProcess:
    """The entry point with everything around the command: wrong options, streams, control characters, signals."""
    usual = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    streams, argv = (sys.stdout, sys.stderr), sys.argv
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    sys.stdout, sys.stderr, sys.argv = out, err, ["quadexp", *map(str, words)]
    try:
        main()
    except SystemExit as ended:
        code = ended.code
    finally:
        (sys.stdout, sys.stderr), sys.argv = streams, argv
        for number, handler in usual.items():
            signal.signal(number, handler)
    texts = [stream.buffer.getvalue().decode(errors="surrogateescape") for stream in (out, err)]
    skip_if_it_says_so(texts[1])
    return subprocess.CompletedProcess(list(words), code, *texts)
