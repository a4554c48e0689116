"""One update of the weights of an adapting residual (quadexp.air.adapting) from one accelerometer sample.

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
here: with c = 0 it is bayes. V = c sigma'sigma + b~' P^-1 b~ falls along the motion (tests/air/test_online.py). The
discretisation printed in its supplement, (17) to (19), does not do this: it has the opposite sign before P phi' sigma
and no dt, and r dt where a noise of density r dt gives r per sample.

A component has its own b and P, so an update is of O(h^2) for each.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quadexp.air.adapting import Adapting, Block, regressors
from quadexp.air.base import Residual
from quadexp.compile.backend import handwritten
from quadexp.compile.symbolic import ca
from quadexp.physics.expression import Expression
from quadexp.physics.rotation import air_velocity, rotation_matrix
from quadexp.physics.state import ATTITUDE, N_STATE, POSITION, RATE, VELOCITY
from quadexp.physics.vehicle import Vehicle

BLOCK = Path(__file__).with_name("adapt_block.c")
LAWS = ("bayes", "rls", "composite")


@dataclass(frozen=True)
class Law:
    """name: of LAWS. fitc: see the module. The numbers are arguments of the function."""

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
    x, f, u, path = (ca.MX.sym(name, size) for name, size in (("x", N_STATE), ("f", 3), ("u", n), ("path", 6)))
    belief = ca.MX.sym("belief", len(prior_belief(adapting)))
    known_theta = ca.MX.sym("known_theta", 0 if known is None else len(known.theta))
    variance, decay, tracking, rate = (ca.MX.sym(name) for name in ("variance", "decay", "tracking", "tracking_rate"))

    z = ca.vertcat(air_velocity(x[ATTITUDE], x[VELOCITY]), x[RATE], u)
    prior = ca.DM(adapting.residual.theta)
    y, *rows = regressors(adapting, n)(z, prior)
    sample = f - ca.vertcat(0, 0, ca.sum1(u) / vehicle.mass) - y[:3]
    if known is not None:
        sample -= ca.densify(known.function(z, known_theta)[0])[:3]
    sigma = ca.mtimes(rotation_matrix(x[ATTITUDE]).T, x[VELOCITY] - path[3:] + rate * (x[POSITION] - path[:3]))

    parts = ca.vertsplit(belief, np.cumsum([0, *(_size(block) for block in adapting.blocks)]).tolist())
    theta, innovation, new = ca.MX(prior), [ca.MX(0)] * 3, []
    for block, row, own in zip(adapting.blocks, rows, parts, strict=True):
        at = own, row.T, sample[block.axis], variance, decay, tracking * sigma[block.axis]
        found, weights, innovation[block.axis] = (_compiled_block if compiled else _block)(block, law, *at)
        new.append(found)
        theta[block.at.tolist()] = weights
    return ca.Function(
        "adapt",
        [x, f, u, path, belief, known_theta, variance, decay, tracking, rate],
        [ca.vertcat(*new), theta, ca.vertcat(*innovation)],
        ["x", "f", "u", "path", "belief", "known_theta", "variance", "decay", "tracking", "tracking_rate"],
        ["new_belief", "theta", "innovation"],
    )


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
    h, root = len(block.at), ca.DM(block.root)
    b, P, phi = belief[:h], ca.reshape(belief[h:], h, h), ca.mtimes(root.T, row)
    if law.name == "rls":
        P = P * ca.fmin(1 / decay, ca.fmax(1, h / ca.trace(P)))
    else:
        b, P = decay * b, decay**2 * P + (1 - decay**2) * ca.DM.eye(h)
    if law.fitc:
        noise += ca.fmax(block.signal_variance - ca.dot(phi, phi), 0)
    error = sample - ca.dot(phi, b)
    spread = ca.mtimes(P, phi)
    s = ca.dot(phi, spread) + noise
    gain = spread / s
    crossed = ca.mtimes(gain, spread.T)
    P = ca.tril2symm(ca.tril(P - crossed - crossed.T + s * ca.mtimes(gain, gain.T)))
    b = b + gain * error
    if law.name == "composite":
        b += push * ca.mtimes(P, phi)
    return ca.vertcat(b, ca.vec(P)), ca.DM(block.mean) + ca.mtimes(root, b), error


def _compiled_block(block: Block, law: Law, *arguments: Expression) -> tuple[Expression, ...]:
    """As _block, by adapt_block.c."""
    h, dense = len(block.at), ca.Sparsity.dense
    chosen = {"RLS": law.name == "rls", "FITC": law.fitc, "COMPOSITE": law.name == "composite"}
    one, many, all_of_it = dense(1), dense(h), dense(_size(block))
    kernel = handwritten(
        "_".join(["adapt", str(h), *(name.lower() for name, on in chosen.items() if on)]),
        BLOCK,
        {"SIZE": h} | {name: int(on) for name, on in chosen.items()},
        {"belief": all_of_it, "row": many, "sample": one, "variance": one, "decay": one, "push": one}
        | {"root": dense(h, h), "mean": many, "signal": one},
        {"next": all_of_it, "weights": many, "innovation": one},
    )
    found: list[Expression] = kernel(*arguments, ca.DM(block.root), ca.DM(block.mean), block.signal_variance)
    return tuple(found)


def _size(block: Block) -> int:
    """Numbers of a block's belief."""
    return len(block.at) * (len(block.at) + 1)


def prior_belief(adapting: Adapting) -> np.ndarray:
    """The belief without data: b = 0 and P = I of every block, one after the other, matrices by columns."""
    parts = [part for block in adapting.blocks for part in (np.zeros(len(block.at)), np.eye(len(block.at)).ravel())]
    return np.concatenate(parts)


def split_belief(adapting: Adapting, belief: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """b (h,) and P (h, h) of every block."""
    found, first = [], 0
    for block in adapting.blocks:
        h = len(block.at)
        found.append((belief[first : first + h], belief[first + h : first + h + h * h].reshape(h, h)))
        first += h + h * h
    return found
