"""The calls of a controller as C: arrays and functions, around loop.c and vehicle.c."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.control.control_step import Call
from quadexp.control.mpc.mpc import MAX_TURN, PLAIN_ITERATIONS, TOLERANCE
from quadexp.plugins.vehicle.generate import FLOAT_TOLERANCE, Program, functions_of, written_by_hand
from quadexp.plugins.vehicle.texts import filled, named


def controller_c(exported: Program) -> str:
    """The whole text."""
    names, arrays, vehicle = exported.names, exported.arrays, exported.controller.vehicle
    functions, by_hand, (start, begun) = functions_of(exported), written_by_hand(exported), exported.start
    generated = [function for name, function in functions.values() if name not in by_hand]  # others need no work
    generated += [start] if start is not None else []
    image = arrays.contents("ram")
    begins, rom = np.trim_zeros(image, "b"), arrays.contents("rom")
    work, integers = (max([1, *sizes]) for sizes in ([f.sz_w() for f in generated], [f.sz_iw() for f in generated]))
    lines = [declared(f"{names.prefix}_{name}") for name, _ in functions.values()]
    for index, entry in enumerate(exported.calls):
        lines += called_by(exported, index, entry, functions) if entry.function is not None else []
    lines += [declared(f"{names.prefix}_{start.name()}")] if start is not None else []
    left = places(exported, begun, 0 if start is None else start.sz_res())
    values = {
        "DEFINED": "" if exported.plan is not None else "#define NO_PLAN",
        "RAM": len(image),
        "IMAGED": len(begins),
        "SUMS": len(arrays.contents("sums")),
        "ROUND": math.lcm(*(entry.every for entry in exported.calls)),
        "WORK": f"static real w[{work}];\nstatic integer iw[{integers}];" if functions or start is not None else "",
        "NUMBERS": names.literals(arrays.contents("numbers")),
        "ROM": f"static const real rom[] = {{{names.literals(rom)}}};" if rom.size else "",
        "IMAGE": names.literals(begins),
        "HOVER": names.literals(exported.hover),
        "INERTIA": matrix(exported, vehicle.inertia_matrix),
        "MIXER": matrix(exported, np.linalg.pinv(vehicle.allocation)),
        "MASS": names.literal(vehicle.mass),
        "GRAVITY": names.literal(vehicle.gravity),
        "LOW": names.literal(vehicle.thrust_min),
        "HIGH": names.literal(vehicle.thrust_max),
        "FUNCTIONS": "\n".join(lines),
        "PLAN": "\n".join(plan_lines(exported)),
        "CALLS": "\n".join(f"    {{{row(exported, i, entry)}}}," for i, entry in enumerate(exported.calls)),
        "LOOP": loop_fields(exported),
        "COMMAND": arrays.at(exported.command),
        "STARTS": 0 if start is None else start.sz_arg(),
        "STARTED": left,
        "START": "" if start is None else f"{names.prefix}_{start.name()}",
    }
    return filled("controller.c", named(exported) | values)


def matrix(exported: Program, values: np.ndarray) -> str:
    """Its rows as C."""
    return ", ".join(f"{{{exported.names.literals(line)}}}" for line in values)


def declared(name: str) -> str:
    """A function of another file."""
    return f"int {name}(const real **, real **, integer *, real *, int);"


def places(exported: Program, arrays: Sequence[np.ndarray], count: int) -> str:
    """Places of arrays as C, one at least; a generated function needs longer lists of pointers, `count` of them."""
    found = [exported.arrays.at(array) for array in arrays]
    return ", ".join(found + ["0"] * max(count - len(found), int(not found)))


def called_by(exported: Program, index: int, o: Call, functions: dict[int, tuple[str, ca.Function]]) -> list[str]:
    """The function of a call with the places of its arguments and results."""
    function: Any = o.function
    name, code = functions[id(function.function)]
    given = places(exported, [*function.arguments.values()], code.sz_arg())
    left = places(exported, [*function.results.values()], code.sz_res())
    return [
        f"static const real *given{index}[] = {{{given}}};",
        f"static real *left{index}[] = {{{left}}};",
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
    return initial({name: value for name, value in fields.items() if value != "0"})


def initial(fields: Mapping[str, str]) -> str:
    """Members of a structure, and their values."""
    return ", ".join(f".{name} = {value}" for name, value in fields.items())


def plan_lines(exported: Program) -> list[str]:
    """The MPC's step, with the arrays that it reads and leaves."""
    if exported.plan is None:
        return []
    mpc, at, names = exported.plan.mpc, exported.arrays.at, exported.names
    step = mpc.step
    nodes, inputs = step.arguments["U"].shape
    arrays = {name: step.arguments[name] for name in ("x0", "X_ref", "X", "U", "guess")}
    solved = ("checks", "X_new", "U_new", "X_lin", "U_lin", "bounded_checks", "bounded_X", "bounded_U", "side")
    arrays |= {name: step.results[name] for name in solved} | {"unprepared": exported.plan.unprepared}
    fields = {name: f"{{{name_of}, plan_given, plan_left, plan_sizes, mpc_work}}" for name, name_of in PHASES.items()}
    fields |= {"states": str(step.form.states), "inputs": str(inputs), "nodes": str(nodes)}
    fields |= {"reference_rows": str(len(step.arguments["X_ref"]))}
    tolerance = TOLERANCE if names.real == "double" else FLOAT_TOLERANCE
    fields |= {"tolerance": names.literal(tolerance), "max_turn": names.literal(MAX_TURN)}
    fields |= {name: at(array) for name, array in arrays.items()}
    steps = min(mpc.settings.initial_iterations, PLAIN_ITERATIONS)
    return [
        *(declared(phase) for phase in PHASES.values()),
        "extern real mpc_work[], mpc_rows[];",
        f"static const real *plan_given[] = {{{places(exported, [*step.arguments.values()], 0)}}};",
        f"static real *plan_left[] = {{{places(exported, [*step.results.values()], 0)}}};",
        f"static integer plan_sizes[] = {{{nodes}, {step.form.parameters}}};",
        f"enum {{ NODES = {nodes}, SAMPLES = {step.form.samples}, FULL_STEPS = {steps} }};",
        f"static real *const the_shift = {at(step.arguments['shift'])};",
        f"static const real *const the_period = {at(step.arguments['dt'])};",
        f"static mpc the_plan = {{{initial(fields)}}};",
    ]


PHASES = {"prepare": "mpc_prepare", "feedback": "mpc_feedback", "bounded": "mpc_bounded"}


def loop_fields(exported: Program) -> str:
    """What `control` of loop.c is given."""
    inputs = exported.controller.running.inputs
    names = ("state", "specific_force", "rotor_speed", "path", "yaw", "accelerometer_valid", "rotor_speed_valid")
    fields = {"calls": "calls", "calls_size": str(len(exported.calls))}
    fields |= {"inputs": "ROTORS", "plan": "&the_plan" if exported.plan is not None else "0"}
    fields |= {name: exported.arrays.at(getattr(inputs, name)) for name in names}
    fields["period"] = exported.names.literal(exported.controller.control_period)
    return initial(fields)
