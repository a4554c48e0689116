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
from quadexp.control.mpc.mpc import MAX_TURN, PLAIN_ITERATIONS, TOLERANCE
from quadexp.control.mpc.node import Form
from quadexp.control.mpc.step import array_shapes
from quadexp.experiment.rollout import SampledReference
from quadexp.physics.state import N_STATE
from quadexp.plugins.vehicle.arrays import Arrays, span

HERE = Path(__file__).parent
STEP = ("stages.c", "riccati_scalar.c", "active_set.c")
KERNELS = (compiled_loop.SOURCE, *(stages.SOURCE.with_name(name) for name in STEP))
CHANGEABLE = ("theta", "Q", "Q_end", "R", "u_min", "u_max", "settings")  # arguments that a user may change in flight
REPLACED = {"bounded_X": "X_new", "bounded_U": "U_new"}  # results that are made when the others are read no more
LENT = ("cost", "k", "multiplier")  # results of mpc_prepare that mpc_bounded, which needs most work, reads no more
FLOAT_TOLERANCE = 1e-4  # N: bound violation that counts as none, in single precision
FUNCTIONS = (  # of math.h, that generated code and the C of the bench call
    "sqrt", "exp", "log", "log10", "fabs", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh",
    "fmax", "fmin", "pow", "floor", "ceil", "copysign", "rint", "hypot", "expm1", "log1p", "fmod", "erf",
)  # fmt: skip
SHARED: tuple[str, ...] = (
    "mpc_prepare",
    "mpc_feedback",
    "mpc_bounded",
    "node_linearise",
    "node_held",
    "node_frame",
    "node_lanes",
)
SHARED += ("node_memory", "has_lanes", "linearise", "held", "frame", "mpc_work", "mpc_rows")
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
        arrays.add(getattr(inputs, name), written=True, cleared=True)
    for memory in instant.memory:
        if kept is not None and memory is kept.memory:
            continue
        for now, after in memory.pairs:
            arrays.add_all((now, after), written=True, cleared=True)
        arrays.add(memory.now, written=True, cleared=True)
    for entry in calls:
        window = entry.kind == "window"
        arrays.add(entry.to, written=True, cleared=window, summed=entry.kind == "gather")
        arrays.add(entry.other, written=True, cleared=window)
        arrays.add(entry.source)
        arrays.add(entry.when)
        if entry.function is not None:
            for name, array in entry.function.arguments.items():
                arrays.add(array, changed=name in CHANGEABLE)
            arrays.add_all(entry.function.results.values(), written=True, cleared=True)
    if instant.plan is not None:
        mpc = instant.plan.mpc
        solved = ("x0", "X", "U", "X_ref", "U_ref", "guess")
        for name, array in mpc.step.arguments.items():
            arrays.add(array, written=name in (*solved, "shift"), cleared=name in solved, changed=name in CHANGEABLE)
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
                arrays.add(array, written=True, cleared=True)
        arrays.add(instant.plan.unprepared, written=True)
    arrays.add(instant.command, written=True)
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


# --------------------------------------------------------------------------------------------------------- small files
def real_h(names: Names) -> str:
    """Precision and names, before every other line of C."""
    lines = [
        "/* Precision, and the names that other objects see. */",
        "#include <math.h>",
        f"#define REAL {names.real}",
    ]
    lines += ["#define INTEGER int", "#define casadi_real REAL", "#define casadi_int INTEGER", "#define SCALAR"]
    if names.real == "float":
        lines += [f"#define {name} {name}f" for name in FUNCTIONS]
    lines += ["#define SUM double"]
    lines += [f"#define {name} {names.prefix}_{name}" for name in SHARED]
    return "\n".join(lines) + "\n"


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
    texts = "".join(f"#undef {name}\n" for name in FUNCTIONS if written)  # these compute in double, as their sums are
    texts += "\n".join(dict.fromkeys(written.values()))  # several functions may be of one text
    return f'#include "real.h"\n{QUIET}{renamed}{body}{texts}'


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
    """The functions of a node of the MPC."""
    return f'#include "real.h"\n{QUIET}{in_precision(node_source(exported.plan.mpc), exported.names)}'


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


def controller_h(exported: Program, about: Sequence[str], instants: int) -> str:
    """What the program around it includes. about: lines that say what it is. instants: of the recorded reference."""
    names, controller = exported.names, exported.controller
    p, P = names.prefix, names.upper
    times = ", ".join(f"{t:.6g}" for t in controller.node_times)
    places = []
    for name, array in changeable(exported):
        places.append(f"#define {P}_{name} {exported.arrays.place(array)[1]} /* {array.size} numbers */")
    said = "\n".join(f"   {line}" for line in about)
    changed = "\n".join(places) or "/* none */"
    return f"""/* A controller of quadexp.
{said}

   World east north up, body forward left up, quaternion body to world with w first, SI units. */
#ifndef {P}_CONTROLLER_H
#define {P}_CONTROLLER_H
#ifdef __cplusplus
extern "C" {{
#endif

typedef {names.real} {p}_real;
enum {{ {P}_ROTORS = {controller.vehicle.n_rotors}, {P}_ROWS = {exported.rows},
       {P}_INPUTS = {max(exported.rows - 1, 1)} }};
#define {P}_PERIOD {controller.control_period!r} /* s, between two steps */

/* The reference from now on: states (position, quaternion, velocity, body rate) and thrusts (N) at the node times; now:
   position with its derivatives up to snap, heading with two derivatives and its drift.
   Node times (s): {times} */
typedef struct {{
    {p}_real states[{P}_ROWS][{N_STATE}], inputs[{P}_INPUTS][{P}_ROTORS], path[5][3], yaw[4];
}} {p}_window;

enum {{ {P}_OK, {P}_REFUSED, {P}_FAILED }}; /* the command is one to send in every case */

/* Begin a flight. REFUSED: state or reference are no numbers. */
int {p}_reset(const {p}_real state[{N_STATE}], const {p}_window *window);

/* One step. force: of the accelerometer, body (m/s^2); speed: of the rotors (rad/s); null where not measured now.
   command: thrusts of the rotors (N), to be held for a period. REFUSED: what is measured, or the reference, are no
   numbers, nothing was changed. FAILED: no answer was found; it goes on from what it knew before. */
int {p}_step(const {p}_real state[{N_STATE}], const {p}_real *force, const {p}_real *speed, const {p}_window *window,
            {p}_real command[{P}_ROTORS]);

/* Seven numbers: body rates that are predicted for when the command begins to act, and for the node after that (rad/s),
   and the time between these (s); null of a law without a prediction. */
const {p}_real *{p}_rates(void);

/* What may be changed between two steps, at these places; a reset leaves it as it is. */
{p}_real *{p}_numbers(void);
{changed}

/* References. hold: hover at a position (m) with a heading (rad). flat: of flat outputs, the first of now, the others
   at the node times; without the air. 0, with nothing written, where they are no flight: free fall, upside down. */
typedef struct {{ {p}_real path[5][3], yaw[3]; }} {p}_output; /* position .. snap; heading, rate, acceleration */
/* table: the reference that was exported, at a control instant from 0 on; after its end the last one. */
enum {{ {P}_INSTANTS = {instants} }};
void {p}_table({p}_window *window, int instant);
void {p}_hold({p}_window *window, const {p}_real position[3], {p}_real heading);
int {p}_flat({p}_window *window, const {p}_output outputs[{P}_ROWS + 1]);

#ifdef __cplusplus
}}
#endif
#endif
"""


def table_c(exported: Program, reference: SampledReference) -> str:
    """The reference that is exported, a row an instant of its grid, with what each window takes of it."""
    names, controller = exported.names, exported.controller
    p, P, n = names.prefix, names.upper, controller.vehicle.n_rotors
    states, inputs, where = reference.horizons()
    paths, yaws = reference.path()
    starts = [span(array)[0] for array in (controller.running.inputs.path, controller.running.inputs.yaw)]
    called = [entry.function for entry in exported.calls if entry.function is not None]
    reads = {array.ctypes.data for function in called for array in function.arguments.values()}
    looks = any(first <= place < first + 120 for first in starts for place in reads)
    grid = np.column_stack([states, inputs])
    follow = np.column_stack([paths.reshape(len(paths), -1), yaws]) if looks else np.zeros((1, 1))
    rows = [("grid", grid, f"{N_STATE + n}"), ("follow", follow, f"{follow.shape[1]}")]
    lines = ['#include "real.h"', '#include "controller.h"', "#include <string.h>"]
    lines += ["typedef REAL real;", ""]
    for name, values, width in rows:
        texts = ",\n".join(f"    {{{names.literals(row)}}}" for row in values)
        lines.append(f"static const real {name}[{len(values)}][{width}] = {{\n{texts}\n}};")
    indices = ",\n".join(f"    {{{', '.join(map(str, row))}}}" for row in where.tolist())
    lines.append(f"static const int where[{where.shape[0]}][{where.shape[1]}] = {{\n{indices}\n}};")
    lines += [f"void {p}_table({p}_window *w, int instant) {{"]
    lines += [f"    const int k = instant < 0 ? 0 : instant < {P}_INSTANTS ? instant : {P}_INSTANTS - 1;"]
    lines += ["    memset(w, 0, sizeof *w);", f"    for (int i = 0; i < {P}_ROWS; i++) {{"]
    lines += ["        const real *row = grid[where[k][i]];"]
    lines += [f"        memcpy(w->states[i], row, {N_STATE} * sizeof(real));"]
    lines += [f"        if (i < {P}_ROWS - 1) memcpy(w->inputs[i], row + {N_STATE}, {n} * sizeof(real));", "    }"]
    if looks:
        lines += ["    memcpy(w->path, follow[k], 15 * sizeof(real));"]
        lines += ["    memcpy(w->yaw, follow[k] + 15, 4 * sizeof(real));", "}"]
    else:
        lines += ["    (void)follow; /* this controller reads no path and no heading */", "}"]
    return "\n".join(lines) + "\n"


def changeable(exported: Program) -> list[tuple[str, np.ndarray]]:
    """Name and array of what a user may change, each once."""
    values = dict[str, np.ndarray]()
    seen = set[int]()
    arguments = [entry.function.arguments for entry in exported.calls if entry.function is not None]
    if exported.plan is not None:
        arguments.insert(0, exported.plan.mpc.step.arguments)
    for argument in arguments:
        for name, array in argument.items():
            known = name not in CHANGEABLE or not array.size or array.ctypes.data in seen
            if known or exported.arrays.place(array)[0] != "numbers":
                continue
            seen.add(array.ctypes.data)
            values[f"{name}_{len(values)}" if name in values else name] = array
    return list(values.items())


# ------------------------------------------------------------------------------------------------------- the controller
def controller_c(exported: Program) -> str:
    """Arrays, functions and calls of a controller, around loop.c and vehicle.c."""
    names, arrays, vehicle = exported.names, exported.arrays, exported.controller.vehicle
    functions = functions_of(exported)
    image = arrays.contents("ram")
    used = np.flatnonzero(image)
    begins = image[: used[-1] + 1] if used.size else image[:0]
    by_hand = written_by_hand(exported)
    called = [function for name, function in functions.values() if name not in by_hand]  # those need no work
    called += [exported.start[0]] if exported.start[0] is not None else []
    work = max([1, *(function.sz_w() for function in called)])
    places = max([1, *(function.sz_iw() for function in called)])
    lines = ['#include "real.h"', "#define ALONE", *(["#define NO_PLAN"] if exported.plan is None else [])]
    lines += ['#include "controller.h"', '#include "loop.c"', ""]
    lines += [f"#define QX(name) {names.prefix}_##name", f"typedef {names.prefix}_window window;"]
    lines += [f"enum {{ ROTORS = {vehicle.n_rotors}, ROWS = {exported.rows}, RAM = {max(len(image), 1)} }};"]
    lines += [f"enum {{ IMAGE = {len(begins)}, ROUND = {math.lcm(*(o.every for o in exported.calls))} }};"]
    lines += ["static real ram[RAM];"]
    lines += [f"enum {{ SUMS = {len(arrays.contents('sums'))} }};", "static sum sums[SUMS + 1];"]
    lines += [f"static real w[{work}];", f"static integer iw[{places}];"] if functions or called else []
    lines += [f"static real numbers[] = {{{names.literals(arrays.contents('numbers'))}}};"]
    if len(arrays.contents("rom")):
        lines += [f"static const real rom[] = {{{names.literals(arrays.contents('rom'))}}};"]
    lines += [f"static const real image[] = {{{names.literals(begins)}}};"]
    lines += [f"static const real hover[] = {{{names.literals(exported.hover)}}};"]
    inertia = "}, {".join(names.literals(row) for row in vehicle.inertia_matrix)
    mixer = "}, {".join(names.literals(row) for row in np.linalg.pinv(vehicle.allocation))
    lines += [f"static const real inertia[3][3] = {{{{{inertia}}}}}, allocation[ROTORS][4] = {{{{{mixer}}}}};"]
    lines += [f"static const real mass = {names.literal(vehicle.mass)}, gravity = {names.literal(vehicle.gravity)};"]
    low, high = names.literal(vehicle.thrust_min), names.literal(vehicle.thrust_max)
    lines += [f"static const real thrust_min = {low}, thrust_max = {high}; /* N */", ""]
    lines += [line for name, function in functions.values() for line in declared(names, name)]
    lines += [line for i, o in enumerate(exported.calls) if o.function for line in called_by(exported, i, o, functions)]
    lines += plan_lines(exported)
    lines += ["static const step_call calls[] = {"]
    lines += [f"    {{{row(exported, i, entry)}}}," for i, entry in enumerate(exported.calls)]
    lines += ["};", loop_line(exported), *start_lines(exported)]
    lines += [f"static const real *const command_now = {arrays.at(exported.command)};", "", '#include "vehicle.c"']
    lines += ['#include "reference.c"']
    return "\n".join(lines) + "\n"


def declared(names: Names, name: str) -> list[str]:
    """A function of model.c."""
    return [f"int {names.prefix}_{name}(const real **, real **, integer *, real *, int);"]


def called_by(exported: Program, index: int, o: Call, functions: dict[int, tuple[str, ca.Function]]) -> list[str]:
    """The function of a call with the places of its arguments and results; the generated one needs longer arrays
    of pointers than these."""
    function: Any = o.function
    name, code = functions[id(function.function)]
    argument_places = [exported.arrays.at(array) for array in function.arguments.values()]
    result_places = [exported.arrays.at(array) for array in function.results.values()]
    argument_places += ["0"] * (code.sz_arg() - len(argument_places))
    result_places += ["0"] * (code.sz_res() - len(result_places))
    return [
        f"static const real *given{index}[] = {{{', '.join(argument_places) or '0'}}};",
        f"static real *left{index}[] = {{{', '.join(result_places) or '0'}}};",
        f"static const function call{index} = {{{exported.names.prefix}_{name}, given{index}, left{index}, iw, w}};",
    ]


def row(exported: Program, index: int, o: Call) -> str:
    """A call, as compiled_loop.py tells it to C."""
    at, counted = exported.arrays.at, o.to if o.to is not None else o.source
    window, count = o.kind == "window", 0
    if counted is not None:
        count = counted.strides[0] // 8 if window else counted.size
    factor = float(len(o.source)) if window and o.source is not None else o.factor
    fields = {
        "kind": o.kind.upper(),
        "every": str(o.every),
        "count": str(count),
        "factor": exported.names.literal(factor),
    }
    fields |= {"to": at(o.to), "other": at(o.other), "source": at(o.source), "when": at(o.when)}
    fields["next"] = at(o.source) if o.kind == "commit" else "0"
    if o.kind == "gather" and o.source is not None:
        fields |= dict(zip(("rows", "columns"), map(str, o.source[0].shape), strict=True))
    fields["function"] = f"&call{index}" if o.function is not None else "0"
    return ", ".join(f".{name} = {value}" for name, value in fields.items() if value != "0")


def plan_lines(exported: Program) -> list[str]:
    """The MPC's step, with the arrays that it reads and leaves."""
    if exported.plan is None:
        return []
    mpc, at, names = exported.plan.mpc, exported.arrays.at, exported.names
    step = mpc.step
    nodes, inputs = step.arguments["U"].shape
    argument_places = [at(array) for array in step.arguments.values()]
    result_places = [at(array) for array in step.results.values()]
    arrays = {name: step.arguments[name] for name in ("x0", "X_ref", "X", "U", "guess")}
    solved = ("checks", "X_new", "U_new", "X_lin", "U_lin", "bounded_checks", "bounded_X", "bounded_U", "side")
    arrays |= {name: step.results[name] for name in solved} | {"unprepared": exported.plan.unprepared}
    fields = {name: f"{{{name_of}, plan_given, plan_left, plan_sizes, mpc_work}}" for name, name_of in PHASES.items()}
    fields |= {"states": str(step.form.states), "inputs": str(inputs), "nodes": str(nodes)}
    fields |= {"reference_rows": str(len(step.arguments["X_ref"]))}
    tolerance = TOLERANCE if names.real == "double" else FLOAT_TOLERANCE
    fields |= {"tolerance": names.literal(tolerance), "max_turn": names.literal(MAX_TURN)}
    fields |= {name: at(array) for name, array in arrays.items()}
    content = ", ".join(f".{name} = {value}" for name, value in fields.items())
    steps = min(mpc.settings.initial_iterations, PLAIN_ITERATIONS)
    return [
        *(f"int {phase}(const real **, real **, integer *, real *, int);" for phase in PHASES.values()),
        "extern real mpc_work[], mpc_rows[];",
        f"static const real *plan_given[] = {{{', '.join(argument_places)}}};",
        f"static real *plan_left[] = {{{', '.join(result_places)}}};",
        f"static integer plan_sizes[] = {{{nodes}, {step.form.parameters}}};",
        f"enum {{ NODES = {nodes}, SAMPLES = {step.form.samples}, FULL_STEPS = {steps} }};",
        f"static real *const the_shift = {at(step.arguments['shift'])};",
        f"static const real *const the_period = {at(step.arguments['dt'])};",
        f"static mpc the_plan = {{{content}}};",
    ]


PHASES = {"prepare": "mpc_prepare", "feedback": "mpc_feedback", "bounded": "mpc_bounded"}


def loop_line(exported: Program) -> str:
    """What `control` of loop.c is given."""
    inputs = exported.controller.running.inputs
    names = ("state", "specific_force", "rotor_speed", "path", "yaw", "accelerometer_valid", "rotor_speed_valid")
    fields = {"calls": "calls", "calls_size": str(len(exported.calls))}
    fields |= {"inputs": "ROTORS", "plan": "&the_plan" if exported.plan is not None else "0"}
    fields |= {name: exported.arrays.at(getattr(inputs, name)) for name in names}
    fields["period"] = exported.names.literal(exported.controller.control_period)
    return "static const loop the_loop = {" + ", ".join(f".{name} = {value}" for name, value in fields.items()) + "};"


def start_lines(exported: Program) -> list[str]:
    """The function that leaves what is remembered as a flight begins."""
    function, places = exported.start
    head = "static void start(const real *state, const real *thrust) {"
    if function is None:
        return [head, "    (void)state, (void)thrust;", "}"]
    name = f"{exported.names.prefix}_{function.name()}"
    result_places = [exported.arrays.at(array) for array in places] + ["0"] * (function.sz_res() - len(places))
    return [
        f"int {name}(const real **, real **, integer *, real *, int);",
        head,
        f"    const real *given[{max(function.sz_arg(), 2)}] = {{state, thrust}};",
        f"    real *left[] = {{{', '.join(result_places)}}};",
        f"    (void){name}(given, left, iw, w, 0);",
        "}",
    ]
