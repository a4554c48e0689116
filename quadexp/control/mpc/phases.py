"""Preparation and feedback: a control step of which only the second phase waits for the measurement.

What does not depend on the measured state is computed before it comes (control.mpc.step); the answer then takes the
linearisation of one node and the forward pass. Both phases work on the arrays of the whole step, so that the bounded
subproblem, the last solution and a whole step at any time go on from there.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction
from quadexp.compile.symbolic import ca
from quadexp.control.built import built
from quadexp.control.mpc.step import phase_functions
from quadexp.models.residual import Residual
from quadexp.physics.vehicle import Vehicle

FROM_NODE_1 = ("X_lin", "A", "B", "b", "q", "K", "factor")  # what the preparation leaves of the subproblem's arrays
AT_NODE_0 = ("X_lin", "A", "B", "b", "q", "factor")  # and the feedback


class Phases:
    """prepare, then feedback: called one after the other they leave in the step's results what the step leaves.

    step: the whole step, whose arguments and results they share. form: of its structure, see `step_function`.
    """

    def __init__(
        self, step: BufferedFunction, vehicle: Vehicle, residual: Residual, nodes: int, backend: str, **form: Any
    ) -> None:
        form |= {"scalar": backend == "compiled"}
        prepare, feedback = built(backend, phase_functions, vehicle, residual, nodes, **form)
        given, results = step.arguments, step.results

        def place(function: ca.Function, name: str, *, last: bool) -> np.ndarray:
            size = function.nnz_out(name)
            return results[name].ravel()[-size:] if last else results[name].ravel()[:size]

        whole = {name: results[name] for name in ("U_lin", "r", "frames") if name in results}
        into = whole | {name: place(prepare, name, last=True) for name in FROM_NODE_1}
        self.prepare = BufferedFunction(prepare, given, into)
        known = {f"{name}_prepared": array for name, array in self.prepare.results.items()}
        into = {name: results[name] for name in ("X_new", "U_new", "checks")}
        into |= {name: place(feedback, name, last=False) for name in AT_NODE_0}
        self.feedback = BufferedFunction(feedback, given | known, into)
