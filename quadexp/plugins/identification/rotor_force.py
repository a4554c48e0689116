"""Force of the air from the four rotors: a blade element fitted to the log, and a Gaussian process of what it leaves.

    a = a_mean(v, u) + W(z) g(z),      z = (v, w, u_1 .. u_n)                        body FLU, m/s^2

a_mean: the blade element with lumped coefficients (aerodynamics/terms.py: thrust with the square of the rotor speed,
hub force with their sum, translational lift, drag along z), with the induced velocity where the rotors' radius is given
(model.rotor_radius). g: one process an axis, mean zero, of velocity, body rates and every rotor's thrust, which stands
for its speed: u = k w^2. Fitted where the thrusts are of rotor speeds. Otherwise the mean alone is the model: features
of commands tell which battery a flight had (docs/real_flights.md). An axis has a process only if it predicts flights
left out better than the mean.

W = prod_i S(z_i), S smooth, 1 within the bulk of the rows of the fit and 0 from their least and largest value on: where
a feature is outside the range of the data the model is its mean, and so never worse.

A controller flies it with the thrusts that it commands in place of those of the speeds, as all models of thrusts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any

import numpy as np

from quadexp.compile.symbolic import ca
from quadexp.errors import DataError, UsageError
from quadexp.models.adapting import Adapting
from quadexp.models.base import AXIS, Callback, ModelPart, Prediction, Shape, origin, quiet
from quadexp.models.common_scale import with_common_scale
from quadexp.models.dataset import ResidualDataset
from quadexp.models.linear_drag import LinearDrag, baseline
from quadexp.models.residual import FEATURES, VELOCITY, Residual, feature_names, feature_places, residual_function
from quadexp.names import named
from quadexp.parts.settings import SEEDS, key, keyed
from quadexp.physics.expression import Expression, split, symbols
from quadexp.physics.vehicle import Vehicle
from quadexp.plugins.aerodynamics.terms import SELF_CONSISTENT, TermMean, fit_term_mean, fit_terms, term_residual
from quadexp.plugins.gaussian_process.gaussian_process import GaussianProcessModel, GPConfig, GPFeatures, fit_gp
from quadexp.plugins.gaussian_process.posterior import OutputPosterior, gaussian_process_residual
from quadexp.plugins.identification.inflow import AIR_DENSITY, fit_inflow

BULK = 0.01  # quantile of a feature inside which the correction counts fully
LEAST_EDGE = 0.02  # of a feature's range, in which it goes to zero at the least
FOLDS = 2  # of the flights, for the decision whether an axis is corrected


@keyed
class RotorForce(ModelPart):
    """How it is fitted; see quadexp/plugins/identification/rotor_force.py."""

    rotor_radius: float | None = key(None, "of the rotors, for the induced velocity; null: without it", "(0, 10]", "m")
    inducing: int = key(30, "inducing points of an axis", "[2, 1000]", "points")
    max_rows: int = key(1500, "largest number of rows of the processes, drawn at random", "[10, 10000000]", "rows")
    max_iterations: int = key(40, "largest number of L-BFGS iterations", "[1, 10000]")
    seed: int = key(0, "seed of held-out flights and initial inducing points", SEEDS)
    refit: bool = key(True, "after the report, fit again to all flights", when="holdout")

    def fit(
        self, rows: ResidualDataset, *, start: Any = None, intervals: bool = True, callback: Callback = quiet
    ) -> RotorForceModel:
        """See ModelPart. start: decides which axes are corrected."""
        return fit_rotor_force(rows, self, start=start, intervals=intervals, callback=callback)


class RotorForceModel(GaussianProcessModel, frozen=True, tag="rotor_force"):
    """mean: the blade element. outputs: the processes, () where there is none. edges: of each feature least, lower and
    upper end of the bulk, largest, (features, 4). features: names. note: why nothing is corrected, or ""."""

    outputs: tuple[OutputPosterior, ...]
    mean: TermMean
    linear_drag: LinearDrag
    features: tuple[str, ...]
    edges: Annotated[np.ndarray, Shape("features 4")]
    note: str = ""
    predictor = "rotor_force"
    figure = ""

    def weight(self, rows: ResidualDataset) -> np.ndarray:
        """W at the rows, (k,)."""
        return np.prod(_step(np, rows.matrix(self.features), *self.edges.T), axis=1)

    def predict(self, rows: ResidualDataset) -> dict[str, Prediction]:
        """See Model.predict: of all three axes."""
        prior = self.mean.acceleration(rows)
        weight = self.weight(rows)
        spread = self.mean.model.residual_std**2
        predictions = {}
        for name, axis in AXIS.items():
            predictions[name] = Prediction(prior[:, axis], None, float(spread[axis]))
        for posterior in self.outputs:
            beyond = posterior.predict(rows.matrix(posterior.features))
            mean = prior[:, AXIS[posterior.output]] + weight * beyond.mean
            variance = weight**2 * beyond.variance + (1 - weight) ** 2 * posterior.signal_variance
            predictions[posterior.output] = Prediction(mean, variance, posterior.noise_variance)
        return predictions

    def residual(self, vehicle: Vehicle, source: str = "", part: str = "best") -> Residual:
        """See Model.residual."""
        self.require(part, source)
        mean = term_residual(vehicle, self.mean.structure, self.mean.parameters, source)
        if not self.outputs:
            return mean
        process = gaussian_process_residual(vehicle, self.outputs)
        theta = np.concatenate([mean.theta, process.theta, self.edges.ravel()])

        def summed(of_process: ca.Function) -> ca.Function:
            z, all_theta = symbols(ca.MX, z=len(feature_names(vehicle.n_rotors)), theta=len(theta))
            of_mean, of_points, edges = split(all_theta, [len(mean.theta), len(process.theta), self.edges.size])
            y_mean, slope_mean = mean.function(z, of_mean)
            y, slope = of_process(z, of_points)
            weight, weight_slope = _window(vehicle, self.features)(z, edges)
            whole = y_mean + weight * y
            whole_slope = slope_mean + weight * slope + y @ weight_slope
            return residual_function("rotor_force", z, all_theta, [whole, whole_slope])

        return Residual("rotor_force", summed(process.function), theta, source, summed(process.form(True)))

    def weighed(self, vehicle: Vehicle, residual: Residual) -> Residual:
        """Itself: outside its data it is its mean."""
        return residual

    def adapting(self, vehicle: Vehicle, residual: Residual, deviation: float) -> Adapting:
        """See Model.adapting."""
        raise UsageError(f"{residual.source}: {self.kind} has no weights that adapt in flight")

    def rivals(self, train: ResidualDataset) -> dict[str, Callable[[ResidualDataset], np.ndarray]]:
        """See Model.rivals: its mean, and a process of velocity."""
        by_velocity = dict.fromkeys(AXIS, VELOCITY)
        settings = GPConfig(
            features=GPFeatures(**by_velocity), mean="linear_drag", inducing=self.settings["inducing"],
            max_rows=self.settings["max_rows"], max_iterations=self.settings["max_iterations"],
        )  # fmt: skip
        other = fit_gp(train, settings, intervals=False)
        return {"its blade element alone": self.mean.acceleration, "GP of velocity": other.acceleration}

    @property
    def summary(self) -> str:
        if not self.outputs:
            return f"blade element alone: {self.note},"
        axes = ", ".join(posterior.output for posterior in self.outputs)
        rotors = len(self.features) - len(FEATURES)
        return f"blade element corrected along {axes} by velocity, rates and {rotors} rotors,"

    @property
    def numbers(self) -> dict[str, Any]:
        return {"coefficients": self.mean.model.records(), "note": self.note}

    def described(self, report: Callable[[], Mapping[str, Any]]) -> tuple[dict[str, Any], list[str]]:
        lines = [self.summary.rstrip(",")]
        for row in self.mean.model.records():
            half = row["high"] - row["value"]
            lines.append(f"{row['axis']} {row['term']:<11}{row['value']:.4g} +- {half:.2g} {row['unit']}")
        return self.numbers, [*lines, f"drag        {self.linear_drag}"]


def _step(ops: Any, x: Any, least: Any, low: Any, high: Any, largest: Any) -> Any:
    """S: 0 up to `least`, 1 from `low` to `high`, 0 from `largest` on. ops: numpy or CasADi."""
    rising = (x - least) / (low - least)
    falling = (largest - x) / (largest - high)
    inside = ops.fmax(0, ops.fmin(1, ops.fmin(rising, falling)))
    return inside**2 * (3 - 2 * inside)


def _window(vehicle: Vehicle, features: Sequence[str]) -> ca.Function:
    """(z, edges) -> W and dW/dz, (1, 6 + n)."""
    names = feature_names(vehicle.n_rotors)
    z, edges = symbols(ca.SX, z=len(names), edges=4 * len(features))
    weight: Expression = ca.SX(1)
    places = feature_places(names, features, "rotor_force")
    for place, ends in zip(places, split(edges, [4] * len(features)), strict=True):
        weight = weight * _step(ca, z[place[0]], *ca.vertsplit(ends))
    return ca.Function("window", [z, edges], [weight, ca.jacobian(weight, z)])


def edges_of(rows: ResidualDataset, features: Sequence[str]) -> np.ndarray:
    """See RotorForceModel.edges."""
    values = rows.matrix(features)
    least = values.min(axis=0)
    largest = values.max(axis=0)
    edge = LEAST_EDGE * (largest - least) + 1e-12
    low = np.maximum(np.quantile(values, BULK, axis=0), least + edge)
    high = np.minimum(np.quantile(values, 1 - BULK, axis=0), largest - edge)
    return np.column_stack([least, low, high, largest])


def without_speeds(rows: ResidualDataset) -> str:
    """Why the thrusts of a data set are not those of rotor speeds; "" where they are."""
    signal = (rows.metadata.get("thrust") or {}).get("signal")
    timings = rows.metadata.get("timing") or []
    if signal == "rotor_speed" or (timings and all(timing["measured"] for timing in timings)):
        return ""
    return f"this data set has no rotor speeds; its thrust is that of {signal or 'the commands u'}"


def fit_rotor_force(
    rows: ResidualDataset, settings: RotorForce, *, start: RotorForceModel | None, intervals: bool, callback: Callback
) -> RotorForceModel:
    """Fit mean and processes. start: a fit to part of the rows, whose axes are corrected again.

    Raises DataError where the rows do not determine the mean's coefficients.
    """
    drag = baseline(rows, intervals=intervals)
    scaled = with_common_scale(rows).dataset
    rotors = sorted((name for name in rows.columns if name.startswith("u_")), key=lambda name: int(name[2:]))
    features = (*FEATURES, *rotors)
    mean = fit_mean(scaled, settings.rotor_radius)
    note = without_speeds(rows)
    outputs = tuple[OutputPosterior, ...]()
    if not note:
        if start is not None:
            axes = [posterior.output for posterior in start.outputs]
        else:
            axes = _worth(scaled, features, settings)
        if axes:
            outputs = _processes(_beyond(scaled, mean), features, axes, settings, callback)
        else:
            note = "no process predicts flights left out better"
    return RotorForceModel(
        outputs, mean, drag, features, edges_of(scaled, features), note,
        **origin(rows, features, settings, ("numpy", "scipy", "torch", "gpytorch")),
    )  # fmt: skip


def fit_mean(rows: ResidualDataset, radius: float | None) -> TermMean:
    """The blade element, by least squares; radius (m): of the rotors, None without induced velocity."""
    if radius is None:
        return fit_term_mean(rows, "blade_element")
    mass = (rows.metadata.get("vehicle") or {}).get("mass")
    if not mass:
        raise DataError("model=rotor_force: the data set does not contain the vehicle's mass; collect it again")
    velocity = rows.matrix(VELOCITY)
    rotors = rows.rotor_thrusts / mass
    target = rows.matrix(list(AXIS))
    momentum = 2 * AIR_DENSITY * np.pi * radius**2 / mass  # 1/m
    inflow = fit_inflow(velocity, rotors, target[:, 2], momentum)
    flight = rows.columns["flight"]
    model = fit_terms(
        "blade_element", SELF_CONSISTENT, velocity, rotors, target, flight, flight, what="model=rotor_force",
        momentum=tuple(inflow.inflow), z=(inflow.design, inflow.target),
    )  # fmt: skip
    return TermMean(model, float(mass))


def _beyond(rows: ResidualDataset, mean: TermMean) -> ResidualDataset:
    """The rows with the mean subtracted, whose thrust has one scale already."""
    unexplained = rows.matrix(list(AXIS)) - mean.acceleration(rows)
    columns = {**rows.columns, **named(AXIS, unexplained.T)}
    return ResidualDataset(columns, {**rows.metadata, "recorded": False})


def _processes(
    rows: ResidualDataset, features: tuple[str, ...], axes: Sequence[str], settings: RotorForce, callback: Callback
) -> tuple[OutputPosterior, ...]:
    """One process an axis."""
    of_gp = GPConfig(
        features=GPFeatures(**dict.fromkeys(axes, features)), inducing=min(settings.inducing, rows.n_rows // 2),
        max_rows=settings.max_rows, max_iterations=settings.max_iterations, seed=settings.seed,
    )  # fmt: skip
    return fit_gp(rows, of_gp, callback=callback, intervals=False).outputs


def _worth(rows: ResidualDataset, features: tuple[str, ...], settings: RotorForce) -> list[str]:
    """The axes whose process predicts flights left out better than the mean; all where one flight is all there is."""
    number = np.unique(rows.columns["flight"], return_inverse=True)[1]
    if not number.any():
        return list(AXIS)
    gained = np.zeros(3)  # squares of errors of the mean, less those with the processes
    for fold in range(FOLDS):
        kept = rows.rows(number % FOLDS != fold)
        tested = rows.rows(number % FOLDS == fold)
        mean = fit_mean(kept, settings.rotor_radius)
        outputs = _processes(_beyond(kept, mean), features, list(AXIS), settings, quiet)
        trial = RotorForceModel(outputs, mean, baseline(kept, intervals=False), features, edges_of(kept, features))
        target = tested.matrix(list(AXIS))
        gained += np.sum((target - mean.acceleration(tested)) ** 2, axis=0)
        gained -= np.sum((target - trial.acceleration(tested)) ** 2, axis=0)
    return [name for name, axis in AXIS.items() if gained[axis] > 0]
