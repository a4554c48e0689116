"""The C compiler: which one, with what flags, and what it says when it fails or does not come to an end."""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from quadexp.errors import QuadexpError, UsageError

# For compiling, not for linking: with -ffast-math gcc before 13 links code that turns off subnormals in the whole
# process. libmvec's vector exponential needs that flag; NaN measurements are refused before any call. Straight-line
# scalar code gets slower from being vectorised piecewise. CasADi's helper functions are global, and inlined only where
# nobody may interpose them.
FLAGS = ("-march=native", "-ffast-math", "-fno-tree-slp-vectorize", "-fno-semantic-interposition", "-fPIC")
CHOSEN = os.environ.get("QUADEXP_OPTIMISE")  # -O1: compiled in half of the time, steps in twice the time
OPTIMISED = CHOSEN or "-O3"
GCC_FLAGS = ("-fno-tree-reassoc",)  # CasADi's order of operations is the better one; clang refuses the flag
STRICT_FLAGS = ("-O3", "-march=native", "-ffp-contract=off", "-fPIC")  # for C of ours whose every operation is meant
CPUINFO = Path("/proc/cpuinfo")
PROCESSOR = {  # lines of it that name a model (x86, Arm) or features (x86; Arm; RISC-V; Power)
    "vendor_id", "cpu family", "model", "CPU implementer", "CPU variant", "CPU part",
    "flags", "Features", "isa", "cpu",
}  # fmt: skip
PATIENCE = 1800.0  # s that the compiler may take


def _words() -> list[str]:
    """The compiler's command: $CC, which may be several words such as `ccache gcc`, else gcc, clang or cc."""
    try:
        chosen = shlex.split(os.environ.get("CC", ""))
    except ValueError as error:
        raise UsageError(f"CC={os.environ['CC']}: is no command ({error})") from None
    for words in [chosen] if chosen else [["gcc"], ["clang"], ["cc"]]:
        path = shutil.which(words[0])
        if path:
            return [os.path.abspath(path), *words[1:]]
    return []


def compiler() -> str | None:
    """Path of the C compiler, or None."""
    return next(iter(_words()), None)


def not_found() -> str:
    chosen = os.environ.get("CC")
    return f"no C compiler found: CC={chosen} is not there" if chosen else "no C compiler found (gcc, clang or $CC)"


def required_compiler() -> list[str]:
    words = _words()
    if not words:
        raise UsageError(f"backend=compiled: {not_found()}; use backend=interpreted")
    return words


def run_compiler(arguments: Sequence[str], purpose: str, scratch: str | None = None) -> str:
    """What the compiler prints; raises QuadexpError where it fails, cannot be run or does not come to an end.

    scratch: private folder for its temporary files.
    """
    command = required_compiler()
    environment = os.environ | ({"TMPDIR": scratch} if scratch else {})
    try:
        done = subprocess.run(
            [*command, *arguments], check=False, capture_output=True, text=True, errors="replace", timeout=PATIENCE,
            env=environment,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        raise QuadexpError(f"{command[0]} could not {purpose}: it took longer than {PATIENCE:g} s") from None
    except OSError as error:
        raise QuadexpError(f"{command[0]} could not {purpose}: {error.strerror}") from None
    if done.returncode != 0:
        reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        raise QuadexpError(f"{command[0]} could not {purpose}: {reason}")
    return done.stdout


@cache
def _version(command: tuple[str, ...]) -> str:
    return run_compiler(["--version"], "say its version")


def compile_flags() -> tuple[str, ...]:
    is_gcc = "Free Software Foundation" in _version(tuple(required_compiler()))
    return (OPTIMISED, *FLAGS, *GCC_FLAGS) if is_gcc else (OPTIMISED, *FLAGS)


def toolchain() -> str:
    """What besides source and flags decides the binary: the whole command, its version, the processor."""
    command = required_compiler()
    return "\n".join([*command, _version(tuple(command)), _processor()])


@cache
def _processor() -> str:
    """What -march=native looks at: model and features of all cores, by name."""
    try:
        text = CPUINFO.read_text(encoding="utf-8", errors="replace")
    except OSError:
        text = ""
    known = {line for line in text.splitlines() if line.partition(":")[0].strip() in PROCESSOR}
    if not known:  # macOS; where nothing tells processors apart, each machine has its own
        try:
            ask = ["sysctl", "machdep.cpu", "hw.optional"]
            text = subprocess.run(ask, check=False, capture_output=True, text=True, errors="replace").stdout
        except OSError:
            text = ""
        known = {text or platform.node()}
    return "\n".join([platform.machine(), *sorted(known)])
