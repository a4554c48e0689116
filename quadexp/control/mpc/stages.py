"""The compiled control step: stages.c, linked to the functions of one node of a model.

The object of stages.c depends on the form of the step alone, so all models share it; that of the node is what CasADi
generates of node.py's functions, with a wrapper that stages.c calls. A third one is the node in lanes: nodes 1 .. N - 1
are linearised several at a time where registers are that wide and the model has such a form, and one by one elsewhere,
as node 0 always is. The number of nodes is given at run time: all horizons use one library.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.compile.backend import CFunction, generated, linked_library
from quadexp.compile.compiler import CHOSEN
from quadexp.compile.lanes import in_lanes
from quadexp.compile.symbolic import ca
from quadexp.control.mpc.node import LENGTH_MAX, LENGTH_MIN, Form, frame_function, held_function, linearise_function
from quadexp.control.mpc.step import Arrays, aligned, array_shapes
from quadexp.models.residual import Residual
from quadexp.physics.vehicle import Vehicle

SOURCE = Path(__file__).with_name("stages.c")
KERNELS = ("riccati_scalar.c", "riccati_backward.c", "active_set.c")  # included there
PRELUDE = """#ifndef REAL
#define REAL double
#endif
#ifndef casadi_real
#define casadi_real REAL
#endif
#define HIDDEN __attribute__((visibility("hidden")))
#define WEAK __attribute__((weak))
"""
SIGNATURE = "(const casadi_real *const *given, casadi_real *const *results, casadi_real *work)"
LANES_FLAGS = ("-O1", "-ftree-vectorize")  # as fast as -O3 in half of the time: the source is written in vectors
MOST_IN_LANES = 1000  # parameters of a model; each of them is copied to all lanes in every step
PHASES = ("mpc_prepare", "mpc_feedback", "mpc_bounded")


def compiled_stages(vehicle: Vehicle, residual: Residual, form: Form) -> CompiledStages:
    """The step of a model, compiled unless the cache has it."""
    functions = node_functions(vehicle, residual, form)
    sources: list[tuple[str, tuple[str, ...]]] = [(node_source(functions), ()), (stages_source(form), ())]
    quick = CHOSEN is not None  # to compile: then without lanes
    side_by_side = lanes_source(functions[0]) if form.parameters <= MOST_IN_LANES and not quick else None
    sources += [] if side_by_side is None else [(side_by_side, LANES_FLAGS)]
    return CompiledStages(form, linked_library("mpc", *sources))


def node_functions(vehicle: Vehicle, residual: Residual, form: Form) -> list[ca.Function]:
    """The functions of a node that stages.c calls."""
    functions = [linearise_function(vehicle, residual, form, scalar=True)]
    functions += [held_function(form)] if form.deviation else []
    functions += [frame_function(form)] if form.frames else []
    return functions


def stages_source(form: Form) -> str:
    """stages.c for a form, complete: what is compiled is in its text."""
    text = SOURCE.read_text(encoding="utf-8")
    for kernel in KERNELS:
        text = text.replace(f'#include "{kernel}"\n', SOURCE.with_name(kernel).read_text(encoding="utf-8"))
    return stages_constants(form) + text


def stages_constants(form: Form) -> str:
    """What stands before stages.c for a form."""
    constants: dict[str, float] = {"LENGTH_MIN": LENGTH_MIN, "LENGTH_MAX": LENGTH_MAX}
    constants |= {"STATES": form.states, "N_INPUTS": form.inputs, "SAMPLES": form.samples, "FRAMES": int(form.frames)}
    constants |= {"LAG": int(form.lag), "DISTURBED": int(form.disturbed)}
    for kind, names in zip(("IN", "OUT"), array_shapes(form, 1), strict=True):
        constants |= {f"{kind}_{name}": place for place, name in enumerate(names)}
    return "".join(f"#define {name} {value}\n" for name, value in constants.items())


def node_source(functions: list[ca.Function]) -> str:
    """What CasADi generates of a node's functions, and each of them as stages.c calls it; others do nothing."""
    memory = max(function.sz_w() for function in functions)
    constants = f"HIDDEN const casadi_int node_memory = {memory};\nHIDDEN WEAK const casadi_int has_lanes = 0;\n"
    wrapped = {name: f"HIDDEN WEAK void node_{name}{SIGNATURE} {{}}\n" for name in ("lanes", "held", "frame")}
    wrapped |= {function.name(): _wrapped(function, function.name()) for function in functions}
    return "".join([PRELUDE, generated(functions), constants, *wrapped.values()])


def lanes_source(linearise: ca.Function) -> str | None:
    """`linearise` at several nodes at once, see compile.lanes; None where it has no such form."""
    source = PRELUDE + generated([linearise]) + _wrapped(linearise, "lanes")
    source = source.replace("linearise", "linearise_lanes")  # both are in one library
    return in_lanes(source + "HIDDEN const casadi_int has_lanes = 1;\n")


def _wrapped(f: ca.Function, name: str) -> str:
    """A function as stages.c calls it: the generated one needs longer arrays of pointers than it is given."""
    return f"""
HIDDEN void node_{name}{SIGNATURE} {{
  const casadi_real *arg[{f.sz_arg()}];
  casadi_real *res[{f.sz_res()}];
  casadi_int iw[{f.sz_iw() + 1}];
  for (int i = 0; i < {f.n_in()}; ++i) arg[i] = given[i];
  for (int i = 0; i < {f.n_out()}; ++i) res[i] = results[i];
  {f.name()}(arg, res, iw, work, 0);
}}
"""


class CompiledStages:
    """See step.Stages. library: with the functions of stages.c."""

    def __init__(self, form: Form, library: Path) -> None:
        self.form = form
        self.library = library
        self._code = ctypes.PyDLL(str(library))  # which keeps the interpreter's lock: a step is short

    def on(self, arguments: Arrays, results: Arrays) -> list[Phase]:
        """See step.Stages."""
        sizes = np.array([len(arguments["U"]), self.form.parameters], np.int64)
        self._code.mpc_memory.restype = ctypes.c_longlong
        numbers = self._code.mpc_memory(*map(ctypes.c_longlong, sizes.tolist()))
        argument_places, result_places = (
            np.array([array.ctypes.data if array.size else 0 for array in arrays.values()], np.uintp)
            for arrays in (arguments, results)
        )
        memory = [argument_places, result_places, sizes, aligned((numbers,))]
        return [Phase(getattr(self._code, name), memory) for name in PHASES]


class Phase:
    """A function of stages.c on the arrays of a step. for_c: as C calls it."""

    def __init__(self, code: Any, memory: list[np.ndarray]) -> None:
        self.for_c = CFunction(code, *memory)
        code.argtypes = [*[ctypes.c_void_p] * 4, ctypes.c_int]
        self._call: Callable[[], int] = partial(code, *(array.ctypes.data for array in memory), 0)

    def __call__(self) -> None:
        self._call()
