"""A version of the protocol never changes: neither its words, nor what they mean."""

from __future__ import annotations

import pytest

from quadexp.bench.protocol import LATEST, Protocol, _difference, check_lock, read_protocol
from quadexp.config.compose import session
from quadexp.errors import DataError, UsageError
from quadexp.tune.search import FIRST_SEED

# Never edit a line: a change of the protocol is a new version beside the old one.
FROZEN = {1: "2c16fac43eb2b7c31bb753894af81ed2c71e5da4154830edca91fe82c52d8359"}


@pytest.mark.parametrize("version", FROZEN)
def test_versions_are_frozen(version):
    assert read_protocol(version).sha256 == FROZEN[version]


def test_every_version_is_held():
    assert [*FROZEN] == list(range(1, LATEST + 1))
    with pytest.raises(UsageError, match="no such version; there are 1 to"):
        read_protocol(LATEST + 1)


def test_what_the_words_mean_is_what_it_was():
    with session() as composer:
        check_lock(read_protocol(), composer)


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


def test_seeds_are_not_those_that_tune():
    assert max(seed for *_, seed in cells(read_protocol(), "full")) < FIRST_SEED
