"""The control step in CasADi's virtual machine: the functions of one node (node.py), one call after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any

import numpy as np

from quadexp.compile.backend import BufferedFunction, array_for
from quadexp.compile.symbolic import ca
from quadexp.control.mpc import node
from quadexp.control.mpc.active_set import InterpretedSolver
from quadexp.control.mpc.attitude_error import attitude_error_in, reference_frames
from quadexp.control.mpc.node import LENGTH_MAX, LENGTH_MIN, Form
from quadexp.control.mpc.prediction import held_deviation
from quadexp.control.mpc.step import Arrays, array_shapes
from quadexp.models.residual import Residual
from quadexp.physics.expression import Expression, dense_function, limited, named_symbols
from quadexp.physics.state import ATTITUDE
from quadexp.physics.vehicle import Vehicle

COMMON = ("x0", "theta", "tau", "disturbance", "u_min", "u_max")  # arguments that all nodes have


class InterpretedStages:
    """See step.Stages."""

    def __init__(self, vehicle: Vehicle, residual: Residual, form: Form) -> None:
        self.form = form
        self.linearise = node.linearise_function(vehicle, residual, form, scalar=False)
        self.start = node.start_function(form)
        self.backward = node.backward_function(form)
        self.forward = node.forward_function(form)

    def on(self, arguments: Arrays, results: Arrays) -> list[Callable[[], None]]:
        """See step.Stages."""
        loops = _Loops(self, arguments, results)
        return [loops.prepare, loops.feedback, InterpretedSolver(self.form, arguments | results)]


class _Loops:
    """The two phases on the arrays of a step, and on arrays of its own for what passes from node to node."""

    def __init__(self, stages: InterpretedStages, arguments: Arrays, results: Arrays) -> None:
        nodes = len(arguments["U"])
        m = stages.form.states
        shapes = {"P": (m, m), "p": (m,), "multiplier": (m,), "kkt": (1,), "dX": (m,), "extremes": (2,)}
        of_nodes = {name: np.zeros((nodes + 1, *shape)) for name, shape in shapes.items()}
        self._a = arguments | results | of_nodes
        self._a["extremes"][0] = -np.inf
        guess = guess_function(stages.form, nodes)
        behind = {name: results[name][1:] for name in ("X_lin", "q")}
        self._guess = [BufferedFunction(guess, arguments, results | behind), self._at(stages.linearise, 1, nodes - 1)]
        self._back = [self._at(stages.backward, k) for k in range(nodes - 1, 0, -1)]
        self._forth = [self._at(function, 0) for function in (stages.start, stages.linearise, stages.backward)]
        self._forth += [self._at(stages.forward, k) for k in range(nodes)]
        self._answer = results["X_new"].reshape(-1), results["U_new"].reshape(-1)

    def _at(self, function: ca.Function, k: int, count: int = 1) -> BufferedFunction:
        """A function of a node at the nodes k .. k + count - 1."""
        if count > 1:
            common = [i for i, name in enumerate(function.name_in()) if name in COMMON]
            function = function.map(function.name(), "serial", count, common, [])

        def place(name: str, shape: ca.Sparsity) -> np.ndarray:
            array = self._a.get(name.removesuffix("_next"), np.zeros(0))
            first = k + name.endswith("_next")
            array = array if name in COMMON else array[first : first + count]
            return array.reshape(array_for(shape).shape)

        arguments = {name: place(name, function.sparsity_in(name)) for name in function.name_in()}
        return BufferedFunction(
            function, arguments, {name: place(name, function.sparsity_out(name)) for name in function.name_out()}
        )

    def prepare(self) -> None:
        """See step.Step."""
        a = self._a
        for call in self._guess:
            call()
        a["P"][-1].flat[:: len(a["Q_end"]) + 1] = a["Q_end"]
        a["p"][-1] = a["multiplier"][-1] = a["q"][-1]
        for call in self._back:
            call()

    def feedback(self) -> None:
        """See step.Step."""
        a = self._a
        X_new, U_new = self._answer
        a["X_lin"][0] = a["X_new"][0] = a["x0"]
        for call in self._forth:
            call()
        finite = math.isfinite(X_new.dot(X_new) + U_new.dot(U_new))
        a["checks"][:2], a["checks"][2] = a["extremes"][-1] if finite else math.nan, a["kkt"][0, 0]


class Horizon:
    """Symbols of arguments of a step by their names, and what follows from its reference: states and inputs at the
    nodes, the thrust added in them (one for each, none without `deviation`), and the coordinates of the error."""

    def __init__(self, form: Form, nodes: int, kind: Any, names: Iterable[str]) -> None:
        shapes, _ = array_shapes(form, nodes)
        self.given = a = named_symbols(kind, {name: shapes[name][::-1] for name in names})
        self.X_ref = a["X_ref"][:, :: form.samples]
        self.U_ref = a["U_ref"]
        self.added = list[Expression]()
        if form.deviation:
            limits = (a["u_min"], a["u_max"])
            tau = a["tau"] if form.lag else None
            self.U_ref, self.added = held_deviation(self.U_ref, *limits, a["dt"], a["first_share"], tau)
        self.frames = reference_frames(self.X_ref, form.attitude_error)
        self.error = attitude_error_in(*self.frames or [None])


@lru_cache
def guess_function(form: Form, nodes: int) -> ca.Function:
    """Where the horizon is linearised, and the gradients of its cost there: X_lin and q of the nodes from 1 on, U_lin,
    r, added, frames, named as in step.py like the inputs."""
    names = ("X", "U", "X_ref", "U_ref", "Q", "Q_end", "R", "dt", "shift", "u_min", "u_max", "first_share", "tau")
    horizon = Horizon(form, nodes, ca.SX, names)
    a = horizon.given
    kept = {"added": horizon.added, "frames": horizon.frames}

    def moved(values: Expression, share: Expression) -> Expression:
        return ca.horzcat(values[:, :-1] + ca.repmat(share, values.size1(), 1) * ca.diff(values, 1, 1), values[:, -1])

    X_lin = moved(a["X"][:, 1:], a["shift"][1:].T)
    U_lin = moved(a["U"], a["shift"][:-1].T)
    length = ca.sqrt(ca.sum1(X_lin[ATTITUDE, :] ** 2))  # integration alone leaves it within half a percent of one, but
    scale = limited(length, LENGTH_MIN, LENGTH_MAX) / length  # at a length of zero a quaternion is no attitude
    X_lin[ATTITUDE, :] *= ca.repmat(scale, 4, 1)
    errors = ca.horzsplit(X_lin - horizon.X_ref[:, 1:])
    q = ca.horzcat(*(horizon.error.deviation(k, dx) for k, dx in enumerate(errors, 1)))
    results = {name: ca.horzcat(*parts) for name, parts in kept.items() if parts}
    results |= {"X_lin": X_lin, "q": ca.horzcat(a["Q"][:, 1:], a["Q_end"]) * q}
    return dense_function("guess", a, results | {"U_lin": U_lin, "r": a["R"] * (U_lin - horizon.U_ref)})
