"""The seam of all that is learned from flights: a model is a record that predicts, is flown, and is stored.

    rows of flights -> fit -> Model -> predict (numpy), residual (CasADi), checkpoint (its fields, as they stand)

A record's fields are its checkpoint: type, range and shape stand beside each, and are checked whenever one is made, in
Python or from a file. CasADi and PyTorch are imported when they are first needed, so loading a checkpoint and
predicting need numpy only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import cache
from importlib import import_module
from typing import Annotated, Any, ClassVar, NamedTuple, get_type_hints

import msgspec
import numpy as np

from quadexp.models.dataset import ResidualDataset
from quadexp.models.online import Adapting
from quadexp.models.residual import Residual
from quadexp.parts.settings import Setting, record
from quadexp.physics.vehicle import Vehicle

Callback = Callable[[str, float], None]
AXIS = {"a_x": 0, "a_y": 1, "a_z": 2}  # outputs that are accelerations
Positive = Annotated[float, msgspec.Meta(gt=0)]
Share = Annotated[float, msgspec.Meta(ge=0)]
Output = Annotated[str, msgspec.Meta(pattern=r"^(a|tau)_[xyz]$")]  # quadexp.physics.correction.OUTPUTS
Rotors = Annotated[int, msgspec.Meta(ge=1, le=64)]
HOLDOUT = Setting("share of the flights held out of the fit, on which it is reported", "[0, 0.9]", "of the flights")


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
    the baseline, linear drag of the same rows. predictor: its name in tables. maker: the command that makes its
    checkpoint. Settings: of its fit.
    """

    vehicle: dict[str, Any] = {}
    dataset: dict[str, Any] = {}
    settings: dict[str, Any] = {}
    feature_range: dict[str, Annotated[list[float], msgspec.Meta(min_length=2, max_length=2)]] = {}
    versions: dict[str, str] = {}
    predictor: ClassVar[str]
    maker: ClassVar[str]
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


def model_class(kind: str) -> type[Model]:
    """The models of a kind: the class with that tag, in the module of that name."""
    module = import_module(f"quadexp.models.{kind}")
    classes = [item for item in vars(module).values() if isinstance(item, type) and issubclass(item, Model)]
    return next(item for item in classes if item.__struct_config__.tag == kind)


def fit_record(settings: Any) -> dict[str, Any]:
    """The settings of a fit for its checkpoint."""
    return {key: value for key, value in record(settings).items() if key != "name"}


def rms(error: np.ndarray) -> float:
    """Root mean square of numbers (k,), or of vectors (k, 3)."""
    return float(np.sqrt(np.mean(np.sum(error.reshape(len(error), -1) ** 2, axis=1))))
