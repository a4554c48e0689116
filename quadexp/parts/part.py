"""A part: one class in one file, that an option of a group names by `_target_`.

    # conf/wind/gust.yaml
    _target_: quadexp.world.gust.Gust

    class Gust(Effect):
        onset: Annotated[float, Setting("when the gust begins", "[0, 14400]", "s")] = 2.0

The class's fields are the option's keys, with unit, range, meaning and default: one line a key (settings.py). What a
part is made into is said by the group's own base class (Effect, TrajectoryPart, PlantPart, ControllerPart, Remedy).
Nothing else lists parts; `part_class` finds those of this program and of a user alike.

A user's own lie in a folder given with --conf, or in an installed package that offers its configuration folder, laid
out as conf/ is, by an entry point:

    [project.entry-points."quadexp.conf"]
    my_lab = "my_lab.conf"

`_target_` names what lies in one of these places and nothing else, so that a configuration file alone cannot name code
that nobody meant to run; a --conf folder with modules in it is code.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
import os
import pickle
import sys
from dataclasses import dataclass
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from quadexp.errors import ModuleError, UsageError
from quadexp.messages import suggestion
from quadexp.parts.sensor_sheet import SensorSheet
from quadexp.parts.settings import Name, Settings, record

if TYPE_CHECKING:
    from importlib.metadata import EntryPoints

TARGET = "_target_"  # key of an option that names the class of its part
OWN = "quadexp"  # the package whose classes any option may name
ENTRY_POINTS = "quadexp.conf"  # group of the entry points of plugin packages


@dataclass(frozen=True, kw_only=True)
class Part(Settings):
    """Base of what an option stands for. name: what tables and figures call it; that of the option unless it says so.

    former_kind: what stands for the class in hashes, so that stored flights and cells keep theirs; "" for nothing.
    added: keys that it did not always have, recorded where they are not as usual.
    """

    former_kind: ClassVar[str] = ""
    added: ClassVar[tuple[str, ...]] = ()

    name: Name = "unnamed"

    @property
    def idle(self) -> bool:
        """Whether it does nothing: a flight is what it would be without this part."""
        return False

    @property
    def names_world(self) -> bool:
        """Whether a world of it alone has a name in tables; of parts of a world."""
        return not self.idle

    @property
    def shipped(self) -> bool:
        """Whether it is of this program, and not a user's own."""
        return type(self).__module__.partition(".")[0] == OWN

    def recorded(self) -> dict[str, Any]:
        """Its settings as plain data, for files and hashes."""
        return dict(self._recorded)

    @functools.cached_property
    def _recorded(self) -> dict[str, Any]:
        usual = {k for k in self.added if getattr(self, k) == getattr(type(self), k)}
        settings = {k: v for k, v in record(self).items() if k not in usual}
        return settings | ({"kind": self.former_kind} if self.former_kind else {})

    def __reduce__(self) -> Any:
        return _restored, (self._packed,)

    @functools.cached_property
    def _packed(self) -> bytes:
        return pickle.dumps((type(self), vars(self)))


@functools.lru_cache(1024)  # a worker is told the same parts with many cells
def _restored(packed: bytes) -> Any:
    kind, attributes = pickle.loads(packed)
    part = object.__new__(kind)
    vars(part).update(attributes)
    return part


@dataclass(frozen=True, kw_only=True)
class Nothing(Part):
    """The option that does nothing."""

    idle = True


def part_class(key: str, target: str) -> type[Part]:
    """The class that an option names; key: whose `_target_` it is.

    Only classes of this program, of a --conf folder and of an installed plugin package are imported. Raises
    ModuleError, or UsageError where there is none of that name.
    """
    target_class = imported(key, target)
    said = f"{key}.{TARGET}={target}"
    if not (isinstance(target_class, type) and issubclass(target_class, Part)):
        raise UsageError(f"{said}: is no part: it must be a class derived from quadexp.parts.part.Part")
    if target_class.prefix not in ("", f"{key}."):
        raise UsageError(f"{said}: is a part of {target_class.prefix.rstrip('.')}, not of {key}")
    return target_class


def imported(key: str, target: str) -> Any:
    """What a dotted name stands for; see part_class."""
    said = f"{key}.{TARGET}={target}"
    module_name, _, attribute = str(target).rpartition(".")
    if not module_name:
        raise UsageError(f"{said}: expected MODULE.NAME, such as my_package.helix.Helix")
    ours = module_name.partition(".")[0] == OWN
    if not ours and (outside := lies_outside(module_name)):
        raise ModuleError(f"{said}: {outside}")
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        raise ModuleError(f"{said}: {error}") from None
    except Exception as error:
        raise UsageError(f"{said}: importing {module_name} raised {type(error).__name__}: {error}") from error
    named = getattr(module, attribute, None)
    if named is None:
        hint = suggestion(attribute, [name for name in vars(module) if not name.startswith("_")])
        raise UsageError(f"{said}: module {module_name} has no class or function {attribute!r}{hint}")
    home = getattr(named, "__module__", None) or "builtins"
    if (inspect.isclass(named) or inspect.isroutine(named)) and not ours and lies_outside(home):
        raise UsageError(
            f"{said}: comes from module {home}, which is neither in the --conf folder nor in an installed plugin"
            " package: call it from a function in your module"
        )
    return named


@dataclass(frozen=True, kw_only=True)
class Given:
    """What a part that is built is handed, as far as it is made before.

    vehicle: that the part is for: the flown one for a plant, the believed one for a controller. believed: that which
    controllers believe in. plant: that is flown. sheet: what is stated of its sensors, see sensor_sheet.py.
    remedies: parts around a controller, the nearest first.
    residual(kind): the model of the air of that kind, or the sum of several kinds. residuals(kinds): each by itself, of
    kinds with checkpoints. checkpoint(i): the i-th fitted model. plant_model(path, kind): a checkpoint that is taken as
    the truth.
    """

    vehicle: Any
    believed: Any = None
    plant: Any = None
    sheet: SensorSheet = SensorSheet()
    remedies: tuple[Any, ...] = ()
    residual: Any = None
    residuals: Any = None
    checkpoint: Any = None
    plant_model: Any = None


@functools.cache
def plugin_folders() -> dict[str, Path]:
    """Configuration folders of installed packages, by the name of their entry point, in the order of the names.

    Raises UsageError where an entry point names no package with a folder.
    """
    folders = {}
    for point in sorted(_entry_points(), key=lambda point: point.name):
        try:
            spec = importlib.util.find_spec(point.value)
        except ImportError:
            spec = None
        places = list(spec.submodule_search_locations or ()) if spec else []
        if not places:
            said = f"entry point {point.name!r} of {ENTRY_POINTS}"
            raise UsageError(f"{said}: no package {point.value!r} that holds a folder")
        folders[point.name] = Path(places[0])
    return folders


_own: list[Path] = []  # folders given with --conf


def own_folders() -> tuple[str, ...]:
    """The folders given with --conf in this process, for the worker processes that it starts."""
    return tuple(map(str, _own))


def import_from(folder: Path) -> None:
    """Let modules in a folder be imported, and named under `_target_`, in this process."""
    if folder not in _own:
        _own.append(folder)
    if str(folder) not in sys.path:
        sys.path.append(str(folder))


def lies_outside(module: str) -> str:
    """Why a module is none of a --conf folder or of an installed plugin package; "" where it is one. It is not
    imported."""
    for point in _entry_points():
        package = point.value.rpartition(".")[0] or point.value
        if f"{module}.".startswith(f"{package}."):
            return ""
    first = module.partition(".")[0]
    theirs = [place for folder in _own for place in _places(PathFinder.find_spec(first, [str(folder)]))]
    if theirs:
        taken = _places(importlib.util.find_spec(first))
        if not taken or any(_same(a, b) for a in theirs for b in taken):
            return ""
        return f"the name {first} is taken by {taken[0]}: give the module in the --conf folder another one"
    where = f"the --conf folder {_own[-1]}" if _own else "a --conf folder (none is given)"
    return f"there is no module {first} in {where}, nor in an installed package with an entry point of {ENTRY_POINTS}"


def _entry_points() -> EntryPoints:
    from importlib.metadata import entry_points  # which takes as long as all the rest of `quadexp --help`

    return entry_points(group=ENTRY_POINTS)


def _places(spec: ModuleSpec | None) -> list[str]:
    if spec is None:
        return []
    return [spec.origin] if spec.origin else list(spec.submodule_search_locations or ())


def _same(a: str, b: str) -> bool:
    return os.path.exists(a) and os.path.exists(b) and os.path.samefile(a, b)
