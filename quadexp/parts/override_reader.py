"""The overrides of a command line, read and checked: is it a key of this program, is there such an option."""

from __future__ import annotations

import re
from collections.abc import Sequence

from quadexp.errors import UsageError
from quadexp.messages import suggestion
from quadexp.parts.former import refuse_former
from quadexp.parts.option_files import OptionFiles
from quadexp.parts.override import Given, plain_override, quoted

# Keys that hold a path.
PATHS = {
    "model", "plant.model", "trajectory.path", "wind.path", "collect.identified", "engine.tls_ca",
    "engine.tls_cert", "engine.tls_key",
}  # fmt: skip
HYDRA = {  # how a key of Hydra itself begins -> what does that here
    "hydra.sweep.": "--out names the folder of a sweep",
    "hydra.run.": "--out names where a flight is written",
    "hydra.job.": "--out names what is written",
    "hydra/launcher": "engine=local, dask or jobs says where a sweep is flown",
    "hydra.launcher": "engine=local, dask or jobs says where a sweep is flown, evaluate.workers on how many processes",
    "hydra/sweeper": "evaluate --sweep flies every combination",
    "hydra.sweeper": "evaluate --sweep flies every combination",
    "hydra.searchpath": "--conf names a folder of configuration",
    "hydra": "Hydra composes the configuration, and nothing else",
}
KEPT = 50_000  # overrides that are remembered at most


class OverrideReader:
    """Reads each text once. files: whose groups and options there are."""

    def __init__(self, files: OptionFiles) -> None:
        self._files = files
        self._read: dict[str, Given] = {}

    def read(self, overrides: Sequence[str], *, sweep: bool = False) -> list[Given]:
        """The overrides; UsageError where one cannot be read, or has several values outside a sweep."""
        return [self._one(text, sweep) for text in overrides]

    def _one(self, text: str, sweep: bool) -> Given:
        known = self._read.get(text)
        if known is not None:
            return known
        key, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"{text!r}: expected KEY=VALUE, such as trajectory.speed=8")
        given = None if key in PATHS and not re.match("[A-Za-z]", value) else plain_override(text)
        given = given or self._by_grammar(text)
        if given.key.split("/")[0].split(".")[0] in ("hydra", "schema", "sweep"):
            hint = next((f"; {said}" for begin, said in HYDRA.items() if given.key.startswith(begin)), "")
            raise UsageError(f"{text!r}: not a key of this program{hint}")
        if given.sweep is not None and not given.sweep:
            raise UsageError(f"{text}: an empty range leaves nothing to fly")
        if given.sweep is not None:
            if not sweep:
                raise UsageError(f"{text!r}: several values for one key; use `quadexp evaluate --sweep` for that")
            if given.key in self._files.groups:
                for one in given.sweep:
                    self._one(f"{given.key}={one}", False)
            return given
        if given.key in self._files.groups:
            self._check_option(given)
        if len(self._read) > KEPT:
            self._read.clear()
        self._read[text] = given
        return given

    def _by_grammar(self, text: str) -> Given:
        """An override by Hydra's grammar."""
        from quadexp.parts.hydra_files import read_override

        key, _, value = text.partition("=")
        literal = f"{key}={','.join(map(quoted, value.split(',')))}"
        override = read_override(text, self._files.options)
        if override is None and key in PATHS:  # most letters that a path may have mean nothing to the grammar
            override = read_override(literal, self._files.options)
        if override is None and (several := [word for word in text.split() if re.match(r"[\w.]+=", word)])[1:]:
            raise UsageError(f"{text!r}: {len(several)} settings within one pair of quotes; give each by itself")
        if override is None:
            raise UsageError(
                f"{text!r}: cannot be read as KEY=VALUE: a bracket or quote is left open,"
                " or the value has signs that need quotes (KEY=\"'VALUE'\")"
            )
        found = override.value()
        values = getattr(found, "list", [found]) if "(" not in value else []
        if key in PATHS and any(isinstance(one, (int, float)) for one in values):  # 2024_01 is not the number 202401
            override = read_override(literal, self._files.options) or override
        if override.is_add() or override.is_force_add() or override.is_delete():
            raise UsageError(f"{text!r}: keys can be set (KEY=VALUE), not added or deleted")
        name = override.key_or_group
        if override.package:
            raise UsageError(f"{text!r}: not a key of this program")
        if not override.is_sweep_override():
            return Given(name, override.value(), f"{name}={override.get_value_element_as_str()}")
        if not override.is_discrete_sweep():
            raise UsageError(f"{text!r}: not a list of values; use commas, range, choice or glob for a sweep")
        return Given(name, None, text, tuple(override.sweep_string_iterator()))

    def _check_option(self, given: Given) -> None:
        options = self._files.options(given.key)
        if given.value is None and given.key == "experiment":
            return
        if given.value not in options:
            refuse_former(f"{given.key}={given.value}")
            hint = suggestion(str(given.value), options)
            raise UsageError(f"{given.key}={given.value}: no such {given.key}{hint}")
