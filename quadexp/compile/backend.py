"""Two back ends for one CasADi function: the virtual machine, or generated C compiled once and cached.

A compiled function lies in the user's cache folder (cache.py) under the hash of its source, the flags, the whole
command of the compiler with its version, and the processor, with the hash of its own content beside it: one that does
not match is never loaded but made anew, under a lock, so that any number of processes may ask for the same one. Without
a compiler "auto" says so once and uses the virtual machine.

The numbers of a generated function, such as those of a vehicle or of a fitted model, are no part of what is compiled:
they are data of a source of their own, which is linked to the rest. So functions that differ in numbers only are
compiled once, and each further one costs the linking, a fiftieth of the time.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import re
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.cache import cache_folder, thin, unusable
from quadexp.compile.compiler import (
    STRICT_FLAGS,
    compile_flags,
    compiler,
    not_found,
    required_compiler,
    run_compiler,
    toolchain,
)
from quadexp.compile.symbolic import ca
from quadexp.errors import QuadexpError, UsageError
from quadexp.names import sha256_of
from quadexp.progress import set_status
from quadexp.writer import unfollowed, write_text, written

PRODUCT = "void casadi_mtimes_dense("  # one function for all of a library: its sums do not depend on what else is there
FORM = "numbers and parts linked"  # how libraries are made: another word where that changes
NUMBER = re.compile(r"=(-?\d\.\d{16}e[-+]\d+);")  # in generated code, but for whole ones
BACKENDS = ("auto", "compiled", "interpreted")


@cache
def _say_once(message: str) -> None:
    print(message, file=sys.stderr)


def resolve(backend: str) -> str:
    """The back end that a request gets on this machine: "compiled" or "interpreted".

    Raises UsageError for an unknown back end, or for "compiled" without a compiler.
    """
    if backend not in BACKENDS:
        raise UsageError(f"backend={backend}: allowed are {', '.join(BACKENDS)}")
    if backend == "interpreted":
        return "interpreted"
    if backend == "compiled" or compiler() is not None:
        required_compiler()
        return "compiled"
    _say_once(f"note: {not_found()}, control steps run interpreted (several times slower)")
    return "interpreted"


def realise(function: ca.Function, backend: str) -> ca.Function:
    """The function on a resolved back end. Raises QuadexpError where compiling fails."""
    return realise_together([function], backend)[0]


def realise_together(functions: Sequence[ca.Function], backend: str) -> list[ca.Function]:
    """Functions on a resolved back end, compiled into one library: what they have in common is compiled once."""
    if backend != "compiled" or not functions:
        return list(functions)
    source = generated(functions)
    if len(functions) > 1:
        source = source.replace(PRODUCT, f"__attribute__((noclone, noinline)) {PRODUCT}")
    library = _library(functions[0].name(), [(source, compile_flags())])
    try:
        from quadexp.compile.library_function import LibraryFunction

        return [LibraryFunction(function, library) for function in functions]
    except RuntimeError as error:  # which only names the last of the places where CasADi looked
        try:
            ctypes.CDLL(str(library))
        except OSError as refusal:  # a file system that executes nothing, for one
            raise _unloadable(refusal) from None
        raise QuadexpError(f"{library.name}: {error}") from None


def generated(functions: Sequence[ca.Function]) -> str:
    """C of CasADi functions."""
    generator = ca.CodeGenerator(functions[0].name(), {"with_header": False})
    for function in functions:
        generator.add(function)
    return generator.dump()


def linked_library(name: str, *sources: tuple[str, Sequence[str]]) -> Path:
    """C sources, each with flags beside the usual ones, compiled apart, each under a hash of its own in the cache, and
    linked. Raises QuadexpError where that fails."""
    return _library(name, [(source, [*compile_flags(), *flags]) for source, flags in sources])


def strict_library(name: str, *bodies: Path, loader: type[ctypes.CDLL] = ctypes.CDLL) -> ctypes.CDLL:
    """C of our own, one file behind another, compiled without any liberty in its arithmetic. Raises QuadexpError where
    that fails."""
    source = "\n".join(body.read_text(encoding="utf-8") for body in bodies)
    library = _library(name, [(source, STRICT_FLAGS)])
    try:
        return loader(str(library))
    except OSError as error:
        raise _unloadable(error) from None


def _unloadable(error: OSError) -> QuadexpError:
    path, inside = cache_folder()
    return QuadexpError(f"{error}; set QUADEXP_CACHE to another folder".replace(str(inside), str(path)))


def handwritten(
    name: str, body: Path, constants: dict[str, int], inputs: dict[str, ca.Sparsity], outputs: dict[str, ca.Sparsity]
) -> ca.Function:
    """A function whose body is C of our own: for use inside functions that get compiled, it has no interpreted form.

    body: file with statements; they find the inputs and outputs by name, as pointers to CasADi's storage (null where
    an output is not asked for), and the constants as enumeration constants.
    """
    named = ", ".join(f"{constant} = {value}" for constant, value in constants.items())
    source = f"enum {{ {named} }};\n{body.read_text()}"
    options = {"jit": False, "buffered": False}
    return ca.Function.jit(name, source, [*inputs], [*outputs], [*inputs.values()], [*outputs.values()], options)


def _library(name: str, sources: Sequence[tuple[str, Sequence[str]]]) -> Path:
    """Path of the shared library of C sources, each with its flags, made unless the cache has it."""

    def link(scratch: Path, built: Path) -> None:
        with ThreadPoolExecutor() as together:
            parts = together.map(lambda i: one_part(i, scratch), range(len(sources)))
            files = [str(file) for part in parts for file in part]
        run_compiler(["-fPIC", "-shared", *files, "-o", str(built), "-lm"], f"link {name}", str(scratch))

    def one_part(i: int, scratch: Path) -> tuple[Path, Path]:
        text, flags = sources[i]
        structure, numbers = numbers_apart(text, i)
        unlinked, data = scratch / f"built{i}.o", scratch / f"numbers{i}.c"
        if numbers or len(sources) > 1:
            unlinked.write_bytes(_cached(name, structure, flags, ".o", compiled(structure, flags)).read_bytes())
        else:
            compiled(text, flags)(scratch, unlinked)
        data.write_text(numbers, encoding="utf-8")
        return unlinked, data

    def compiled(source: str, flags: Sequence[str]) -> Callable[[Path, Path], None]:
        def make(scratch: Path, built: Path) -> None:
            set_status(f"compiling {name}, once: later flights take it from the cache")
            code = scratch / "built.c"
            code.write_text(source, encoding="utf-8")
            run_compiler([*flags, "-c", str(code), "-o", str(built)], f"compile {name}", str(scratch))

        return make

    parts = ("\n".join([*flags, source]) for source, flags in sources)
    return _cached(name, "\n".join(parts), (), ".so", link)


def numbers_apart(source: str, part: int = 0) -> tuple[str, str]:
    """Generated C without its numbers, each of which is an element of an array; and the source of that array, "" where
    there are none. part: of a library, whose parts have arrays of their own."""
    numbers, name = NUMBER.findall(source), f"casadi_numbers{part or ''}"
    if not numbers:
        return source, ""
    array = f'const double {name}[{len(numbers)}] __attribute__((visibility("hidden")))'
    places = iter(range(len(numbers)))
    structure = NUMBER.sub(lambda _: f"={name}[{next(places)}];", source)
    return f"extern {array};\n{structure}", f"extern {array};\n{array.partition(' _')[0]} = {{{', '.join(numbers)}}};\n"


def _cached(name: str, source: str, flags: Sequence[str], suffix: str, make: Callable[[Path, Path], None]) -> Path:
    """Path of what `make`, in a private folder, builds of a source, unless the cache has it."""
    key = sha256_of("\n".join([FORM, toolchain(), *flags, source]))[:24]
    folder = cache_folder()
    kept = folder.inside / f"{name}_{key}{suffix}"
    try:
        if not _intact(kept):
            with _lock(folder.inside / f"{key}.lock"):
                if not _intact(kept):
                    _build(name, make, folder.path / kept.name)
                    thin(folder, kept)
    except OSError as error:
        raise unusable(folder.path, error) from None
    with contextlib.suppress(OSError):
        os.utime(kept)  # used now
    return kept


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Only one process at a time; on a file system without locks all of them build, and the last one stays."""
    with open(path, "w", opener=unfollowed) as file:
        with contextlib.suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _build(name: str, make: Callable[[Path, Path], None], kept: Path) -> None:
    """Make in a private folder. The compiler is another process: it needs the path, not the handle."""
    with tempfile.TemporaryDirectory(dir=kept.parent, prefix=".build-", ignore_cleanup_errors=True) as scratch:
        built = Path(scratch) / f"made{kept.suffix}"
        make(Path(scratch), built)
        if not built.is_file():
            raise QuadexpError(f"{shlex.join(required_compiler())} made no library of {name}: is it a C compiler?")
        content = built.read_bytes()
    with written(kept) as file:
        file.write(content)
    write_text(kept.with_suffix(".sha256"), sha256_of(content))


def _intact(kept: Path) -> bool:
    """Whether a file of the cache is there and is, byte for byte, what was made."""
    try:
        return kept.with_suffix(".sha256").read_text() == sha256_of(kept.read_bytes())
    except (OSError, UnicodeError):
        return False


def array_for(sparsity: ca.Sparsity) -> np.ndarray:
    """Zeros for a matrix, see BufferedFunction; for one with structural zeros its other numbers in one row."""
    if sparsity.is_dense():
        rows, columns = sparsity.shape
        return np.zeros(rows) if columns == 1 else np.zeros((columns, rows))
    return np.zeros(sparsity.nnz())


class BufferedFunction:
    """A CasADi function called through preallocated arrays, without any allocation per call.

    arguments, results: dictionaries from the function's names to float arrays; a matrix (r, c) is stored as numpy
    (c, r), which is CasADi's column-major order. Fill the arguments, call, read the results.
    shared: arrays to be read as arguments of those names, such as another function's results, instead of own ones.
    into: arrays that take the results of those names, any shape of the right size, contiguous, instead of own ones.
    """

    def __init__(
        self, function: ca.Function, shared: Mapping[str, np.ndarray] | None = None,
        into: Mapping[str, np.ndarray] | None = None,
    ) -> None:  # fmt: skip
        self.function = function
        self._buffer, self._trigger = function.buffer()
        self.arguments = {}
        self.results = {}
        for i, name in enumerate(function.name_in()):
            fresh = array_for(function.sparsity_in(i))
            self.arguments[name] = argument = (shared or {}).get(name, fresh)
            if argument.shape != fresh.shape or argument.dtype != fresh.dtype or not argument.flags.c_contiguous:
                raise ValueError(f"{function.name()}: the array shared as {name} must be like {fresh.shape} floats")
            if argument.size:
                self._buffer.set_arg(i, argument.reshape(-1).data)
        for i, name in enumerate(function.name_out()):
            self.results[name] = fresh = array_for(function.sparsity_out(i))
            if into is not None and name in into:
                self.results[name] = into[name].reshape(fresh.shape)
                if fresh.size and not np.shares_memory(self.results[name], into[name]):
                    raise ValueError(f"{function.name()}: the array for {name} must be contiguous")
            if self.results[name].size:
                self._buffer.set_res(i, self.results[name].reshape(-1).data)

    def __call__(self) -> None:
        self._trigger()

    def each(self, values: np.ndarray) -> np.ndarray:
        """First result at many values of the first argument, (k, size) -> (k, result size); only of a compiled one."""
        argument, result = next(iter(self.arguments.values())), next(iter(self.results.values()))
        inputs, results = np.ascontiguousarray(values, float), np.empty((len(values), result.size))
        if inputs.shape != (len(values), argument.size) or self.for_c is None:
            raise ValueError(f"{self.function.name()}: must be compiled, the values (k, {argument.size})")
        places = (inputs.ctypes.data, argument.size, results.ctypes.data, result.size, len(inputs))
        _each().each(ctypes.byref(self.for_c), *map(ctypes.c_ssize_t, places))
        return results

    @cached_property
    def for_c(self) -> CFunction | None:
        """The same function on the same arrays, to be called from C; None where it is not compiled."""
        from quadexp.compile.library_function import LibraryFunction

        if not isinstance(self.function, LibraryFunction):
            return None
        code = getattr(ctypes.CDLL(str(self.function.library)), self.function.name())
        sizes = self.function.sz_arg(), self.function.sz_res()
        pointers = [np.zeros(size, np.uintp) for size in sizes]
        for places, arrays in zip(pointers, (self.arguments, self.results), strict=True):
            for i, array in enumerate(arrays.values()):
                places[i] = array.ctypes.data if array.size else 0
        work = np.zeros(self.function.sz_iw() + 1, np.int64), np.zeros(self.function.sz_w() + 1)
        return CFunction(code, *pointers, *work)


@cache
def _each() -> ctypes.CDLL:
    return strict_library("each", Path(__file__).with_name("each.c"))


class CFunction(ctypes.Structure):
    """A compiled function as C calls it: `call(arguments, results, iw, w, 0)`."""

    _fields_ = [(name, ctypes.c_void_p) for name in ("call", "arguments", "results", "iw", "w")]

    def __init__(self, code: Any, *arrays: np.ndarray) -> None:
        """code: of the library. arrays: addresses of the arguments and of the results, then iw and w."""
        self.arrays = arrays  # kept alive
        super().__init__(ctypes.cast(code, ctypes.c_void_p), *(array.ctypes.data for array in arrays))
