"""The feedback controller of Lei & Li 2017 as a `Controller` (quadexp.control.base)."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from quadexp.compile.backend import BufferedFunction, resolve
from quadexp.control.base import Window
from quadexp.control.built import built
from quadexp.control.feedback.frames import FRD_FLU
from quadexp.control.feedback.law import VARIANTS, FeedbackSettings, Variant, hover_rotor_speed, law_function
from quadexp.control.instant import InOperations, Instant, Operation, Told, call, copy, python
from quadexp.control.mpc.active_set import Status
from quadexp.control.mpc.mpc import StepRecord
from quadexp.control.part import ControllerPart
from quadexp.errors import UsageError
from quadexp.models.rls import BladeElementRLS, Identification
from quadexp.names import named
from quadexp.parts.part import Given
from quadexp.parts.settings import REQUIRED, Backend, key, keyed, part
from quadexp.physics.rotation import air_velocity
from quadexp.physics.rotor import THETA
from quadexp.physics.state import ATTITUDE, VELOCITY
from quadexp.physics.vehicle import Vehicle

INNOVATION_SAMPLES = 10  # time constant, in samples, of the mean square innovation
FIRST_WAIT, NEXT_WAIT = 100, 50  # samples without change detection: at the start, and after a detected change
INNER_TOLERANCE = 1e-10  # rad/s and rad, of the fixed point without delay


def body_velocity(x: np.ndarray) -> np.ndarray:
    """Velocity in the body frame, (3,), FLU (m/s), of a state (13,), neglecting the unmeasured wind."""
    return air_velocity(x[ATTITUDE], x[VELOCITY])


class KnownCoefficients:
    """Constant coefficients.

    theta: (C_d0, C_la, C_Dx, C_Dy, C_Dz), (5,). source: for the record.
    """

    def __init__(self, theta: np.ndarray, source: str) -> None:
        self.theta, self.source = np.asarray(theta, float), source

    def reset(self) -> None:
        """Begin a flight."""

    def log(self) -> dict[str, float]:
        """No columns."""
        return {}


class IdentifiedCoefficients:
    """Coefficients by recursive least squares from accelerometer and rotor speeds, restarted in every flight.

    change_threshold: detects a change of the vehicle: where the mean square innovation over the last samples exceeds
    that of the assumed noise by this factor, the covariance is reset (Estimator.reset_covariance). None: never.
    """

    source = "RLS in flight"

    def __init__(self, estimator: BladeElementRLS, change_threshold: float | None = None) -> None:
        self.estimator, self.change_threshold = estimator, change_threshold
        self.reset()

    def reset(self) -> None:
        """Begin a flight with the initial values."""
        self.estimator.reset()
        self.reopened, self._wait = 0, FIRST_WAIT
        self._innovation = 1.0

    @property
    def theta(self) -> np.ndarray:
        """The estimate, clipped, (5,)."""
        return self.estimator.theta

    def update(self, x: np.ndarray, specific_force: np.ndarray, rotor_speed: np.ndarray) -> None:
        """Update the estimate from a state, (13,), and readings, (3,) (m/s^2) and (n,) (rad/s)."""
        estimator = self.estimator
        estimator.update(body_velocity(x), rotor_speed, specific_force)
        if self.change_threshold is not None and estimator.samples:
            error = estimator.error / estimator.settings.noise
            self._innovation += (float(error @ error) / 3 - self._innovation) / INNOVATION_SAMPLES
            self._wait -= 1
            if self._wait <= 0 and self._innovation > self.change_threshold:
                estimator.reset_covariance()
                self.reopened, self._wait = self.reopened + 1, NEXT_WAIT

    def log(self) -> dict[str, float]:
        """The estimate by coefficient; number of clips and of covariance resets so far."""
        estimator = self.estimator
        counts = {"clips": float(estimator.clips.sum()), "reopened": float(self.reopened)}
        return {**named(THETA, estimator.theta.tolist()), **counts}


class FeedbackController(InOperations):
    """Tracks position and heading of the reference; see Controller.

    vehicle: with rotor geometry and thrust coefficient. aerodynamics: coefficients for the variant's compensation.
    """

    reference_period = 0.0
    residual = None

    def __init__(
        self,
        vehicle: Vehicle,
        settings: FeedbackSettings,
        variant: Variant,
        aerodynamics: KnownCoefficients | IdentifiedCoefficients,
        *,
        backend: str = "auto",
    ) -> None:
        if vehicle.rotor is None or vehicle.thrust_coefficient is None:
            raise UsageError(
                f"vehicle={vehicle.name}: feedback control needs vehicle.rotor and vehicle.thrust_coefficient;"
                " vehicle=lei_li has them"
            )
        self.vehicle, self.settings, self.variant, self.aerodynamics = vehicle, settings, variant, aerodynamics
        self.backend, self.control_period = resolve(backend), settings.control_period
        self.node_times = np.zeros(1)
        self.name = "thrust_map" if variant.parameters == "none" else "blade_element"
        self.source = aerodynamics.source
        self._law = BufferedFunction(built(backend, law_function, vehicle, settings, variant))

    def forget(self) -> None:
        """See Controller.forget. Nothing to do: references contain no residual, `reset` resets the estimator."""

    def reset(self, x: np.ndarray, window: Window) -> None:
        """See Controller.reset. Initial values of the previous sample: hover rotor speeds and R_d = I."""
        super().reset(x, window)
        arguments = self._law.arguments
        self.aerodynamics.reset()
        arguments["velocity_last"][...] = FRD_FLU @ body_velocity(x)
        arguments["rotor_speed_last"][...] = hover_rotor_speed(self.vehicle)
        arguments["eta_d_last"][...], arguments["observer_last"][...] = 0.0, 0.0

    def instant(self, told: Told, state: np.ndarray) -> Instant:
        """See control.instant."""
        given, results, read = self._law.arguments, self._law.results, told.read
        speed, both = given["rotor_speed_last"], np.zeros(1)
        operations = [copy(both, read), copy(both, told.turning, read), copy(speed, told.speed, both)]
        if isinstance(identified := self.aerodynamics, IdentifiedCoefficients):
            operations.append(python(lambda: identified.update(state, told.force, speed), read))
        operations += [python(lambda: np.copyto(given["theta"], self.aerodynamics.theta)), copy(given["x"], state)]
        operations += [copy(given["reference"], told.path[:3]), copy(given["yaw"], told.yaw[:3])]
        operations.append(Operation("add", given["yaw"][1:2], told.yaw[1:2], told.yaw[3:]))
        operations += [call(self._law), *([] if self.variant.delayed else [python(self._iterate)])]
        names = ("rotor_speed", "eta_d", "observer", "velocity")
        operations += [copy(given[f"{name}_last"], results[name]) for name in names]

        def record(took: float) -> StepRecord:
            status = Status.RICCATI if np.isfinite(results["thrust"]).all() else Status.FAILED
            return StepRecord(took, status, 0, int(results["floored"][0] + results["limited"][0]), 0.0)

        return Instant(operations, results["thrust"], record)

    def log(self) -> dict[str, float]:
        """See Controller.log: desired tilt and its error (rad, FRD), active safety limits, coefficients."""
        results = self._law.results
        roll, pitch, _ = results["eta_d"]
        return {
            "phi_d": roll,
            "theta_d": pitch,
            "error_eta": float(np.sqrt(results["error"] @ results["error"])),
            "cone": results["outside"][0],
            "floored": results["floored"][0],
            "limited": results["limited"][0],
            **self.aerodynamics.log(),
        }

    def _iterate(self) -> None:
        """Compensation terms of this sample instead of the previous one: fixed-point iteration of the law."""
        arguments, results = self._law.arguments, self._law.results
        for _ in range(self.settings.inner_iterations):
            change = np.abs(arguments["rotor_speed_last"] - results["rotor_speed"]).max()
            change += np.abs(arguments["eta_d_last"] - results["eta_d"]).max()
            if not change > INNER_TOLERANCE:
                return
            for name in ("rotor_speed", "eta_d", "velocity"):
                arguments[f"{name}_last"][...] = results[name]
            self._law()


@keyed
class Feedback(FeedbackSettings, ControllerPart):
    """Compensated feedback. variant: what is compensated, and from where."""

    former_kind = "feedback"
    variant: Literal["rls", "static", "literal", "nocomp_statid", "oracle", "oracle_impl", "rls_noH", "static_H"] = key(
        REQUIRED, "what is compensated, and the source of the coefficients; see docs/lei_li.md"
    )
    backend: Backend = "auto"
    rls: Identification = key(REQUIRED, "recursive least squares in flight")

    @property
    def knows_plant(self) -> bool:
        """See ControllerPart."""
        return VARIANTS[self.variant].parameters == "true"

    def build(self, given: Given) -> Any:
        """See ControllerPart; UsageError where it is to know coefficients that the plant does not have."""
        variant = VARIANTS[self.variant]
        aerodynamics: KnownCoefficients | IdentifiedCoefficients
        if variant.parameters == "none":
            aerodynamics = KnownCoefficients(np.zeros(len(THETA)), "the vehicle's thrust map")
        elif variant.parameters == "identified":
            estimator = self.rls.build(given.vehicle, self.backend)
            aerodynamics = IdentifiedCoefficients(estimator, self.rls.change_threshold)
        elif hasattr(given.plant, "coefficients"):
            aerodynamics = KnownCoefficients(given.plant.coefficients.parameters(), "plant equations")
        else:
            raise UsageError(f"{self.name}: knows the plant's blade-element coefficients; plant=blade_element has them")
        settings = part(FeedbackSettings, self)
        return FeedbackController(given.vehicle, settings, variant, aerodynamics, backend=self.backend)
