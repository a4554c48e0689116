"""What Hydra does for this program, by its public functions alone: it composes files, and reads every override.

Importing it takes a tenth of a second and composing a choice of options as much again. So it is imported only where a
choice has not been composed before (kept.py) or an override is not plain (override.py).
"""

from __future__ import annotations

import builtins
import contextlib
import functools
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from quadexp.errors import UsageError
from quadexp.messages import one_line
from quadexp.parts.former_options import former_nodes
from quadexp.parts.option_files import LOOK, OptionFiles
from quadexp.parts.override import quoted
from quadexp.parts.schema import BUNDLES, PRESETS, conf_folder
from quadexp.parts.sheets import Entry

_one_thread = threading.RLock()  # Hydra composes for one at a time
_VERSION = {"version_base": "1.3"} if hydra.__version__.startswith("1.3.") else {}  # later versions take none


def composed_files(name: str, chosen: Sequence[str], files: OptionFiles) -> dict[str, Any]:
    """What a file and a choice of options (GROUP=OPTION each) make together."""
    own = ",".join(
        quoted(place) for place in (f"{SheetSource.scheme()}://", *(f"file://{folder}" for folder in files.folders[1:]))
    )
    with _one_thread, _one_line():
        register_schemas()
        SheetSource.entries = files.entries
        GlobalHydra.instance().clear()
        with hydra.initialize_config_dir(str(conf_folder()), **_VERSION):
            overrides = [*chosen, f"hydra.searchpath=[{own}]"]
            composed = hydra.compose(name, overrides=overrides, return_hydra_config=True)
            options = dict(composed.hydra.runtime.choices)
            content = OmegaConf.to_container(composed)
    assert isinstance(content, dict)
    content.pop("hydra")
    for key, value in content.items():
        option = options.get(str(key)) or name.partition(str(key) + "/")[2]
        if isinstance(value, dict):
            value.pop(LOOK, None)
        if isinstance(value, dict) and option:  # a part is named after its option, unless its file says otherwise
            value.setdefault("name", option)
    return {str(key): value for key, value in content.items()}


class SheetSource(ConfigSource):
    """The options of sheets, as Hydra looks for them after those of conf/."""

    entries: ClassVar[Mapping[str, Entry]] = {}

    @staticmethod
    def scheme() -> str:
        """How its address begins."""
        return "sheets"

    def available(self) -> bool:
        """Whether there is such a place."""
        return True

    def is_group(self, config_path: str) -> bool:
        """Whether sheets have options of a group."""
        return any(name.startswith(f"{config_path}/") for name in self.entries)

    def is_config(self, config_path: str) -> bool:
        """Whether a sheet has an option."""
        return config_path.removesuffix(".yaml") in self.entries

    def list(self, config_path: str, results_filter: ObjectType | None) -> builtins.list[str]:
        """Options of a group."""
        return [name.partition("/")[2] for name in self.entries if name.startswith(f"{config_path}/")]

    def load_config(self, config_path: str) -> ConfigResult:
        """An option as if it were a file."""
        name = config_path.removesuffix(".yaml")
        group = name.partition("/")[0]
        header = {"package": "_global_" if group in BUNDLES else PRESETS.get(group)}
        return ConfigResult(self.provider, self.full_path(), OmegaConf.create(self.entries[name].content), header)


Plugins.instance().register(SheetSource)


class _Groups:
    """What the parser asks of a loader of configurations: the options of a group, for glob(...)."""

    def __init__(self, options: Callable[[str], list[str]]) -> None:
        self._options = options

    def get_group_options(self, group_name: str, *_: Any, **__: Any) -> list[str]:
        return self._options(group_name)


def read_override(text: str, options: Callable[[str], list[str]]) -> Override | None:
    """An override by Hydra's grammar; None where it cannot be read. options: names of a group's options."""
    loader: Any = _Groups(options)
    try:
        return OverridesParser.create(config_loader=loader).parse_overrides([text])[0]
    except HydraException:
        return None


@contextlib.contextmanager
def _one_line() -> Iterator[None]:
    try:
        yield
    except (HydraException, OmegaConfBaseException) as error:
        raise UsageError(one_line(error)) from error


@functools.cache
def register_schemas() -> None:
    """Make the former names of parts known to Hydra."""
    for (group, name), node in former_nodes().items():
        ConfigStore.instance().store(group=f"schema/{group}", name=name, node=node)
