"""The seam of all that is learned from flights: a model is a record that predicts, is flown, and is stored.

    rows of flights -> fit -> Model -> predict (numpy), residual (CasADi), checkpoint (its fields, as they stand)

A record's fields are its checkpoint: type, range and shape stand beside each, and are checked whenever one is made, in
Python or from a file. CasADi and PyTorch are imported when they are first needed, so loading a checkpoint and
predicting need numpy only.

What a controller or a plant takes of it is a Residual, the acceleration and torque beyond the rigid body: one CasADi
function of body-frame quantities and runtime parameters,

    y, dy/dz = r(z, theta)
    z = [v_body (3, m/s), w (3, rad/s), u (n, N)]            (6 + n,)
    y = [a_body (3, m/s^2), tau_body (3, N m)]               (6,)

so that v' = R (T e_z / m + a_body) + g and J w' = tau + tau_body - w x J w. The function also returns the Jacobian,
because a learned model has a cheaper one than automatic differentiation. theta is an input of every compiled function:
new coefficients do not require recompilation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, get_type_hints

import msgspec
import numpy as np
import numpy.typing as npt

from quadexp.compile.symbolic import ca
from quadexp.errors import UsageError
from quadexp.physics.correction import FEATURES, N_OUTPUTS, OUTPUTS
from quadexp.physics.expression import Expression
from quadexp.physics.vehicle import Vehicle

if TYPE_CHECKING:
    from quadexp.models.dataset import ResidualDataset
    from quadexp.models.online import Adapting

__all__ = ["FEATURES", "N_OUTPUTS", "OUTPUTS", "Model", "Residual", "feature_names", "no_residual", "symbolic_residual"]

Callback = Callable[[str, float], None]
AXES = "xyz"
VELOCITY = ("v_x", "v_y", "v_z")
THRUST = "thrust"  # feature: sum of the rotor thrusts (N)
AXIS = {"a_x": 0, "a_y": 1, "a_z": 2}  # outputs that are accelerations
Positive = Annotated[float, msgspec.Meta(gt=0)]
Share = Annotated[float, msgspec.Meta(ge=0)]
Output = Annotated[str, msgspec.Meta(pattern=r"^(a|tau)_[xyz]$")]  # quadexp.physics.correction.OUTPUTS
Rotors = Annotated[int, msgspec.Meta(ge=1, le=64)]


class Shape(NamedTuple):
    """Shape of an array, such as "alpha features" or "powers | rotors powers", as an annotation of its field.

    A word is a number, or a field of the same record: its value if it is a number, else its length.
    """

    text: str

    def of(self, record: Any) -> list[tuple[int, ...]]:
        """The shapes that are allowed."""

        def length(word: str) -> int:
            value = int(word) if word.isdigit() else getattr(record, word)
            return value if isinstance(value, int) else len(value)

        return [tuple(map(length, shape.split())) for shape in self.text.split("|")]


Three = Annotated[np.ndarray, Shape("3")]  # one number per axis


@cache
def _shapes(kind: type) -> dict[str, Shape]:
    """Field -> shape, of a class of records."""
    hints = get_type_hints(kind, include_extras=True).items()
    return {name: part for name, hint in hints for part in getattr(hint, "__metadata__", ()) if isinstance(part, Shape)}


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Named values that belong together. Raises ValueError where an array has another shape than its field states."""

    def __post_init__(self) -> None:
        for name, shape in _shapes(type(self)).items():
            array = getattr(self, name)
            if array is not None and np.shape(array) not in (allowed := shape.of(self)):
                raise ValueError(f"{name} is of shape {np.shape(array)}; {' or '.join(map(str, allowed))} is needed")


@dataclass(frozen=True)
class Residual:
    """A residual model: function, parameters, and their source.

    name: for output ("none", "linear_drag", "gaussian_process", ...).
    function: CasADi, (z (6 + n,), theta (p,)) -> (y (6,), dy/dz (6, 6 + n)); entries that are always zero are
        structural zeros, so that code using it can omit them.
    theta: parameter values, (p,). source: checkpoint path or a word, for the record.
    to_compile: the same function in a form suited for compilation; None: `function` itself.
    ranges: feature -> [least, largest] of the data of the fit (models.support); None where unknown or not fitted.
    unscaled: of a residual whose last parameter is a scale of the outputs, the residual without it (models.sum).
    """

    name: str
    function: ca.Function
    theta: np.ndarray
    source: str = ""
    to_compile: ca.Function | None = None
    ranges: Mapping[str, Sequence[float]] | None = field(default=None, compare=False)
    unscaled: Residual | None = None

    def __call__(self, features: np.ndarray) -> np.ndarray:
        """Residual at many points: features (k, 6 + n) -> outputs (k, 6) in the units of `OUTPUTS`."""
        features = np.atleast_2d(features)
        outputs, _ = self.function(features.T, np.tile(self.theta[:, None], (1, len(features))))
        return np.array(ca.DM(outputs).full()).T

    @property
    def is_zero(self) -> bool:
        """Whether the outputs are structurally zero."""
        return self.function.nnz_out(0) == 0


def feature_names(n_rotors: int) -> tuple[str, ...]:
    """Names of the entries of z: body velocity (m/s), body rate (rad/s), rotor thrusts (N)."""
    return FEATURES + tuple(f"u_{i}" for i in range(n_rotors))


def feature_places(names: Sequence[str], features: Iterable[str], what: str) -> list[list[int]]:
    """Places of each feature in z; of the collective thrust those of all rotors. what: the model, for messages.

    Raises UsageError for an unknown feature.
    """
    places = {name: [i] for i, name in enumerate(names)} | {THRUST: list(range(len(FEATURES), len(names)))}
    for feature in features:
        if feature not in places:
            raise UsageError(f"{what} feature {feature!r}: allowed are {', '.join(places)}")
    return [places[feature] for feature in features]


def symbolic_residual(
    name: str, outputs: Expression, features: Expression, theta: Expression, values: npt.ArrayLike, *,
    source: str = "", slope: Expression | None = None,
) -> Residual:  # fmt: skip
    """A residual from SX expressions: outputs (6,), of features (6 + n,) and theta (p,), p may be 0.

    values: (p,). slope: the Jacobian, (6, 6 + n); None: by automatic differentiation.
    """
    if slope is None:
        outputs, slope = ca.sparsify(outputs), ca.jacobian(outputs, features)
    else:
        outputs, slope = ca.cse([outputs, slope])
    function = ca.Function(f"residual_{name}", [features, theta], [outputs, slope], ["z", "theta"], ["y", "dy_dz"])
    return Residual(name, function, np.asarray(values, float).ravel(), source)


def no_residual(vehicle: Vehicle) -> Residual:
    """y = 0, structurally: the nominal rigid body."""
    features = ca.SX.sym("z", len(feature_names(vehicle.n_rotors)))
    return symbolic_residual("none", ca.SX(N_OUTPUTS, 1), features, ca.SX.sym("theta", 0), [])


class Prediction(NamedTuple):
    """mean: (k,), unit of the output. variance: (k,), of the function; None where the model states none.
    noise_variance: of one measurement."""

    mean: np.ndarray
    variance: np.ndarray | None
    noise_variance: float

    @property
    def std(self) -> np.ndarray:
        """Standard deviation of a new measurement, (k,)."""
        return np.sqrt((0 * self.mean if self.variance is None else self.variance) + self.noise_variance)


class Model(Record, frozen=True, kw_only=True, tag_field="kind"):
    """What was learned of a vehicle, the contents of a checkpoint.

    vehicle: {name, fingerprint}. dataset: record of the data: hash, rows, flights. settings: of the fit.
    feature_range: of its rows, see quadexp.models.support. versions: library -> version. linear_drag, of every kind:
    the baseline, linear drag of the same rows. predictor: its name in tables. Settings: of its fit, a dataclass.
    """

    vehicle: dict[str, Any] = {}
    dataset: dict[str, Any] = {}
    settings: dict[str, Any] = {}
    feature_range: dict[str, Annotated[list[float], msgspec.Meta(min_length=2, max_length=2)]] = {}
    versions: dict[str, str] = {}
    predictor: ClassVar[str]
    Settings: ClassVar[type]

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, (low, high) in self.feature_range.items():
            if low > high:
                raise ValueError(f"feature_range[{name!r}] is [{low}, {high}]; [least, largest] is needed")

    @property
    def kind(self) -> str:
        """The word for it in a checkpoint, and in controller.residual."""
        return str(type(self).__struct_config__.tag)

    def predict(self, rows: ResidualDataset) -> dict[str, Prediction]:
        """Output -> prediction at the rows. Raises DataError where a feature is missing."""
        raise NotImplementedError

    def acceleration(self, rows: ResidualDataset) -> np.ndarray:
        """Predicted residual acceleration, body frame, (k, 3) (m/s^2)."""
        predictions, zero = self.predict(rows), np.zeros(rows.n_rows)
        return np.stack([predictions[a].mean if a in predictions else zero for a in AXIS], axis=1)

    def residual(self, vehicle: Vehicle, source: str = "", part: str = "best") -> Residual:
        """The same for a controller or a plant. part: which of several models, where there are several."""
        raise NotImplementedError

    def adapting(self, vehicle: Vehicle, residual: Residual, deviation: float | None) -> Adapting:
        """The residual with weights that adapt in flight. deviation: of the prior, m/s^2; None: that of the fit."""
        raise NotImplementedError

    @classmethod
    def fit(
        cls,
        rows: ResidualDataset,
        settings: Any,
        *,
        start: Any = None,
        intervals: bool = True,
        callback: Callback | None = None,
    ) -> Any:
        """The model that fits the rows.

        settings: of Settings. start: the same fitted to part of the rows. intervals: False omits those of linear drag.
        callback: called with a message and the completed share, 0 .. 1. Raises DataError where the rows do not suffice.
        """
        raise NotImplementedError

    def refitted(self, rows: ResidualDataset) -> Any:
        """A model of the same kind and settings, fitted to other rows."""
        names = {f.name for f in fields(self.Settings)}
        settings = {key: value for key, value in self.settings.items() if key in names}
        return self.fit(rows, self.Settings(**settings), intervals=False)

    @property
    def summary(self) -> str:
        """What was fitted, for the first line of a report."""
        raise NotImplementedError

    @property
    def numbers(self) -> dict[str, Any]:
        """What else of the model stands in the report of its fit, JSON-able."""
        return {}


def rms(error: np.ndarray) -> float:
    """Root mean square of numbers (k,), or of vectors (k, 3)."""
    return float(np.sqrt(np.mean(np.sum(error.reshape(len(error), -1) ** 2, axis=1))))
