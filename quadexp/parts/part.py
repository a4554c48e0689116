"""A part: one class in one file, that an option of a group names by `_target_`.

    # conf/wind/gust.yaml
    _target_: quadexp.world.gust.Gust

    class Gust(Effect):
        onset: Annotated[float, Setting("when the gust begins", "[0, 14400]", "s")] = 2.0

The class's fields are the option's keys, with unit, range, meaning and default: one line a key (settings.py). What a
part is made into is said by the group's own base class (Effect, TrajectoryPart, PlantPart, ControllerPart, Remedy).
Nothing else lists parts; `part_class` finds those of this program and of a user alike.

`_target_` names a class of this program, or one that lies in a --conf folder or a plugin package (user_modules.py), and
nothing else, so that a configuration file alone cannot name code that nobody meant to run; a --conf folder with modules
in it is code.
"""

from __future__ import annotations

import functools
import inspect
import pickle
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, ClassVar, Self

from quadexp.errors import ModuleError, UsageError
from quadexp.messages import suggestion
from quadexp.names import without
from quadexp.parts.former import names_of
from quadexp.parts.own_class import check_own_class
from quadexp.parts.settings import Name, Settings, keyed, record
from quadexp.parts.user_modules import OWN, fault, generation, import_from, lies_outside, load, own_folders

TARGET = "_target_"  # key of an option that names the class of its part


@keyed
class Part(Settings):
    """Base of what an option stands for. name: what tables and figures call it; that of the option unless it says so.

    former_kind: what stands for the class in hashes, so that stored flights and cells keep theirs; "" for nothing.
    former_keys: keys that it had, and the values that flights of today stand for: hashes and noise of a plant stay.
    added: keys that it did not always have, recorded where they are not as usual.
    age_key: that of the age of the measured state, which `timing.age` gives, where it has one.
    makes: the command that makes what its key `model` names, where that is no model of the air.
    hooks: methods of which a class that is derived from this one needs one at least, as it does nothing without.
    """

    former_kind: ClassVar[str] = ""
    former_keys: ClassVar[Mapping[str, Any]] = {}
    added: ClassVar[tuple[str, ...]] = ()
    age_key: ClassVar[str] = "age"
    makes: ClassVar[str] = ""
    hooks: ClassVar[tuple[str, ...]] = ()

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

    @property
    def class_path(self) -> str:
        """What its option names: MODULE.CLASS."""
        return f"{type(self).__module__}.{type(self).__qualname__}"

    def recorded(self) -> dict[str, Any]:
        """Its settings as plain data, for files and hashes."""
        return dict(self._recorded)

    @functools.cached_property
    def _recorded(self) -> dict[str, Any]:
        usual = {k for k in self.added if getattr(self, k) == getattr(type(self), k)}
        settings = without(record(self), usual)
        return settings | ({"kind": self.former_kind} if self.former_kind else {})

    def anew(self) -> Self:
        """The same without what it has computed, and kept, of its settings and of files that they name."""
        part = object.__new__(type(self))
        vars(part).update(self._attributes)
        return part

    @property
    def _attributes(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @property
    def folders(self) -> tuple[str, ...]:
        """Folders of a user's own that another process needs with it."""
        return () if self.shipped else own_folders()

    def __reduce__(self) -> Any:
        return _restored, (self._packed, self.folders)

    @functools.cached_property
    def _packed(self) -> bytes:
        return pickle.dumps((type(self).__module__, type(self).__qualname__, self._attributes))


def _restored(packed: bytes, folders: tuple[str, ...]) -> Any:
    """The part, of the class as it is where this is called. folders: that its modules may lie in.

    Raises ModuleError where its module is none of these, which is not imported then."""
    if folders:
        import_from(*folders)
        module = pickle.loads(packed)[0]
        ours = module.partition(".")[0] in (OWN, "__main__")
        if not ours and (outside := lies_outside(module)):
            raise ModuleError(outside)
        load(module)
    return _part_of(packed, generation())


@functools.lru_cache(1024)  # a worker is given the same parts with many cells
def _part_of(packed: bytes, generation: int) -> Any:
    module, name, attributes = pickle.loads(packed)
    kind: Any = functools.reduce(getattr, name.split("."), load(module))
    part: Any = object.__new__(kind)
    vars(part).update(attributes)
    return part


@keyed
class Nothing(Part):
    """The option that does nothing."""

    idle = True


def part_class(key: str, target: str) -> type[Part]:
    """The class that an option names; key: whose `_target_` it is.

    Only classes of this program, of a --conf folder and of an installed plugin package are imported. Raises
    ModuleError, or UsageError where there is none of that name.
    """
    said = f"{key}.{TARGET}={target}"
    target_class = imported(said, target)
    if not (isinstance(target_class, type) and issubclass(target_class, Part)):
        raise UsageError(f"{said}: is no part: it must be a class derived from quadexp.parts.part.Part")
    if target_class.prefix not in ("", f"{key}."):
        raise UsageError(f"{said}: is a part of {target_class.prefix.rstrip('.')}, not of {key}")
    if target_class.__module__.partition(".")[0] != OWN:
        check_own_class(target_class, OWN)  # type: ignore[arg-type]  # of a class, not of its objects
    return target_class


def imported(said: str, target: str) -> Any:
    """What a dotted name stands for; see part_class. said: where it stands, for messages."""
    module_name, _, attribute = str(target).rpartition(".")
    if not module_name:
        raise UsageError(f"{said}: expected MODULE.NAME, such as my_package.helix.Helix")
    ours = module_name.partition(".")[0] == OWN
    if not ours and (outside := lies_outside(module_name)):
        raise ModuleError(f"{said}: {outside}")
    try:
        module = load(module_name)
    except (ImportError, UsageError) as error:
        raise ModuleError(f"{said}: {fault(error)}") from None
    except (Exception, SystemExit) as error:
        raise UsageError(f"{said}: importing {module_name}: {fault(error)}") from error
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


__getattr__ = names_of(__name__)
