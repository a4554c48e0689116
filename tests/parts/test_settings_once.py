"""Each setting is declared once, completely, and its value is stated once."""

from __future__ import annotations

import dataclasses
from typing import Any, get_origin

import pytest

from quadexp.control.mpc.settings import MPCSettings
from quadexp.errors import UsageError
from quadexp.parts.compose import compose
from quadexp.parts.options import OptionFiles
from quadexp.parts.part import TARGET, part_class
from quadexp.parts.schema import PARTS, Config
from quadexp.parts.settings import REQUIRED, Setting, declared, inside, lists, plain

# What a part that is the object itself is given besides its keys.
OF_THE_OBJECT = {"yaw", "vehicle", "printed_coefficients", "inertial", "later", "later_rates", "follows"}


def nodes() -> dict[str, type]:
    """Every node of the configuration, those inside others too, by its schema or key."""
    waiting = {f"{group}/{one.__name__}": one for group in PARTS for one in OptionFiles().parts(group).values()}
    waiting[""] = Config
    found = {}
    while waiting:
        name, node = waiting.popitem()
        found[name] = node
        waiting |= {f"{name}.{key}": one.node for key, one in declared(node).items() if one.node}
    return found


NODES = nodes()


@pytest.mark.parametrize("name", NODES)
def test_every_key_has_a_type_a_meaning_and_a_number_its_range(name):
    node = NODES[name]
    aside = {"sweep", "world", *PARTS} if name == "" else OF_THE_OBJECT
    assert {f.name for f in dataclasses.fields(node)} - aside == declared(node).keys() - aside
    for key, one in declared(node).items():
        assert isinstance(one.setting, Setting) and one.setting.meaning, key
        kind = one.type if get_origin(one.type) is not tuple else one.type.__args__[0]
        if kind in (int, float):
            assert one.setting.interval, f"{node.prefix}{key}: a number needs a range"
        if one.setting.interval and not one.required and one.default is not None:
            for value in one.default if isinstance(one.default, tuple) else [one.default]:
                assert inside(value, one.setting.interval), f"{node.prefix}{key}: the default lies outside its range"


def stated(content: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Leaves of a configuration file by their dotted key."""
    found = {}
    for key, value in content.items():
        found |= stated(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


def holds_anyway(group: str, option: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """What an option would be without what its own file states, and that."""
    files = OptionFiles()
    content = dict(files.read(group, option)[1])
    target, values = content.pop(TARGET, None), {}
    for default in content.pop("defaults", []):
        if default != "_self_":
            inherited, own = holds_anyway(group, default)
            values |= inherited | own
    if target is not None:
        values = stated(plain(part_class(group, target))) | values
    return values, stated(content)


# Vehicles are measured: their files are complete.
OPTIONS = [(group, option) for group in PARTS if group != "vehicle" for option in OptionFiles().options(group)]


@pytest.mark.parametrize(("group", "option"), OPTIONS, ids=lambda text: text)
def test_a_file_states_only_what_differs(group, option):
    anyway, own = holds_anyway(group, option)
    again = {key: value for key, value in own.items() if lists(anyway.get(key, REQUIRED)) == value}
    assert own.pop("name", "") != option or "name" in anyway or option.startswith("sun_"), (
        "a part is named after its option"
    )
    assert not again, f"conf/{group}/{option}.yaml states again what holds anyway"
    assert own.keys() <= anyway.keys()


@pytest.mark.parametrize(
    ("key", "value"),
    [("nodes", 1), ("nodes", 2.5), ("rate", "fast"), ("rate_weight", [1, 2]), ("horizon", float("nan"))],
)
def test_python_and_the_command_line_refuse_alike(key, value):
    """One rule, one line: from MPCSettings(...) as from controller....=..."""
    with pytest.raises(UsageError) as python:
        MPCSettings(**{key: value})
    with pytest.raises(UsageError) as line:
        compose([f"controller.{key}={str(value).replace(' ', '')}"])
    assert str(python.value) == str(line.value)
