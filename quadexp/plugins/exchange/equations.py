"""The whole model as equations, numbers inside: a CasADi function, Python that builds it anew, or C.

    x' = f(x, u)        x = [p (world, m), q (w first, body to world), v (world, m/s), w (body, rad/s)], (13,)
                        u = thrusts of the rotors (N), (n,)

World ENU, body FLU, quadexp.physics.rigid_body. A `.casadi` file is read by the CasADi that wrote it and newer ones;
the Python form, which any version reads, has one assignment an operation.
"""

from __future__ import annotations

import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.models.residual import no_residual
from quadexp.physics.rigid_body import corrected_function
from quadexp.physics.state import N_STATE
from quadexp.plugins.exchange.document import Target, Written
from quadexp.plugins.exchange.known import IDENTIFIED, Known, Quantity, of_file
from quadexp.plugins.exchange.simulators import body

STATE = "x = [p (world, m), q (w first, body to world), v (world, m/s), w (body, rad/s)]; world ENU, body FLU"
C_USAGE = [
    "int model(const double **arg, double **res, long long *iw, double *w, int mem): arg = {x, u}, res = {x_dot}",
    "iw and w are not used (NULL)",
]
LOST = [
    "u: thrusts in N as the curve, or the vehicle file, states them; not commands, and without limits",
    "motor lag and dead time; wind (the velocity is that of the body, in still air)",
    "noise, and how sure the model is",
]


def equations(known: Known) -> ca.Function:
    """f, (x (13,), u (n,)) -> x' (13,), from SX operations alone."""
    vehicle = known.vehicle
    residual = no_residual(vehicle) if known.model is None else known.model.residual(vehicle)
    x = ca.SX.sym("x", N_STATE)
    u = ca.SX.sym("u", vehicle.n_rotors)
    value = corrected_function(vehicle, residual).expand()(x, u, residual.theta)
    return ca.Function("model", [x, u], [ca.densify(ca.cse(value))], ["x", "u"], ["x_dot"])


def _numbers(known: Known) -> dict[str, Quantity]:
    """The vehicle's; of an identified vehicle its coefficients, of another model linear drag beside it."""
    numbers = body(known)
    numbers["rotor_position"] = of_file(known.vehicle.rotor_position, "m")
    numbers["c_tau"] = of_file(known.vehicle.torque_coefficient, "m")
    model: Any = known.model
    if hasattr(model, "models"):
        for record in model.model().records():
            half = record["high"] - record["value"]
            name = f"{record['axis']}_{record['term']}"
            numbers[name] = Quantity(record["value"], record["unit"], IDENTIFIED, half)
    elif model is not None:
        drag = known.quantity(lambda p: np.array([p.d_x, p.d_y, p.d_z]), "1/s")
        numbers["drag"] = drag._replace(note=f"linear, of the same flights; in the file is the whole {model.kind}")
    return numbers


def casadi(known: Known, path: Path) -> Written:
    """`.casadi`: the serialised function; `.py`: Python that builds it."""
    function = equations(known)
    if path.suffix == ".py":
        return Written(python_text(function), _numbers(known), LOST, whole=True)
    if path.suffix != ".casadi":
        raise UsageError(f"--out {path}: --to casadi writes .casadi, or .py, which every version of CasADi reads")
    lost = [*LOST, f"written by CasADi {ca.__version__}: an older one may not read it (--out model.py is for all)"]
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.casadi"
        function.save(str(file))
        content = file.read_bytes()
    return Written("", _numbers(known), [STATE, *lost], content, whole=True)


def c(known: Known) -> Written:
    """One C file without dependencies, with the interface of CasADi's generated code."""
    function = equations(known)
    generator = ca.CodeGenerator("model.c")
    generator.add(function)
    return Written(generator.dump(), _numbers(known), [STATE, *C_USAGE, *LOST], whole=True)


def python_text(function: ca.Function) -> str:
    """A module with `model()`, which builds the function from its operations, one a line, by their names."""
    names = {}
    for name, code in vars(import_module("casadi")).items():
        if name.startswith("OP_"):
            names[code] = name
    statements = [f"    {_statement(function, i, names)}" for i in range(function.n_instructions())]
    body = "\n".join(statements)
    return f'''"""{STATE}; u: thrusts of the rotors (N)."""
from math import inf, nan

import casadi as ca

unary, binary = ca.SX.unary, ca.SX.binary


def model():
    x, u = ca.SX.sym("x", {function.size1_in(0)}), ca.SX.sym("u", {function.size1_in(1)})
    a, y, w = [x, u], [0] * {function.size1_out(0)}, [0] * {function.sz_w()}
{body}
    return ca.Function("model", [x, u], [ca.vertcat(*y)], ["x", "u"], ["x_dot"])
'''


def _statement(function: ca.Function, i: int, names: dict[int, str]) -> str:
    """One operation of an SX function: a constant, an input, an output, or one of one or two work variables."""
    code = function.instruction_id(i)
    inputs = function.instruction_input(i)
    outputs = function.instruction_output(i)
    if code == ca.OP_CONST:
        return f"w[{outputs[0]}] = ca.SX({function.instruction_constant(i)!r})"
    if code == ca.OP_INPUT:
        return f"w[{outputs[0]}] = a[{inputs[0]}][{inputs[1]}]"
    if code == ca.OP_OUTPUT:
        return f"y[{outputs[1]}] = w[{inputs[0]}]"
    operands = ", ".join(f"w[{k}]" for k in inputs)
    return f"w[{outputs[0]}] = {'unary' if len(inputs) == 1 else 'binary'}(ca.{names[code]}, {operands})"


CASADI = Target("casadi", casadi, ".casadi", "The model as a CasADi function", asks=("path",))
C = Target("c", c, ".c", "The model as C", comment=("/*", "", "*/"))
