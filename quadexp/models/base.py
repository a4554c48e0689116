"""The seam of all that is learned from flights: a model is a record that predicts, is flown, and is stored.

    rows of flights -> fit -> Model -> predict (numpy), residual (CasADi), checkpoint (its fields, as they stand)

A record's fields are its checkpoint: type, range and shape stand beside each, and are checked whenever one is made, in
Python or from a file. CasADi and PyTorch are imported when they are first needed, so loading a checkpoint and
predicting need numpy only.

A model knows the range of the rows of its fit. A sample is outside where any of these is below the least or above the
largest value there: body velocity relative to the air (m/s), its norm, and every other feature of the model, each by
itself. Not detected are combinations that the rows do not contain (full thrust at full speed) and gaps inside a range.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from functools import cache
from importlib import import_module
from importlib.metadata import version
from typing import Annotated, Any, ClassVar, NamedTuple, get_type_hints

import msgspec
import numpy as np

from quadexp.errors import DataError, UsageError
from quadexp.models.adapting import Adapting
from quadexp.models.dataset import ResidualDataset
from quadexp.models.residual import VELOCITY, Residual
from quadexp.names import without
from quadexp.parts.models import kind_of_class, model_part
from quadexp.parts.part import Part
from quadexp.parts.settings import SEEDS, Setting, key, keyed, record
from quadexp.physics.state import norms
from quadexp.physics.vehicle import Vehicle
from quadexp.plugin import shipped_places

Callback = Callable[[str, float], None]  # given a message and the completed share, 0 .. 1
SPEED = "speed"  # norm of the body velocity, m/s
AXIS = {"a_x": 0, "a_y": 1, "a_z": 2}  # outputs that are accelerations
Positive = Annotated[float, msgspec.Meta(gt=0)]
Share = Annotated[float, msgspec.Meta(ge=0)]
Output = Annotated[str, msgspec.Meta(pattern=r"^(a|tau)_[xyz]$")]  # quadexp.physics.rigid_body.OUTPUTS
Rotors = Annotated[int, msgspec.Meta(ge=1, le=64)]
HOLDOUT = Setting("share of the flights held out of the fit, on which it is reported", "[0, 0.9]", "of the flights")


class Shape(NamedTuple):
    """Shape of an array, such as "alpha features", as an annotation of its field.

    A word is a number, or a field of the same record: its length.
    """

    text: str

    def of(self, record: Any) -> tuple[int, ...]:
        """The shape that is needed."""
        return tuple(int(word) if word.isdigit() else len(getattr(record, word)) for word in self.text.split())


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
            if array is not None and np.shape(array) != (needed := shape.of(self)):
                raise ValueError(f"{name} is of shape {np.shape(array)}; {needed} is needed")


def quiet(message: str, done: float) -> None:
    """The callback that says nothing."""


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


@keyed
class ModelPart(Part):
    """What is learned, as an option of the group `model`; its settings are those of its fit.

    The module of the class has the name of the option: this is the kind of the model, controller.residual=KIND flies
    its checkpoint. judged: whether the report of a fit has a verdict against linear drag.
    """

    prefix = "model."
    judged: ClassVar[bool] = True

    holdout: float = key(0.2, HOLDOUT)
    seed: int = key(0, "draws the held-out flights", SEEDS, when="holdout")

    @property
    def kind(self) -> str:
        return kind_of_class(type(self))

    def fit(
        self, rows: ResidualDataset, *, start: Any = None, intervals: bool = True, callback: Callback = quiet
    ) -> Any:
        """The Model that fits the rows.

        start: the same fitted to part of the rows. intervals: False omits those of linear drag.
        Raises DataError where the rows do not suffice.
        """
        raise NotImplementedError


class Model(Record, frozen=True, kw_only=True, tag_field="kind"):
    """What was learned of a vehicle, the contents of a checkpoint.

    vehicle: {name, fingerprint}. dataset: record of the data: hash, rows, flights. settings: of the fit.
    feature_range: of its rows, see `feature_ranges`. versions: library -> version. linear_drag, of every kind:
    the baseline, linear drag of the same rows. predictor: its name in tables. figure: MODULE:FUNCTION that draws a
    model and rows of data, "" for none.
    """

    vehicle: dict[str, Any] = {}
    dataset: dict[str, Any] = {}
    settings: dict[str, Any] = {}
    feature_range: dict[str, Annotated[list[float], msgspec.Meta(min_length=2, max_length=2)]] = {}
    versions: dict[str, str] = {}
    predictor: ClassVar[str]
    figure: ClassVar[str] = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, (low, high) in self.feature_range.items():
            if low > high:
                raise ValueError(f"feature_range[{name!r}] is [{low}, {high}]; [least, largest] is needed")

    @staticmethod
    def require_each_once(outputs: Sequence[str]) -> None:
        """Raise ValueError where an output is named twice."""
        if len(set(outputs)) < len(outputs):
            raise ValueError(f"outputs are {', '.join(outputs)}; each is allowed once")

    @property
    def kind(self) -> str:
        """The word for it in a checkpoint, and in controller.residual."""
        return str(type(self).__struct_config__.tag)

    def predict(self, rows: ResidualDataset) -> dict[str, Prediction]:
        """Output -> prediction at the rows. Raises DataError where a feature is missing."""
        raise NotImplementedError

    def acceleration(self, rows: ResidualDataset) -> np.ndarray:
        """Predicted residual acceleration, body frame, (k, 3) (m/s^2)."""
        predictions = self.predict(rows)
        zero = np.zeros(rows.n_rows)
        return np.column_stack([predictions[a].mean if a in predictions else zero for a in AXIS])

    def residual(self, vehicle: Vehicle, source: str = "", part: str = "best") -> Residual:
        """The same for a controller or a plant. part: which of several models, "best" for its own choice.

        Raises UsageError where it holds no such part.
        """
        raise NotImplementedError

    def require(self, part: str, source: str) -> None:
        """Raise UsageError where a part is asked for that is not the only one."""
        if part not in ("best", self.kind, self.kind.removesuffix("_drag")):
            raise UsageError(f"{source}: holds {self.kind}, not '{part}'")

    def weighed(self, vehicle: Vehicle, residual: Residual) -> Residual:
        """`residual` of this model, weighed by its own variance: outside its data it falls back to a mean function.

        Raises UsageError where the model states no variance.
        """
        raise UsageError(f"{residual.source}: {self.kind} states no variance to fall back by")

    def adapting(self, vehicle: Vehicle, residual: Residual, deviation: float) -> Adapting:
        """The residual with weights that adapt in flight. deviation: of the prior, m/s^2.

        Raises UsageError where the model has none.
        """
        raise UsageError(f"{residual.source}: {self.kind} has no weights that adapt in flight")

    def rivals(self, train: ResidualDataset) -> dict[str, Callable[[ResidualDataset], np.ndarray]]:
        """Others to stand beside it on held-out flights, fitted to `train`: name -> acceleration of rows, (k, 3)."""
        return {}

    @property
    def part(self) -> ModelPart:
        """What it was fitted by, with the settings of its fit. Raises UsageError where its option is not there."""
        part: Any = model_part(self.kind)
        names = {f.name for f in fields(part)}
        return replace(part, **{key: value for key, value in self.settings.items() if key in names})

    def refitted(self, rows: ResidualDataset) -> Any:
        """A model of the same kind and settings, fitted to other rows."""
        return self.part.fit(rows, intervals=False)

    def described(self, report: Callable[[], Mapping[str, Any]]) -> tuple[dict[str, Any], list[str]]:
        """What `quadexp show` says of it beside what all models have: JSON-able numbers, and lines. report: reads
        that of its fit."""
        return {}, [f"drag        {self.linear_drag}"]  # type: ignore[attr-defined]  # of every kind

    @property
    def summary(self) -> str:
        """What was fitted, for the first line of a report."""
        raise NotImplementedError

    @property
    def numbers(self) -> dict[str, Any]:
        """What else of the model stands in the report of its fit, JSON-able."""
        return {}


def model_class(kind: str) -> type[Model]:
    """The records of a kind: the class with that tag, in the module of this package of that name, or beside the class
    of a user's own option. Raises UsageError where there is none."""
    module = import_module(shipped_places("models").get(kind) or type(model_part(kind)).__module__)
    for item in vars(module).values():
        if isinstance(item, type) and issubclass(item, Model) and item.__struct_config__.tag == kind:
            return item
    raise UsageError(f"{module.__name__}: has no class of quadexp.models.base.Model with tag={kind!r}")


def figure_of(model: Model, rows: ResidualDataset, said: str) -> Any:
    """The figure of a fitted model with rows of data. Raises UsageError where its kind draws none; said: the model."""
    if not model.figure:
        raise UsageError(f"{said}: holds {model.kind}, which no figure shows; Gaussian processes have one")
    module, _, function = model.figure.partition(":")
    return getattr(import_module(module), function)(model, rows)


def rms(error: np.ndarray) -> float:
    """Root mean square of numbers (k,), or of vectors (k, 3)."""
    return float(np.sqrt(np.mean(np.sum(error.reshape(len(error), -1) ** 2, axis=1))))


def origin(
    rows: ResidualDataset, features: Sequence[str] = (), settings: Any = None, libraries: Sequence[str] = ()
) -> dict[str, Any]:
    """What a model's record says of its fit: vehicle, dataset, settings, feature_range, versions of the libraries."""
    stated = {} if settings is None else without(record(settings), ["name"])
    vehicle = dict(rows.metadata.get("vehicle") or {})
    return {
        "vehicle": vehicle, "dataset": rows.summary(), "settings": stated,
        "feature_range": feature_ranges(rows, features), "versions": {name: version(name) for name in libraries},
    }  # fmt: skip


def feature_ranges(rows: ResidualDataset, features: Sequence[str] = ()) -> dict[str, list[float]]:
    """[least, largest] of body velocity, speed and the features named, over all rows."""
    ranges = {}
    for name in dict.fromkeys([*VELOCITY, SPEED, *features]):
        values = _values(rows, name)
        ranges[name] = [0.0 if name == SPEED else float(values.min()), float(values.max())]
    return ranges


def outside(ranges: Mapping[str, Sequence[float]], rows: ResidualDataset) -> dict[str, np.ndarray]:
    """Which rows are outside each range, and outside "any" of them, (k,) each."""
    values = {name: _values(rows, name) for name in ranges}
    masks = {name: (values[name] < low) | (values[name] > high) for name, (low, high) in ranges.items()}
    return masks | {"any": np.logical_or.reduce(list(masks.values()))}


def outside_shares(ranges: Mapping[str, Sequence[float]], rows: ResidualDataset) -> dict[str, float]:
    """Share of the rows outside each range, and outside "any" of them."""
    return {name: float(mask.mean()) for name, mask in outside(ranges, rows).items()}


def _values(rows: ResidualDataset, name: str) -> np.ndarray:
    """Values of a feature, or of the speed, (k,)."""
    if name == SPEED:
        return norms(rows.matrix(VELOCITY))
    return rows.matrix([name])[:, 0]


def require_variation(rows: ResidualDataset, features: Sequence[str], outputs: Sequence[str], key: str) -> None:
    """Raise DataError unless there are rows with these columns, and every feature varies. key: for the message."""
    if not rows.n_rows:
        raise DataError("dataset: it has no rows")
    rows.matrix(outputs)
    for name, spread in zip(features, rows.matrix(features).std(axis=0), strict=True):
        if spread < 1e-9:
            raise DataError(f"{key}: '{name}' never changes over the {rows.n_rows} rows; leave it out")


@contextmanager
def one_thread() -> Iterator[None]:
    """torch on one thread, so that the order of summation, and with it the result, does not depend on the machine."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
