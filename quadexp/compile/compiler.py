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
FLAGS = ("-O3", "-march=native", "-ffast-math", "-fno-tree-slp-vectorize", "-fno-semantic-interposition", "-fPIC")
GCC_FLAGS = ("-fno-tree-reassoc",)  # CasADi's order of operations is the better one; clang refuses the flag
STRICT_FLAGS = ("-O2", "-ffp-contract=off", "-fPIC")  # for C of our own whose every operation is meant
PATIENCE = 1800.0  # s that the compiler may take


def _words() -> list[str]:
    """The compiler's command: $CC, which may be several words such as `ccache gcc`, else gcc, clang or cc."""
    chosen = shlex.split(os.environ.get("CC", ""))
    for words in [chosen] if chosen else [["gcc"], ["clang"], ["cc"]]:
        path = shutil.which(words[0])
        if path:
            return [path, *words[1:]]
    return []


@cache
def compiler() -> str | None:
    """Path of the C compiler, or None."""
    return next(iter(_words()), None)


def not_found() -> str:
    chosen = os.environ.get("CC")
    return f"no C compiler found: CC={chosen} is not there" if chosen else "no C compiler found (gcc, clang or $CC)"


def required_compiler() -> list[str]:
    if compiler() is None:
        raise UsageError(f"backend=compiled: {not_found()}; use backend=interpreted")
    return _words()


def run_compiler(arguments: Sequence[str], purpose: str) -> str:
    """What the compiler prints; raises QuadexpError where it fails, cannot be run or does not come to an end."""
    command = required_compiler()
    try:
        done = subprocess.run(
            [*command, *arguments], check=False, capture_output=True, text=True, timeout=PATIENCE, errors="replace"
        )
    except subprocess.TimeoutExpired:
        raise QuadexpError(f"{command[0]} could not {purpose}: it took longer than {PATIENCE:g} s") from None
    except OSError as error:
        raise QuadexpError(f"{command[0]} could not {purpose}: {error.strerror}") from None
    if done.returncode != 0:
        reason = (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        raise QuadexpError(f"{command[0]} could not {purpose}: {reason}")
    return done.stdout


@cache
def _compiler_version() -> str:
    return run_compiler(["--version"], "say its version")


@cache
def compile_flags() -> tuple[str, ...]:
    return FLAGS + GCC_FLAGS if "Free Software Foundation" in _compiler_version() else FLAGS


@cache
def toolchain() -> str:
    """What besides the source decides the binary: compiler version, flags, processor features."""
    features = platform.processor() + platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        features += next((line for line in cpuinfo.read_text().splitlines() if line.startswith("flags")), "")
    return "\n".join([_compiler_version(), " ".join(compile_flags()), features])
