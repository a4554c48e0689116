"""Residuals that are linear in some of their parameters, the weights, with a prior of these.

    y_i(z; a) = c_i(z) + phi_i(z) . a_i,         a_i = a_i0 + R_i b_i,   b_i ~ N(0, I) a priori

for each adapting component i of the body acceleration, with weights a_i of its own. R_i R_i' is the prior covariance
of the weights. Everything in flight is done with b: its prior is the same for all features, and the roundings of the
updates are relative to the prior.

    linear_drag        a = (drag, intercept), z also the thrust gain; R diagonal
    terms              a = the coefficients of drag and thrust terms (quadexp.air.terms), from zero; R diagonal
    neural             a = a row of the last layer and its bias: the network's last hidden layer is phi
    gaussian_process   a = alpha. With K = k(Z, Z) of unit variance and prior standard deviation s, a priori
                       f(Z) ~ N(., s^2 K), so R = s L^-T with L L' = K: b = L^-1 f(Z) / s

A prior is stated by one number, the standard deviation s of the acceleration (m/s^2) that the weights add: for single
terms at TYPICAL_SPEED and at the hover thrust, for a layer of h units with every unit at its bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from quadexp.air.base import OUTPUTS, Residual, feature_names
from quadexp.air.gaussian_process import PosteriorMean
from quadexp.air.linear_drag import N_PARAMETERS
from quadexp.air.network import Network
from quadexp.air.terms import TermStructure, columns_function, term_residual
from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.physics.vehicle import Vehicle

TYPICAL_SPEED = 8.0  # m/s
JITTER = 1e-8  # added to K, as in the fit
DRAG_TERMS = ("linear", "quadratic", "offset")
TERMS = (DRAG_TERMS, DRAG_TERMS, (*DRAG_TERMS, "thrust"))


@dataclass(frozen=True)
class Block:
    """Weights of one component of the acceleration.

    axis: 0, 1, 2. at: places of the weights in theta, (h,). mean: a_0, (h,). root: R, (h, h). signal_variance: prior
    variance of the function, s^2 (m^2/s^4), where its weights do not determine all of it (FITC); 0 where they do.
    """

    axis: int
    at: np.ndarray
    mean: np.ndarray
    root: np.ndarray
    signal_variance: float = 0.0


@dataclass(frozen=True)
class Adapting:
    """residual: with the prior mean as theta. blocks: its weights, at most one block for each component."""

    residual: Residual
    blocks: tuple[Block, ...]


def from_zero(adapting: Adapting) -> Adapting:
    """The same with prior mean zero."""
    theta = adapting.residual.theta.copy()
    blocks = []
    for block in adapting.blocks:
        theta[block.at] = 0.0
        blocks.append(replace(block, mean=np.zeros(len(block.mean))))
    return Adapting(replace(adapting.residual, theta=theta), tuple(blocks))


def adapting_drag(vehicle: Vehicle, residual: Residual, deviation: float) -> Adapting:
    """Linear drag (quadexp.air.linear_drag). deviation: s, m/s^2."""
    thrust = vehicle.mass * vehicle.gravity
    places, typical = ([0, 3], [1, 4], [2, 5, 6]), ([TYPICAL_SPEED, 1.0],) * 2 + ([TYPICAL_SPEED, 1.0, thrust],)
    assert len(residual.theta) == N_PARAMETERS
    blocks = [
        Block(axis, np.array(at), residual.theta[at], deviation * np.diag(1 / np.array(sizes)))
        for axis, (at, sizes) in enumerate(zip(places, typical, strict=True))
    ]
    return Adapting(residual, tuple(blocks))


def adapting_terms(vehicle: Vehicle, deviation: float) -> Adapting:
    """TERMS with coefficients zero. deviation: s, m/s^2."""
    structure = TermStructure(TERMS, vehicle.mass)
    residual = term_residual(vehicle, structure, np.zeros(structure.n_parameters), "adapted in flight")
    speed = np.full(3, TYPICAL_SPEED)
    hover = np.full(vehicle.n_rotors, vehicle.gravity / vehicle.n_rotors)
    size = np.abs(np.array(columns_function(TERMS, vehicle.n_rotors)(speed, hover))).ravel()
    ends, blocks = np.cumsum([0, *map(len, TERMS)]), []
    for axis, (first, end) in enumerate(zip(ends[:-1], ends[1:], strict=True)):
        at = np.arange(first, end)
        if len(at):
            blocks.append(Block(axis, at, np.zeros(len(at)), deviation * np.diag(1 / size[at])))
    return Adapting(replace(residual, name="terms"), tuple(blocks))


def adapting_network(residual: Residual, network: Network, deviation: float) -> Adapting:
    """The last layer of a network. deviation: s, m/s^2."""
    outputs, units = np.shape(network.weights[-1])
    first = len(residual.theta) - outputs * (units + 1)
    root = deviation / np.sqrt(units + 1) * np.eye(units + 1)
    blocks = []
    for row, output in enumerate(network.outputs):
        if OUTPUTS.index(output) < 3:
            at = np.append(first + row + outputs * np.arange(units), first + outputs * units + row)
            blocks.append(Block(OUTPUTS.index(output), at, residual.theta[at], root))
    return Adapting(residual, _some(blocks))


class ProcessMean(PosteriorMean, Protocol):
    """A posterior mean that knows the variance of its prior."""

    @property
    def signal_variance(self) -> float: ...


def adapting_process(residual: Residual, outputs: Sequence[ProcessMean], deviation: float | None) -> Adapting:
    """Gaussian processes. deviation: s, m/s^2; None: that of each fit."""
    sizes = [len(one.alpha) for one in outputs]
    ends = len(residual.theta) - sum(sizes) + np.cumsum([0, *sizes])
    blocks = []
    for one, first, end in zip(outputs, ends[:-1], ends[1:], strict=True):
        if OUTPUTS.index(one.output) >= 3:
            continue
        s = float(np.sqrt(one.signal_variance)) if deviation is None else deviation
        scaled = np.asarray(one.inducing, float).reshape(end - first, -1) / np.asarray(one.lengthscale, float)
        distance = ((scaled[:, None] - scaled[None]) ** 2).sum(axis=2)
        lower = np.linalg.cholesky(np.exp(-0.5 * distance) + JITTER * np.eye(end - first))
        root = s * np.linalg.inv(lower).T
        at = np.arange(first, end)
        blocks.append(Block(OUTPUTS.index(one.output), at, residual.theta[at], root, s**2))
    return Adapting(residual, _some(blocks))


def _some(blocks: list[Block]) -> tuple[Block, ...]:
    if not blocks:
        raise UsageError("a model that adapts in flight needs a_x, a_y or a_z among its outputs")
    return tuple(blocks)


def regressors(adapting: Adapting, rotors: int) -> ca.Function:
    """(z, theta) -> y (6,) and, for each block, dy_i/da of its component, (1, h): the regressors of its weights."""
    z, theta = ca.MX.sym("z", len(feature_names(rotors))), ca.MX.sym("theta", len(adapting.residual.theta))
    with_weights, weights = ca.MX(theta), [ca.MX.sym("a", len(block.at)) for block in adapting.blocks]
    for block, own in zip(adapting.blocks, weights, strict=True):
        with_weights[block.at.tolist()] = own
    y = ca.densify(_inlined(adapting.residual.function, z, with_weights))
    rows = [ca.jacobian(y[block.axis], own) for block, own in zip(adapting.blocks, weights, strict=True)]
    given = [theta[block.at.tolist()] for block in adapting.blocks]
    y, *rows = ca.graph_substitute([y, *map(ca.densify, rows)], weights, given)
    return ca.Function("regressors", [z, theta], [y, *rows])


def _inlined(function: ca.Function, z: ca.MX, theta: ca.MX) -> ca.MX:
    """y of a residual's function, without a call: derivatives then follow only what they depend on."""
    if function.is_a("SXFunction"):
        return function(z, theta)[0]
    return function.call([z, theta], True, False)[0]
