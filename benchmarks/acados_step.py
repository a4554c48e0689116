"""Time of one control step of acados, for `benchmarks.step`; runs in an interpreter that has acados_template.

    ACADOS_SOURCE_DIR=ACADOS python acados_step.py --problem FILE --options best

A control step is the sequence of a Python control loop: write the measured state, write the reference of every node,
run one real-time iteration, read the first input. The solver is built once; then every line on standard input runs the
problem's steps and prints one JSON line: "measure" times them one after the other, "converge" iterates some of them to
convergence. Options:

default  default options: SQP_RTI, PARTIAL_CONDENSING_HPIPM, ERK, -O2, the methods of its Python class
best     the fastest documented settings: FULL_CONDENSING_DAQP, -O3 -march=native, scalar (SX) expression graph
tuned    in addition: RK4 as a discrete SX expression, fixed Hessian, -ffast-math, prepared calls of the C interface
expert   as tuned, with the Jacobian of the RK4 step written by hand (see acados_model.chained_rk4)
hpipm    as expert, with FULL_CONDENSING_HPIPM
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import functools
import gc
import importlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from acados_model import NU, NX, Problem, chained_rk4, dynamics, load_problem, rk4

NY = NX + NU
NAME = "quadrotor"
WARM_UP_STEPS = 100
ITERATIONS_TO_CONVERGE, CONVERGE_EVERY = 30, 25


@dataclass(frozen=True)
class Options:
    """One configuration of acados; the defaults are acados's own.

    model: ERK (acados integrates), DISCRETE (a CasADi expression that acados differentiates) or CHAINED (the expression
    together with its Jacobian). direct_calls: prepared calls of the C interface in place of the Python class's methods.
    """

    qp_solver: str = "PARTIAL_CONDENSING_HPIPM"
    flags: str = "-O2"
    model: str = "ERK"
    fixed_hessian: bool = False
    direct_calls: bool = False


TUNED = {"flags": "-O3 -march=native -ffast-math", "fixed_hessian": True, "direct_calls": True}
DAQP = {"qp_solver": "FULL_CONDENSING_DAQP"}
OPTIONS = {
    "default": Options(),
    "best": Options(**DAQP, flags="-O3 -march=native"),
    "tuned": Options(**TUNED, **DAQP, model="DISCRETE"),
    "expert": Options(**TUNED, **DAQP, model="CHAINED"),
    "hpipm": Options(**TUNED, qp_solver="FULL_CONDENSING_HPIPM", model="CHAINED"),
}


def load_acados() -> Path:
    """Folder of the acados installation, its libraries loaded so that LD_LIBRARY_PATH need not be set."""
    try:
        importlib.import_module("acados_template")
    except ImportError as error:
        raise SystemExit(f"acados_template cannot be imported by {sys.executable}: {error}") from None
    folder = Path(os.environ.get("ACADOS_SOURCE_DIR", ""))
    if "ACADOS_SOURCE_DIR" not in os.environ or not (folder / "bin" / "t_renderer").exists():
        raise SystemExit("ACADOS_SOURCE_DIR must name an acados installation with lib, include and bin/t_renderer")
    for stem in ("blasfeo", "hpipm", "qpOASES_e", "daqp", "acados"):
        library = folder / "lib" / f"lib{stem}.so"
        if library.exists():
            ctypes.CDLL(str(library), mode=ctypes.RTLD_GLOBAL)
    return folder


def acados_model(problem: Problem, kind: str) -> Any:
    """The acados model, with the RK4 step in the form that kind names."""
    from acados_template import AcadosModel

    model = AcadosModel()
    model.name = NAME
    if kind == "CHAINED":
        model.x, model.u, model.disc_dyn_expr, model.disc_dyn_custom_jac_ux_expr = chained_rk4(problem)
        return model
    model.x, model.u = ca.SX.sym("x", NX), ca.SX.sym("u", NU)
    if kind == "ERK":
        model.f_expl_expr = dynamics(problem, model.x, model.u)
    else:
        model.disc_dyn_expr = rk4(problem, model.x, model.u)
    return model


def create_solver(problem: Problem, options: Options, folder: Path) -> Any:
    """Generate, compile and load the solver in folder.

    The step of the grid does not scale the stage cost: the weights are summed over the nodes as they are given.
    """
    from acados_template import AcadosOcp, AcadosOcpSolver

    ocp = AcadosOcp()
    ocp.name = NAME
    ocp.model = acados_model(problem, options.model)

    cost = ocp.cost
    cost.cost_type = cost.cost_type_e = "LINEAR_LS"
    cost.W = np.diag(np.concatenate([problem.Q, problem.R]))
    cost.W_e = problem.terminal_weight * np.diag(problem.Q)
    cost.Vx, cost.Vu, cost.Vx_e = np.eye(NY, NX), np.eye(NY, NU, -NX), np.eye(NX)
    cost.yref, cost.yref_e = np.zeros(NY), np.zeros(NX)

    ocp.constraints.idxbu = np.arange(NU)
    ocp.constraints.lbu, ocp.constraints.ubu = np.full(NU, problem.u_min), np.full(NU, problem.u_max)
    ocp.constraints.x0 = np.zeros(NX)

    settings = ocp.solver_options
    settings.N_horizon, settings.tf = problem.nodes, problem.horizon
    settings.cost_scaling = np.ones(problem.nodes + 1)
    settings.nlp_solver_type = "SQP_RTI"
    settings.qp_solver = options.qp_solver
    settings.fixed_hess = int(options.fixed_hessian)
    settings.integrator_type = "ERK" if options.model == "ERK" else "DISCRETE"

    ocp.code_gen_options.ext_fun_compile_flags = options.flags
    ocp.code_gen_options.code_export_directory = str(folder / "generated")
    return AcadosOcpSolver(ocp, json_file=str(folder / "ocp.json"), verbose=False)


# (x0 (13,), stage references (N, 17), last reference (13,), iterations) -> first input (4,)
Step = Callable[[np.ndarray, np.ndarray, np.ndarray, int], np.ndarray]


def plain_step(solver: Any, problem: Problem) -> Step:
    """The control step through the methods of AcadosOcpSolver."""
    nodes = problem.nodes

    def step(x0: np.ndarray, path: np.ndarray, last: np.ndarray, iterations: int) -> np.ndarray:
        solver.set(0, "lbx", x0)
        solver.set(0, "ubx", x0)
        for k in range(nodes):
            solver.set(k, "yref", path[k])
        solver.set(nodes, "yref", last)
        for _ in range(iterations):
            if solver.solve() != 0:
                raise RuntimeError(f"acados returned status {solver.status}")
        return solver.get(0, "u")

    return step


def direct_step(solver: Any, problem: Problem, acados_folder: Path) -> Step:
    """The control step through prepared calls of acados's C interface.

    The same C functions as behind `plain_step`, on one buffer, without the checks, conversions and look-ups of each
    set and get.
    """
    nodes = problem.nodes
    acados = ctypes.CDLL(str(acados_folder / "lib" / "libacados.so"))
    generated = ctypes.CDLL(str(solver.shared_lib_name))
    data, u0 = np.zeros(NX + nodes * NY + NX), np.zeros(NU)
    state, path_data, last_data = np.split(data, [NX, NX + nodes * NY])
    path_data, address = path_data.reshape(nodes, NY), data.ctypes.data
    config, dims, nlp_in, nlp_out = map(
        ctypes.c_void_p, (solver.nlp_config, solver.nlp_dims, solver.nlp_in, solver.nlp_out)
    )

    def prepare(function: Any, *arguments: Any) -> Callable[[], int]:
        return functools.partial(function, config, dims, *arguments)

    def at(offset: int) -> ctypes.c_void_p:
        return ctypes.c_void_p(address + data.itemsize * offset)

    first = ctypes.c_int(0)
    writes = [
        prepare(acados.ocp_nlp_constraints_model_set, nlp_in, nlp_out, first, ctypes.c_char_p(bound), at(0))
        for bound in (b"lbx", b"ubx")
    ]
    writes += [
        prepare(acados.ocp_nlp_cost_model_set, nlp_in, ctypes.c_int(k), ctypes.c_char_p(b"yref"), at(NX + k * NY))
        for k in range(nodes + 1)
    ]
    solve = functools.partial(getattr(generated, f"{NAME}_acados_solve"), ctypes.c_void_p(solver.capsule))
    into = ctypes.c_void_p(u0.ctypes.data)
    read = prepare(acados.ocp_nlp_out_get, nlp_out, first, ctypes.c_char_p(b"u"), into)

    def step(x0: np.ndarray, path: np.ndarray, last: np.ndarray, iterations: int) -> np.ndarray:
        state[:] = x0
        path_data[:] = path
        last_data[:] = last
        for write in writes:
            write()
        for _ in range(iterations):
            status = solve()
            if status != 0:
                raise RuntimeError(f"acados returned status {status}")
        read()
        return u0

    return step


def measure(solver: Any, step: Step, problem: Problem) -> dict[str, Any]:
    """All control steps in turn, warmed up on the first: seconds of each, acados's own seconds, first inputs.

    failed: steps that acados could not solve. The solver starts anew from the reference after each of them.
    """
    path, last = references(problem)
    guess_reference(solver, problem, 0)
    for _ in range(WARM_UP_STEPS):
        step(problem.states[0], path[0], last[0], 1)
    seconds, internal, inputs, failed = [], [], [], []
    gc.collect()
    gc.disable()
    for k, (x, path_k, last_k) in enumerate(zip(problem.states, path, last, strict=True)):
        began = time.perf_counter()
        try:
            u = step(x, path_k, last_k, 1)
        except RuntimeError:
            u = np.full(NU, np.nan)
            failed.append(k)
        seconds.append(time.perf_counter() - began)
        if failed and failed[-1] == k:
            guess_reference(solver, problem, k)
        internal.append(float(solver.get_stats("time_tot")))
        inputs.append(u.tolist())
    gc.enable()
    return {"seconds": seconds, "internal": internal, "u0": inputs, "failed": failed}


def phases(solver: Any, _: Step, problem: Problem) -> dict[str, Any]:
    """Seconds of all control steps' preparation (rti_phase 1) and feedback (rti_phase 2), through Python."""
    path, last = references(problem)
    guess_reference(solver, problem, 0)
    seconds: dict[str, list[float]] = {"prepare": [], "feedback": []}
    gc.collect()
    gc.disable()
    for k, x in enumerate(problem.states):
        began = time.perf_counter()
        for i, row in enumerate(path[k]):
            solver.set(i, "yref", row)
        solver.set(len(path[k]), "yref", last[k])
        solver.options_set("rti_phase", 1)
        solver.solve()
        solver.options_set("rti_phase", 2)
        between = time.perf_counter()
        solver.solve_for_x0(x, fail_on_nonzero_status=False, print_stats_on_failure=False)
        seconds["feedback"].append(time.perf_counter() - between)
        seconds["prepare"].append(between - began)
    gc.enable()
    solver.options_set("rti_phase", 0)
    return seconds


def converge(solver: Any, step: Step, problem: Problem) -> dict[str, Any]:
    """First inputs of every CONVERGE_EVERY-th step, each iterated to convergence from its reference."""
    path, last = references(problem)
    inputs = []
    for k in range(0, len(path), CONVERGE_EVERY):
        guess_reference(solver, problem, k)
        inputs.append(step(problem.states[k], path[k], last[k], ITERATIONS_TO_CONVERGE).tolist())
    return {"u0": inputs}


ANSWERS = {"measure": measure, "phases": phases, "converge": converge}


def references(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """References of the stages (K, N, 17) and of the last node (K, 13)."""
    return np.concatenate([problem.xref[:, :-1], problem.uref], axis=2), np.ascontiguousarray(problem.xref[:, -1])


def guess_reference(solver: Any, problem: Problem, k: int) -> None:
    """Make the reference of control step k the solver's guess."""
    for i, x in enumerate(problem.xref[k]):
        solver.set(i, "x", x)
    for i, u in enumerate(problem.uref[k]):
        solver.set(i, "u", u)


@contextlib.contextmanager
def quiet() -> Iterator[Any]:
    """Send standard output, C code's too, to standard error; yields a stream that is the real one."""
    sys.stdout.flush()
    real = os.dup(1)
    os.dup2(2, 1)
    with os.fdopen(real, "w") as stream:
        yield stream


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problem", type=Path, required=True, help="JSON file written by benchmarks.step")
    parser.add_argument("--options", choices=tuple(OPTIONS), default="default")
    arguments = parser.parse_args()
    acados_folder = load_acados()
    problem, options = load_problem(arguments.problem), OPTIONS[arguments.options]
    with quiet() as answers, tempfile.TemporaryDirectory() as folder:
        solver = create_solver(problem, options, Path(folder))
        step = direct_step(solver, problem, acados_folder) if options.direct_calls else plain_step(solver, problem)
        print(json.dumps({"acados": solver.ocp.code_gen_options.acados_version or "unknown"}), file=answers, flush=True)
        for line in sys.stdin:
            print(json.dumps(ANSWERS[line.strip()](solver, step, problem)), file=answers, flush=True)


if __name__ == "__main__":
    main()
