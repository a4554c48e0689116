"""Identification of the blade-element coefficients in flight by recursive least squares (Lei & Li 2017, section 3).

Given the induced velocities the specific force is linear in theta = (C_d0, C_la, C_Dx, C_Dy, C_Dz), so one row of
regressors per body axis is the derivative of the dynamics' own force:

    Y = F(v, w, V_I, theta) / m = Phi theta,     Phi = dF/dtheta / m                       (3, 5)

and on every axis, with the coefficients that its force depends on, x (C_d0, C_la, C_Dx), y (C_d0, C_la, C_Dy), z (C_la,
C_Dz):

    P <- (lambda P^-1 + (1 - lambda) P_0^-1)^-1
    e = y - Phi^T theta,   K = P Phi / (Phi^T P Phi + sigma^2)                              (24)
    theta <- theta + K e,   P <- (I - K Phi^T) P

The paper has sigma = 1 m/s^2 and lambda = 1. lambda < 1 forgets by exponential resetting (Lai & Bernstein 2023, IEEE
Control Systems Letters 7; forgetting towards a given density in Kulhavy & Zarrop 1993, Int. J. Control 58): P <= P_0
always, also in directions that nothing excites, in which P / lambda grows without bound.

V_I is not measured: it solves (14) and (17) with the coefficients in use. That makes F_z depend on C_la through V_I as
well; with gauss_newton the gain is taken from the whole derivative

    dF_z/dC_la + (dF_z/dV_I) (dV_I/dC_la)

which removes the bias of C_Dz that results from the partial derivative (and not from the accelerometer's bias).

The step is one CasADi function; `update_function` holds what the three estimators know and clips the values that a
controller uses: with the paper's P_0 = 50 I and unit noise C_d0 crosses zero while the rotors spin up in nearly half of
all flights, and the allocation divides by it. Only the values in use are clipped, and every clip is counted; the
estimators are not affected. With P_0 scaled to the coefficients and the accelerometer's noise (`RLSSettings.scaled`)
clipping is rarely needed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from quadexp.compile.memory import NEXT, NOW
from quadexp.compile.symbolic import ca
from quadexp.names import named
from quadexp.parts.settings import Settings, key, keyed, part
from quadexp.physics.expression import Expression, limited, named_function, named_symbols
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.blade_element import aerodynamic_wrench, rotor_flow
from quadexp.plugins.aerodynamics.coefficients import C_D0, C_DX, C_DY, C_DZ, C_LA, THETA, BladeCoefficients, BladeKeys
from quadexp.plugins.aerodynamics.induced_velocity import balance, safe_newton

SLOWEST = 1.0  # rad/s; samples with a slower rotor are skipped (the advance ratio is not defined there)
# Axis -> coefficients that the force along it depends on.
AXES = {"x": (C_D0, C_LA, C_DX), "y": (C_D0, C_LA, C_DY), "z": (C_LA, C_DZ)}
INNOVATION_SAMPLES = 10  # time constant, in samples, of the mean square error
FIRST_WAIT = 100  # samples without change detection at the start
NEXT_WAIT = 50  # the same after a detected change
ITERATIONS = 16  # of the safeguarded Newton method, from its upper bound


def rls_step_function(vehicle: Vehicle, *, gauss_newton: bool = False) -> ca.Function:
    """One update of the three estimators.

    Inputs: v (3,) body FLU (m/s); w (n,) (rad/s); y (3,) specific force (m/s^2); used (5,) coefficients in use;
    theta_x, theta_y, theta_z, P_x, P_y, P_z of the axes and prior_x, prior_y, prior_z, the diagonals of P_0; sigma
    (m/s^2); forgetting lambda; lift_weight, the share of the z axis in C_la.
    Outputs: the new theta_* and P_*; raw (5,), combined by (25), (26); error (3,), e (m/s^2); induced (n,) (m/s);
    regressors (3, 5) (m/s^2); weight beta_x.
    """
    n = vehicle.n_rotors
    shapes: dict[str, Any] = {"v": 3, "w": n, "y": 3, "used": len(THETA)}
    for axis, at in AXES.items():
        shapes[f"theta_{axis}"] = len(at)
        shapes[f"P_{axis}"] = (len(at), len(at))
        shapes[f"prior_{axis}"] = len(at)
    inputs = named_symbols(ca.SX, shapes | {"sigma": 1, "forgetting": 1, "lift_weight": 1})
    v, w, y, used, *_, sigma, forgetting, lift_weight = inputs.values()
    coefficients = ca.SX.sym("coefficients", len(THETA))

    flow = rotor_flow(vehicle, v)
    equation = balance(vehicle.rotor_geometry, used[C_LA], w, flow.in_plane_squared, flow.axial)
    induced = ca.SX.sym("V_I", n)
    force, _ = aerodynamic_wrench(vehicle, coefficients, v, w, induced)
    regressors = ca.jacobian(force, coefficients) / vehicle.mass
    gain_regressors = regressors
    if gauss_newton:
        through = ca.substitute(ca.jacobian(force[2], induced), coefficients, used)
        gain_regressors = ca.SX(regressors)
        gain_regressors[2, C_LA] += through @ equation.derivative(induced, used[C_LA]) / vehicle.mass
    solution = safe_newton(equation, ITERATIONS)
    regressors, gain_regressors = ca.substitute([regressors, gain_regressors], [induced], [solution])

    results = {}
    errors = []
    for i, (axis, at) in enumerate(AXES.items()):
        phi = regressors[i, at].T
        direction = gain_regressors[i, at].T
        theta = inputs[f"theta_{axis}"]
        P = inputs[f"P_{axis}"]
        prior = ca.repmat(inputs[f"prior_{axis}"], 1, len(at))
        reset = (1 - forgetting) * P / prior
        P = P @ ca.inv_minor(forgetting * ca.DM.eye(len(at)) + reset)
        P = (P + P.T) / 2
        spread = P @ direction
        gain = spread / (ca.dot(direction, spread) + sigma**2)
        error = y[i] - ca.dot(phi, theta)
        errors.append(error)
        results[f"new_theta_{axis}"] = theta + gain * error
        results[f"new_P_{axis}"] = P - gain @ spread.T

    speed = abs(v[0]) + abs(v[1])
    weight = ca.if_else(speed > 0, abs(v[0]) / (speed + (speed <= 0)), 0.5)
    thetas = [results[f"new_theta_{axis}"] for axis in AXES]
    results["raw"] = _combine(thetas, weight, lift_weight)
    results["error"] = ca.vertcat(*errors)
    results["induced"] = solution
    results["regressors"] = ca.densify(regressors)
    results["weight"] = weight
    return named_function("rls_step", inputs, named(results, ca.cse([*results.values()])))


def _combine(thetas: Sequence[Expression], weight: Expression, lift_weight: Expression) -> Expression:
    """theta (5,) from the three axes, C_d0 by (25) and C_la by (26): beta_x = weight, beta_la,z = lift_weight."""
    x, y, z = thetas
    profile_drag = weight * x[0] + (1 - weight) * y[0]
    horizontal = weight * x[1] + (1 - weight) * y[1]
    lift_slope = lift_weight * z[0] + (1 - lift_weight) * horizontal
    return ca.vertcat(profile_drag, lift_slope, x[2], y[2], z[1])


@dataclass(frozen=True)
class RLSSettings(Settings):
    """How the estimators are started and weighted; the defaults are the paper's, with clipping."""

    prefix = "controller.rls."

    covariance: float = key(
        50.0, "initial covariance P_0 as a multiple of the identity, where relative_std is null", "(0, 1e9]"
    )
    relative_std: float | None = key(
        None, "standard deviation that gives P_0; null: see covariance", "(0, 100]", "of the initial values"
    )
    noise: float = key(1.0, "assumed standard deviation of the accelerometer", "(0, 100]", "m/s^2")
    forgetting: float = key(1.0, "forgetting factor; 1 forgets nothing", "[0.5, 1]")
    lift_weight: float = key(
        1.0, "weight of the z axis in the combined estimate of C_la; x and y share the rest", "[0, 1]"
    )
    gauss_newton: bool = key(False, "include the induced velocity in the derivative of the z equation")
    rotor_range: tuple[float, float] = key(
        (0.5, 4.0), "bounds of the estimates of C_d0 and C_la where they are used", "(0, 100]", "of the initial values"
    )
    drag_range: tuple[float, float] = key((0.0, 0.2), "bounds of the estimate of C_D where it is used", "[0, 100]")
    clip: bool = key(True, "clip the estimates to their bounds where they are used; clipped samples are counted")

    @classmethod
    def scaled(cls, noise: float = 0.05, relative_std: float = 0.5, **others: Any) -> RLSSettings:
        """P_0 and sigma in the units of the problem: first values good to relative_std, readings to noise (m/s^2)."""
        return cls(noise=noise, relative_std=relative_std, **others)


@keyed
class Identification(RLSSettings, BladeKeys):
    """Identification in flight, as a controller is configured. profile_drag, lift_slope, body_drag: first values.
    relative_std: if given, P_0 is the square of relative_std times the first values, else covariance times identity.
    change_threshold: mean square prediction error, over that of the noise, at which P goes back to P_0."""

    change_threshold: float | None = key(
        None, "mean square error over noise variance at which P is reset; null: never", "(1, 1e9]"
    )

    @property
    def remembered(self) -> dict[str, np.ndarray]:
        """What is known before the first sample, see `remembered` of this module."""
        return remembered(part(BladeCoefficients, self), part(RLSSettings, self))

    def after(
        self, vehicle: Vehicle, known: Mapping[str, Expression], sample: Mapping[str, Expression]
    ) -> dict[str, Expression]:
        """What is known after a sample. known: what is `remembered` before it. sample: v, w, y, read, see
        update_function."""
        first = part(BladeCoefficients, self)
        update = update_function(vehicle, first, part(RLSSettings, self), self.change_threshold)
        before = {NOW + name: value for name, value in known.items()}
        results = update.call({**sample, **before})
        return {name: results[NEXT + name] for name in known}


def recursion(
    vehicle: Vehicle, initial: BladeCoefficients, settings: RLSSettings, samples: Mapping[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """All samples of a flight, one after another; name -> what is `remembered` after each, and its `error` (k, 3),
    (k, size) each.

    samples: v (k, 3), w (k, n), y (k, 3), see rls_step_function; finite. initial: theta_0 (the paper starts from half
    of the true values).
    """
    start = remembered(initial, settings)
    arguments = {NOW + name: value for name, value in start.items()}
    function = update_function(vehicle, initial, settings)
    count = len(samples["v"])
    every = function.mapaccum("rls", count, list(arguments), [NEXT + name for name in start])
    arguments |= {name: values.T for name, values in samples.items()}
    arguments["read"] = np.ones((1, count))
    results = every.call(arguments)
    return {name.removeprefix(NEXT): np.array(values).reshape(-1, count).T for name, values in results.items()}


def standard_errors(kept: Mapping[str, np.ndarray], settings: RLSSettings) -> np.ndarray:
    """Standard errors of `raw`, (k, 5), where the readings have the assumed deviation. kept: of `recursion`."""
    x, y, z = (kept[f"P_{axis}"][:, :: len(at) + 1].T for axis, at in AXES.items())  # the diagonals
    b = kept["weight"][:, 0]
    c = settings.lift_weight
    profile_drag = b**2 * x[0] + (1 - b) ** 2 * y[0]
    horizontal = b**2 * x[1] + (1 - b) ** 2 * y[1]
    lift_slope = c**2 * z[0] + (1 - c) ** 2 * horizontal
    variance = np.stack([profile_drag, lift_slope, x[2], y[2], z[1]], axis=1)
    return np.sqrt(np.maximum(variance, 0.0))


def bounds(initial: BladeCoefficients, settings: RLSSettings) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest values in use, (5,) each."""
    rotor = initial.parameters()[: C_LA + 1]
    low, high = (np.r_[settings.rotor_range[i] * rotor, [settings.drag_range[i]] * 3] for i in (0, 1))
    return low, high


def spread(initial: BladeCoefficients, settings: RLSSettings, at: Sequence[int]) -> np.ndarray:
    """The diagonal of P_0 of an axis."""
    if settings.relative_std is None:
        return np.full(len(at), settings.covariance)
    size = np.abs(initial.parameters()[list(at)])
    return (settings.relative_std * np.maximum(size, 1e-3)) ** 2


def remembered(initial: BladeCoefficients, settings: RLSSettings) -> dict[str, np.ndarray]:
    """What is known before the first sample: theta and P of the axes; values combined, raw, and in use; how often each
    was clipped; numbers of updates, and of samples with a stopped rotor; beta_x; mean square error over that of the
    noise, samples until a change may be found, and changes so far."""
    theta = initial.parameters()
    kept = {f"theta_{axis}": theta[list(at)] for axis, at in AXES.items()}
    kept |= {f"P_{axis}": np.diag(spread(initial, settings, at)).ravel() for axis, at in AXES.items()}
    used = np.clip(theta, *bounds(initial, settings)) if settings.clip else theta
    kept["raw"] = theta
    kept["used"] = used
    kept["clips"] = 1.0 * (used != theta)
    ones = {"samples": 0, "skipped": 0, "weight": 0.5, "innovation": 1, "wait": FIRST_WAIT, "reopened": 0}
    return kept | {name: np.array([float(value)]) for name, value in ones.items()}


def update_function(
    vehicle: Vehicle, initial: BladeCoefficients, settings: RLSSettings, change_threshold: float | None = None
) -> ca.Function:
    """One sample: v, w, y, see rls_step_function; read, whether there is one; and what is `remembered` -> its next
    values, and of the sample error, regressors and induced velocity."""
    start = remembered(initial, settings)
    shapes = {"v": 3, "w": vehicle.n_rotors, "y": 3, "read": 1}
    shapes |= {NOW + name: value.size for name, value in start.items()}
    a = named_symbols(ca.MX, shapes)
    kept = {name: a[NOW + name] for name in start}
    arguments: dict[str, Any] = {name: a[name] for name in ("v", "w", "y")} | {"used": kept["used"]}
    for axis, at in AXES.items():
        arguments[f"theta_{axis}"] = kept[f"theta_{axis}"]
        arguments[f"P_{axis}"] = ca.reshape(kept[f"P_{axis}"], len(at), -1)
        arguments[f"prior_{axis}"] = spread(initial, settings, at)
    arguments["sigma"] = settings.noise
    arguments["forgetting"] = settings.forgetting
    arguments["lift_weight"] = settings.lift_weight
    step = rls_step_function(vehicle, gauss_newton=settings.gauss_newton).call(arguments)
    next_values = {name: step[f"new_{name}"] for name in kept if f"new_{name}" in step}
    raw = step["raw"]
    used = limited(raw, *map(ca.DM, bounds(initial, settings))) if settings.clip else raw
    next_values["raw"] = raw
    next_values["used"] = used
    next_values["clips"] = kept["clips"] + (used != raw)
    next_values["samples"] = kept["samples"] + 1
    next_values["weight"] = step["weight"]
    if change_threshold is not None:
        square = ca.sumsqr(step["error"] / settings.noise) / 3
        innovation = kept["innovation"] + (square - kept["innovation"]) / INNOVATION_SAMPLES
        wait = kept["wait"] - 1
        changed = ca.logic_and(wait <= 0, innovation > change_threshold)
        next_values["innovation"] = innovation
        next_values["wait"] = ca.if_else(changed, NEXT_WAIT, wait)
        next_values["reopened"] = kept["reopened"] + changed
        for axis in "xyz":
            next_values[f"P_{axis}"] = ca.if_else(changed, start[f"P_{axis}"], ca.vec(next_values[f"P_{axis}"]))
    turns = ca.mmin(a["w"]) >= SLOWEST
    counts = ca.logic_and(a["read"], turns)
    results = {NEXT + name: value for name, value in kept.items()}
    for name, value in next_values.items():
        results[NEXT + name] = ca.if_else(counts, ca.vec(value), kept[name])
    results[f"{NEXT}skipped"] = kept["skipped"] + ca.logic_and(a["read"], ca.logic_not(turns))
    results |= {name: step[name] for name in ("error", "regressors", "induced")}
    return named_function("rls_update", a, results)
