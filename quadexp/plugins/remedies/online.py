"""Residuals that are linear in some of their parameters, the weights, and the update of these in flight.

    y_i(z; a) = c_i(z) + phi_i(z) . a_i,         a_i = a_i0 + R_i b_i,   b_i ~ N(0, I) a priori

for each adapting component i of the body acceleration, with weights a_i of its own. R_i R_i' is the prior covariance
of the weights. Everything in flight is done with b: its prior is the same for all features, and the roundings of the
updates are relative to the prior.

    linear_drag        a = (drag, intercept), z also the thrust gain; R diagonal
    terms              a = the coefficients of drag and thrust terms (aerodynamics/terms.py), from zero; R diagonal
    neural             a = a row of the last layer and its bias: the network's last hidden layer is phi
    gaussian_process   a = alpha. With K = k(Z, Z) of unit variance and prior standard deviation s, a priori
                       f(Z) ~ N(., s^2 K), so R = s L^-T with L L' = K: b = L^-1 f(Z) / s

A prior is stated by one number, the standard deviation s of the acceleration (m/s^2) that the weights add: for single
terms at TYPICAL_SPEED and at the hover thrust, for a layer of h units with every unit at its bound.

One update takes one accelerometer sample,

    y = f - T e_z / m - (what is known of the air)                          sample of the residual acceleration, body
    e = y - c(z) - phi b,    phi: regressors of b, on each component

With P the covariance of b (a priori I), r the variance of the noise of a sample, dt the time between two samples and
tau the memory, the laws are

    bayes        b- = rho b,   P- = rho^2 P + (1 - rho^2) I,      rho = exp(-dt / tau)
    rls          b- = b,       P- = P / f but of a trace of at most h,      f = exp(-dt / tau)
    then both    s = phi P- phi' + r,  K = P- phi' / s,  b = b- + K e,
                 P = P- - K phi P- - P- phi' K' + s K K'                          (Joseph form)
    composite    as bayes, then b += dt c P phi' sigma,    sigma = R' ((v - v_r) + Lambda (p - p_r))

bayes: the weights are an Ornstein-Uhlenbeck process with the prior as its stationary distribution; without data they
return to it, so P stays bounded. tau -> infinity is Bayesian linear regression, and for a Gaussian process's weights
the streaming sparse posterior: equal to that of all samples at once. fitc adds what the inducing points leave unknown
of the function at z, s^2 - phi phi', to r (Huber 2014; Csato and Opper 2002); without it the update is variational.

composite is the law of Neural-Fly (O'Connell et al. 2022, (8)) with its covariance (9), Q = 2 I / tau, discretised
here: with c = 0 it is bayes. V = c sigma'sigma + b~' P^-1 b~ falls along the motion
(tests/plugins/remedies/test_online.py). The discretisation printed in its supplement, (17) to (19), does not do this:
it has the opposite sign before P phi' sigma and no dt, and r dt where a noise of density r dt gives r per sample.

A component has its own b and P, so an update is of O(h^2) for each.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from quadexp.compile.backend import handwritten
from quadexp.compile.symbolic import ca
from quadexp.models.adapting import Adapting, Block
from quadexp.models.residual import Residual, feature_names
from quadexp.physics.expression import Expression, named_function, named_symbols, split, symbols
from quadexp.physics.rotation import air_velocity, along_z, rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

BLOCK = Path(__file__).with_name("adapt_block.c")


def from_zero(adapting: Adapting) -> Adapting:
    """The same with prior mean zero."""
    theta = adapting.residual.theta.copy()
    for block in adapting.blocks:
        theta[block.at] = 0.0
    blocks = tuple(replace(block, mean=np.zeros(len(block.mean))) for block in adapting.blocks)
    return Adapting(replace(adapting.residual, theta=theta), blocks)


def regressors(adapting: Adapting, rotors: int) -> ca.Function:
    """(z, theta) -> y (6,) and, for each block, dy_i/da of its component, (1, h): the regressors of its weights."""
    z, theta = symbols(ca.MX, z=len(feature_names(rotors)), theta=len(adapting.residual.theta))
    with_weights = ca.MX(theta)
    weights = [ca.MX.sym("a", len(block.at)) for block in adapting.blocks]
    for block, a in zip(adapting.blocks, weights, strict=True):
        with_weights[block.at.tolist()] = a
    function = adapting.residual.function
    if function.is_a("SXFunction"):
        y = function(z, with_weights)[0]
    else:  # without a call: derivatives then follow only what they depend on
        y = function.call([z, with_weights], True, False)[0]
    y = ca.densify(y)
    rows = [ca.jacobian(y[block.axis], a) for block, a in zip(adapting.blocks, weights, strict=True)]
    parameters = [theta[block.at.tolist()] for block in adapting.blocks]
    y, *rows = ca.graph_substitute([y, *map(ca.densify, rows)], weights, parameters)
    return ca.Function("regressors", [z, theta], [y, *rows])


@dataclass(frozen=True)
class Law:
    """name: "bayes", "rls" or "composite". fitc: see the module. The numbers are arguments of the function."""

    name: str = "bayes"
    fitc: bool = False


def update_function(
    vehicle: Vehicle,
    adapting: Adapting,
    known: Residual | None = None,
    law: Law | None = None,
    *,
    compiled: bool = False,
) -> ca.Function:
    """One update, for all components. compiled: the form to compile, which cannot be interpreted.

    known: residual that is summed with the adapting one and does not adapt.
    Inputs: x (13,) state, world; f (3,) accelerometer, body (m/s^2); u (n,) delivered rotor thrusts (N); path (6,)
    position and velocity of the reference, world; belief (N_belief,): b and P of every block, see `prior_belief`;
    known_theta (q,) of `known`; variance r (m^2/s^4); decay exp(-dt / tau); tracking dt c; tracking_rate Lambda.
    Outputs: new_belief; theta of the adapting residual; innovation e (3,), 0 where nothing adapts (m/s^2).
    """
    law = law or Law()
    n = vehicle.n_rotors
    n_belief = len(prior_belief(adapting))
    shapes = {"x": N_STATE, "f": 3, "u": n, "path": 6, "belief": n_belief}
    shapes["known_theta"] = 0 if known is None else len(known.theta)
    shapes["variance"] = 1
    shapes["decay"] = 1
    shapes["tracking"] = 1
    shapes["tracking_rate"] = 1
    inputs = named_symbols(ca.MX, shapes)
    x, f, u, path, belief, known_theta, variance, decay, tracking, rate = inputs.values()

    z = ca.vertcat(air_velocity(x[ATTITUDE], x[VELOCITY]), x[RATE], u)
    prior = ca.DM(adapting.residual.theta)
    y, *rows = regressors(adapting, n)(z, prior)
    sample = f - along_z(ca.sum1(u) / vehicle.mass) - y[:3]
    if known is not None:
        sample -= ca.densify(known.function(z, known_theta)[0])[:3]
    apart = x[POSITION] - path[:3]
    sigma = rotation_matrix(x[ATTITUDE]).T @ (x[VELOCITY] - path[3:] + rate * apart)

    beliefs = split(belief, [block.size for block in adapting.blocks])
    theta = ca.MX(prior)
    innovation = [ca.MX(0)] * 3
    updated = []
    for block, row, before in zip(adapting.blocks, rows, beliefs, strict=True):
        update = _compiled_block if compiled else _block
        i = block.axis
        after, weights, error = update(block, law, before, row.T, sample[i], variance, decay, tracking * sigma[i])
        innovation[i] = error
        updated.append(after)
        theta[block.at.tolist()] = weights
    outputs = {"new_belief": ca.vertcat(*updated), "theta": theta, "innovation": ca.vertcat(*innovation)}
    return named_function("adapt", inputs, outputs)


def _block(
    block: Block,
    law: Law,
    belief: Expression,
    row: Expression,
    sample: Expression,
    noise: Expression,
    decay: Expression,
    push: Expression,
) -> tuple[Expression, Expression, Expression]:
    """The update of one component: its new belief, its weights and its innovation.

    row: regressors of the weights. noise: r. push: dt c sigma. Only one triangle of P is used, so it is symmetric.
    """
    h = len(block.at)
    root = ca.DM(block.root)
    b = belief[:h]
    P = ca.reshape(belief[h:], h, h)
    phi = root.T @ row
    if law.name == "rls":
        P = P * ca.fmin(1 / decay, ca.fmax(1, h / ca.trace(P)))
    else:
        b = decay * b
        P = decay**2 * P + (1 - decay**2) * ca.DM.eye(h)
    if law.fitc:
        noise += ca.fmax(block.signal_variance - ca.dot(phi, phi), 0)
    error = sample - ca.dot(phi, b)
    spread = P @ phi
    s = ca.dot(phi, spread) + noise
    gain = spread / s
    crossed = gain @ spread.T
    P = P - crossed - crossed.T + s * (gain @ gain.T)
    P = ca.tril2symm(ca.tril(P))
    b = b + gain * error
    if law.name == "composite":
        b += push * (P @ phi)
    return ca.vertcat(b, ca.vec(P)), ca.DM(block.mean) + root @ b, error


def _compiled_block(block: Block, law: Law, *arguments: Expression) -> tuple[Expression, ...]:
    """As _block, by adapt_block.c."""
    h = len(block.at)
    dense = ca.Sparsity.dense
    chosen = {"RLS": law.name == "rls", "FITC": law.fitc, "COMPOSITE": law.name == "composite"}
    parts = ["adapt", str(h)]
    parts += [word.lower() for word, on in chosen.items() if on]
    sizes = {"SIZE": h} | {word: int(on) for word, on in chosen.items()}
    shapes = {"belief": block.size, "row": h, "sample": 1, "variance": 1, "decay": 1, "push": 1}
    inputs = {word: dense(size) for word, size in shapes.items()}
    inputs["root"] = dense(h, h)
    inputs["mean"] = dense(h)
    inputs["signal"] = dense(1)
    results = {"next": dense(block.size), "weights": dense(h), "innovation": dense(1)}
    kernel = handwritten("_".join(parts), BLOCK, sizes, inputs, results)
    outputs = kernel(*arguments, ca.DM(block.root), ca.DM(block.mean), block.signal_variance)
    return tuple(outputs)


def prior_belief(adapting: Adapting) -> np.ndarray:
    """The belief without data: b = 0 and P = I of every block, one after the other, matrices by columns."""
    parts = []
    for block in adapting.blocks:
        h = len(block.at)
        parts.append(np.zeros(h))
        parts.append(np.eye(h).ravel())
    return np.concatenate(parts)
