"""The C of one controller: its tables, its functions, and what stands around the C of the bench.

    controller.h/.c   arrays and the table of calls, around loop.c and vehicle.c
    model.c           functions of the layers; node.c: those of a node of the MPC
    mpc.c             the MPC's step, around stages.c and what that includes
    real.h            precision and names

loop.c, stages.c and active_set.c are copies of the files that fly the bench; riccati_scalar.c, for processors without
vector registers, stands for the bench's riccati_backward.c.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import quadexp.control.compiled_loop as compiled_loop
import quadexp.control.mpc.stages as stages
from quadexp.compile.symbolic import ca
from quadexp.control.control_step import Call
from quadexp.control.mpc.node import Form
from quadexp.control.mpc.step import array_shapes
from quadexp.plugins.vehicle.arrays import Arrays, Use, span

HERE = Path(__file__).parent
STEP = ("stages.c", "riccati_scalar.c", "active_set.c")
KERNELS = (compiled_loop.SOURCE, *(stages.SOURCE.with_name(name) for name in STEP))
CHANGEABLE = ("theta", "Q", "Q_end", "R", "u_min", "u_max", "settings")  # arguments that a user may change in flight
USES = dict.fromkeys(CHANGEABLE, Use.CHANGED)  # of arguments, by name
PLAN_USES = USES | dict.fromkeys(("x0", "X", "U", "X_ref", "U_ref", "guess"), Use.WORK) | {"shift": Use.WRITTEN}
REPLACED = {"bounded_X": "X_new", "bounded_U": "U_new"}  # results that are made when the others are read no more
LENT = ("cost", "k", "multiplier")  # results of mpc_prepare that mpc_bounded, which needs most work, reads no more
FLOAT = HERE / "float.h.in"  # functions of math.h, that generated code and the C of the bench call
FLOAT_TOLERANCE = 1e-4  # N: bound violation that counts as none, in single precision
HELPERS = re.compile(  # what CasADi adds for programs that ask a library about its functions
    r"CASADI_SYMBOL_EXPORT [^\n]*_(?:checkout|release|incref|decref|n_in|n_out|default_in|name_in|name_out|sparsity_in|"
    r"sparsity_out|work|work_bytes|casadi_version|casadi_int_size|casadi_real_size)\([^)]*\)\s*"
    r"\{(?:[^{}]|\{[^{}]*\})*\}\n"
)
WORK = re.compile(r"\*sz_w = (\d+);")
TESTED = re.compile(r"\b(arg\[\d+\])\? (\1\[\d+\]) : 0")  # no argument with numbers is null: a third of the code
LITERAL = re.compile(r"(?<![\w.])(\d+\.\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?|\d+[eE][-+]?\d+)(?![\w.])")
QUIET = "".join(  # of generated code: arguments and tables that a function does not need; truth of a number
    f'#pragma GCC diagnostic ignored "-W{name}"\n'
    for name in ("unused-parameter", "unused-const-variable", "unused-function", "float-conversion")
)
QUIET += '#ifndef __clang__\n#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"\n#endif\n'


class Names(NamedTuple):
    """prefix: of all that is global. real: float or double."""

    prefix: str
    real: str

    @property
    def upper(self) -> str:
        return self.prefix.upper()

    def literal(self, value: float) -> str:
        """A number as C."""
        if not math.isfinite(value):
            raise ValueError(f"{value} is no number of a controller")
        if self.real == "float":
            value = float(np.float32(value))
        if value == int(value) and abs(value) < 1e6:
            return f"{int(value)}"
        if self.real == "double":
            return repr(float(value))
        text = f"{value:.9g}"
        return f"{text}f" if {".", "e"} & set(text) else f"{text}.0f"

    def literals(self, values: Iterable[float]) -> str:
        """Numbers of an array, which in C has one at least."""
        return ", ".join(self.literal(value) for value in values) or "0"


class Program(NamedTuple):
    """A controller as C. calls: all of them. command: where they leave it. plan: a PredictiveController, or None.
    start: see start.py. rows: of a window; shape of its inputs. hover: thrusts, (n,) (N)."""

    names: Names
    controller: Any
    calls: Sequence[Call]
    command: np.ndarray
    plan: Any
    start: tuple[ca.Function | None, list[np.ndarray]]
    rows: int
    hover: np.ndarray
    arrays: Arrays


def program(controller: Any, names: Names, start: tuple[ca.Function | None, list[np.ndarray]], hover: Any) -> Program:
    """The arrays of a controller, after a reset."""
    running, arrays = controller.running, Arrays()
    instant, inputs = running.control_step, running.inputs
    own = None if instant.plan is None else instant.plan.mpc
    kept = None if own is None or is_read(own.memory.now, instant.calls) else own
    calls = [one for one in instant.calls if kept is None or not keeps_solution(kept, one)]
    for name in ("state", "specific_force", "rotor_speed", "path", "yaw", "fresh"):
        arrays.add(getattr(inputs, name), Use.WORK)
    for memory in instant.memory:
        if kept is not None and memory is kept.memory:
            continue
        for now, after in memory.pairs:
            arrays.add_all((now, after), Use.WORK)
        arrays.add(memory.now, Use.WORK)
    for entry in calls:
        use = Use.WORK if entry.kind == "window" else Use.WRITTEN
        arrays.add(entry.to, use | Use.SUMMED if entry.kind == "gather" else use)
        arrays.add(entry.other, use)
        arrays.add(entry.source)
        arrays.add(entry.when)
        if entry.function is not None:
            for name, array in entry.function.arguments.items():
                arrays.add(array, USES.get(name, Use.READ))
            arrays.add_all(entry.function.results.values(), Use.WORK)
    if instant.plan is not None:
        mpc = instant.plan.mpc
        for name, array in mpc.step.arguments.items():
            arrays.add(array, PLAN_USES.get(name, Use.READ))
        place = node_memory(mpc)
        shapes = array_shapes(scalar_form(mpc), len(mpc.step.arguments["U"]))[1]
        for name, array in mpc.step.results.items():
            if name == "rows":
                arrays.lent[array.ctypes.data] = "mpc_rows", 0
            elif name in LENT and not is_read(array, instant.calls):
                arrays.lent[array.ctypes.data] = "mpc_work", place
                place += math.prod(shapes[name])
            elif name in REPLACED:
                arrays.shared[array.ctypes.data] = mpc.step.results[REPLACED[name]]
            else:
                arrays.add(array, Use.WORK)
        arrays.add(instant.plan.unprepared, Use.WRITTEN)
    arrays.add(instant.command, Use.WRITTEN)
    arrays.lay_out()
    rows = len(controller.node_times)
    return Program(names, controller, calls, instant.command, instant.plan, start, rows, hover, arrays)


def is_read(array: np.ndarray, calls: Iterable[Call]) -> bool:
    """Whether a call reads any of an array."""
    first, end = span(array)
    read = [one for o in calls for one in (o.source, o.when, *(o.function.arguments.values() if o.function else ()))]
    return any(first <= one.ctypes.data < end for one in read if one is not None)


def keeps_solution(mpc: Any, entry: Call) -> bool:
    """Whether a call only keeps the MPC's solution, which C has in one place: Python can go back to it."""
    solution = [mpc.step.arguments[name].ctypes.data for name in ("X", "U", "guess")]
    return entry.kind == "commit" and entry.source is not None and entry.source.ctypes.data in solution


def functions_of(exported: Program) -> dict[int, tuple[str, ca.Function]]:
    """What its calls call, by the id of the compiled function: a name in C, and the function that was compiled."""
    functions = dict[int, tuple[str, ca.Function]]()
    taken = set[str]()
    for entry in exported.calls:
        if entry.function is None or id(entry.function.function) in functions:
            continue
        origin: Any = getattr(entry.function.function, "origin", entry.function.function)
        name = f"{origin.name()}_{len(taken)}" if origin.name() in taken else origin.name()
        if name != origin.name():
            symbols = origin.mx_in()
            origin = ca.Function(name, symbols, origin.call(symbols), origin.name_in(), origin.name_out())
        taken.add(name)
        functions[id(entry.function.function)] = name, origin
    return functions


# ----------------------------------------------------------------------------------------------------------- functions
def in_precision(source: str, names: Names) -> str:
    """Code that CasADi generated, without what a program would ask a library, and without the test of each argument
    before each of its numbers is read; with literals of the precision."""
    source = TESTED.sub(r"\2", HELPERS.sub("", source))
    return LITERAL.sub(r"\1f", source) if names.real == "float" else source


def written_by_hand(exported: Program) -> dict[str, str]:
    """Functions of the layers that are written in C, by their name."""
    called: list[Any] = [entry.function for entry in exported.calls if hasattr(entry.function, "source")]
    return {entry.function.name(): entry.source for entry in called}


def model_c(exported: Program, functions: Sequence[ca.Function]) -> str:
    """The functions of the layers."""
    names = exported.names
    generator = ca.CodeGenerator(f"{names.prefix}_model", {"with_header": False})
    written = written_by_hand(exported)
    for function in functions:
        if function.name() not in written:
            generator.add(function)
    renamed = "".join(f"#define {entry.name()} {names.prefix}_{entry.name()}\n" for entry in functions)
    body = in_precision(generator.dump(), names) if functions else ""
    texts = "\n".join(dict.fromkeys(written.values()))  # several functions may be of one text
    in_double = re.sub(r"#define (\w+) .*", r"#undef \1", FLOAT.read_text(encoding="utf-8")) if written else ""
    return f'#include "real.h"\n{QUIET}{renamed}{body}{in_double}{texts}'  # written ones compute sums, in double


def scalar_form(mpc: Any) -> Form:
    """The form of the MPC's step, with rows that are not padded to vector registers."""
    return replace(mpc.step.form, width=1)


def node_source(mpc: Any) -> str:
    """The functions of a node of the MPC, as CasADi generates them."""
    return stages.node_source(stages.node_functions(mpc.vehicle, mpc.residual, scalar_form(mpc)))


def node_memory(mpc: Any) -> int:
    """Numbers of work that the code of these functions needs: less than CasADi's own functions, which copy inputs."""
    return max(int(size) for size in WORK.findall(node_source(mpc)))


def node_c(exported: Program) -> str:
    """The functions of a node of the MPC. What CasADi adds gets the prefix too: libraries are linked together."""
    own = f"#define CASADI_CODEGEN_PREFIX\n#define CODEGEN_PREFIX {exported.names.prefix}_node_\n"
    return f'#include "real.h"\n{QUIET}{own}{in_precision(node_source(exported.plan.mpc), exported.names)}'


def mpc_c(exported: Program) -> str:
    """The MPC's step. Its work is that of a node with the results that are lent to it, or that of mpc_bounded."""
    mpc = exported.plan.mpc
    nodes, form = len(mpc.step.arguments["U"]), scalar_form(mpc)
    shapes = array_shapes(form, nodes)[1]
    needed = node_memory(mpc) + sum(math.prod(shapes[name]) for name in LENT)
    return (
        f'#include "real.h"\n{stages.stages_constants(form)}#include "stages.c"\n'
        f"enum {{ NODES = {nodes}, NEEDED = {needed} }};\n"
        "extern real mpc_work[], mpc_rows[];\n"
        "real mpc_work[BOUNDED_MEMORY(NODES) > NEEDED ? BOUNDED_MEMORY(NODES) : NEEDED];\n"
        "real mpc_rows[NODES * BLOCK];\n"
    )
