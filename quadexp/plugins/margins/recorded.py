"""Recorded settings of a flight as the overrides that give them again.

A record names no option: the name of a part may be any. An option of that name is taken where its class has the keys
that are recorded, and otherwise any one whose class has them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from quadexp.errors import UsageError
from quadexp.parts.compose import Composer
from quadexp.parts.former import now
from quadexp.parts.override import in_grammar
from quadexp.parts.part import Part
from quadexp.parts.schema import BUNDLES, PARTS, PRESETS
from quadexp.parts.settings import declared, flat, plain
from quadexp.parts.timing import PARTS as TIMED
from quadexp.parts.timing import TIMES
from quadexp.parts.user_modules import OWN


def recorded_words(
    composer: Composer, record: Mapping[str, Any], chosen: Sequence[str] = (), classes: Mapping[str, str] = {}
) -> list[str]:
    """The overrides that give a recorded configuration again, options first, and then `chosen`, which change it.

    A group whose option they choose is not taken from the record, nor what a bundle or a preset that they choose
    decides. classes: recorded names of the classes of parts, by group.
    """
    options = dict(text.split("=", 1) for text in chosen)
    for bundle in BUNDLES:
        if options.get(bundle) not in composer.options(bundle):
            continue
        values, others = composer.option(bundle, options[bundle])
        options |= dict.fromkeys([*BUNDLES[bundle], *flat(values)], "") | others
    for preset in PRESETS.keys() & options.keys():
        for name in composer.options(preset):
            options |= dict.fromkeys(flat({PRESETS[preset]: composer.option(preset, name).values}), "")
    for name in TIMES:
        if f"timing.{name}" in options:  # it counts for what was recorded of each part
            options |= dict.fromkeys(timed_keys(name), "")
    words: list[str] = []
    for key, value in now(dict(record)).items():
        if key in options or value is None:
            continue
        if key in PARTS:
            option, part = _option(composer, key, value, classes.get(key, ""))
            words.append(f"{key}={option}")
            stated = {**plain(part), **composer.option(key, option).values}
            keys = {name for name in value.keys() & declared(part).keys() if value[name] != stated.get(name)}
            value = {name: value[name] for name in declared(part) if name in keys and f"{key}.{name}" not in options}
            value.pop("name", None)
        words += _texts(value, key)
    return [*sorted(words, key=lambda text: "." in text.partition("=")[0]), *chosen]


def _option(composer: Composer, group: str, record: Mapping[str, Any], recorded: str) -> tuple[str, type[Part]]:
    """The option that a recorded part is of, and its class: that with most of the recorded keys, and no others.

    recorded: name of the class, "" where it is not known."""
    classes: dict[str, type[Part]] = {}
    for option, part in composer.parts(group).items():  # not those whose package is not installed
        if part.former_kind != record.get("kind", ""):
            continue
        if recorded and not _is_class(part, recorded):
            continue
        if all(key in record or key in part.added for key in declared(part)):
            classes[option] = part
    most = max((len(declared(part)) for part in classes.values()), default=0)
    classes = {option: part for option, part in classes.items() if len(declared(part)) == most}
    name = str(record.get("name"))
    if name not in classes and len({*classes.values()}) != 1:
        raise UsageError(
            f"{group}={name}: no such option, and {len({*classes.values()})} kinds of {group} have its keys: give"
            f" {group}=OPTION, or the --conf that it was flown with"
        )
    option = name if name in classes else next(iter(classes))
    return option, classes[option]


def _is_class(part: type[Part], recorded: str) -> bool:
    """Whether a part is of a recorded class; a class of this program may have changed its module since."""
    if recorded.partition(".")[0] == OWN == part.__module__.partition(".")[0]:
        return recorded.rpartition(".")[2] == part.__qualname__
    return recorded == f"{part.__module__}.{part.__qualname__}"


def _texts(value: Any, key: str) -> Iterator[str]:
    if isinstance(value, Mapping):
        for name, inner in value.items():
            yield from _texts(inner, f"{key}.{name}")
    else:
        yield f"{key}={in_grammar(key, value)}"


def timed_keys(name: str) -> list[str]:
    """The keys of parts that a key of `timing` may set."""
    keys = {"age": ("time",), "motor_lag": ("motor_lag", "motor_lead")}.get(name, (name,))
    return [f"{group}.{own}" for group in TIMED for own in keys]
