"""A version of the protocol never changes: neither its words, nor what they mean."""

from __future__ import annotations

import pytest

from quadexp.bench.entries import configs_of, read_entries
from quadexp.bench.protocol import LATEST, Protocol, _difference, check_lock, read_protocol, with_fewer_seeds
from quadexp.errors import DataError, UsageError
from quadexp.parts.compose import session
from quadexp.tune.preset import provenance_of
from quadexp.tune.search import FIRST_SEED
from tests.docs.commands import ROOT

# Never edit a line: a change of the protocol is a new version beside the old one.
FROZEN = {
    1: "2c16fac43eb2b7c31bb753894af81ed2c71e5da4154830edca91fe82c52d8359",
    2: "b7bee243bba37804451a5120ed7fc7849ad7b3ac7e0eedf9d60532a01a9eff05",
}


@pytest.mark.parametrize("version", FROZEN)
def test_versions_are_frozen(version):
    assert read_protocol(version).sha256 == FROZEN[version]


def test_every_version_is_held():
    assert [*FROZEN] == list(range(1, LATEST + 1))
    with pytest.raises(UsageError, match="no such version; there are 1 to"):
        read_protocol(LATEST + 1)


@pytest.mark.parametrize("version", FROZEN)
def test_what_the_words_mean_is_what_it_was(version):
    with session() as composer:
        check_lock(read_protocol(version), composer)


def test_a_changed_file_of_the_configuration_is_noticed(monkeypatch):
    """Here as an override: the circle of one family has another radius."""
    with session() as composer:
        expand = composer.expand

        def changed(given, **options):
            return expand([*given, *(["trajectory.radius=6"] * ("trajectory=circle" in given))], **options)

        monkeypatch.setattr(composer, "expand", changed)
        message = r"blade_element.tasks.circle 8.trajectory.radius is 6.0, was 5.0: a configuration file has changed"
        with pytest.raises(DataError, match=message):
            check_lock(read_protocol(), composer)


def test_a_key_that_came_later_is_no_change():
    assert _difference({"a": {"b": 1}}, {"a": {"b": 1, "new": 0}, "c": 2}) == ""
    assert _difference({"a": {"b": 1}}, {"a": {"b": 2}}) == "a.b is 2, was 1"
    assert _difference({"a": {"b": 1}}, {"a": {}}) == "a.b is gone"


def cells(protocol: Protocol, size: str) -> set[tuple[str, str, str, int]]:
    found = set()
    for family in protocol.families.values():
        seeds, tasks, worlds = family.chosen(size)
        assert set(tasks) <= family.tasks.keys() and set(worlds) <= family.worlds.keys()
        found |= {(family.name, t, w, s) for t in tasks for w in worlds for s in protocol.seeds(seeds)}
    return found


def test_a_larger_size_flies_what_a_smaller_one_does():
    quick, standard, full = (cells(read_protocol(), size) for size in ("quick", "standard", "full"))
    assert quick < standard < full


def test_fewer_seeds_are_the_first_of_the_same_flights():
    protocol = read_protocol()
    fewer, called = with_fewer_seeds(protocol, "standard", 5)
    assert called == "standard, 5 seeds" and fewer.sha256 == protocol.sha256
    some = cells(fewer, "standard")
    assert some < cells(protocol, "standard") and cells(fewer, "full") == cells(protocol, "full")
    seeds = {name: {seed for family, *_, seed in some if family == name} for name in protocol.families}
    assert seeds == {"torrente": {*range(5)}, "blade_element": {*range(5)}, "draws": {*range(4)}}
    assert with_fewer_seeds(protocol, "standard", 0) == (protocol, "standard")
    assert with_fewer_seeds(protocol, "standard", 6) == (protocol, "standard")


def test_every_seed_has_a_random_path_of_its_own():
    protocol = read_protocol()
    with session() as composer:
        (entry,) = read_entries(["nominal_mpc"], composer, protocol)
        flights = configs_of(entry, protocol.families["torrente"], protocol, "standard", composer, None)
    assert {(config.trajectory.seed, config.seed) for task, *_, config in flights if task == "random 10"} == {
        (seed, seed) for seed in range(6)
    }


def test_quick_flies_no_task_that_settings_were_tuned_on():
    tuned = {
        text
        for path in sorted((ROOT / "conf").glob("*/*_tuned.yaml"))
        for text in (provenance_of(path.stem, group=path.parent.name) or {})["cells"]
    }
    speeds = {text for text in tuned if text.startswith("trajectory.speed=")}
    shapes = {shape for text in tuned if text.startswith("trajectory=") for shape in text.split("=")[1].split(",")}
    family = read_protocol().families["torrente"]
    for task in family.chosen("quick")[1]:
        shape, speed = family.tasks[task][:2]
        assert shape.partition("=")[2] not in shapes or speed not in speeds


def test_seeds_are_not_those_that_tune():
    assert max(seed for *_, seed in cells(read_protocol(), "full")) < FIRST_SEED
