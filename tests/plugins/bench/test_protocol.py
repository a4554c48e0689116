"""A version of the protocol never changes: neither its words, nor what they mean."""

import pytest

from quadexp.errors import DataError
from quadexp.parts.compose import session
from quadexp.plugins.bench.protocol import Protocol, read_protocol, with_fewer_seeds
from quadexp.plugins.tune.search import FIRST_SEED

FROZEN = "53725eda9d11477137b7ad7368ee3dd423d0e3e40890728579f79db40e64180d"  # a change of the protocol is a new version


def test_it_is_frozen_and_its_words_mean_what_they_meant():
    protocol = read_protocol()
    assert protocol.sha256 == FROZEN
    with session() as composer:
        protocol.check("quick", composer)


def test_a_changed_option_is_noticed(monkeypatch):
    """Here as an override: the circle has another radius."""
    with session() as composer:
        expand = composer.expand

        def changed(given, **options):
            return expand([*given, *(["trajectory.radius=6"] * ("trajectory=circle" in given))], **options)

        monkeypatch.setattr(composer, "expand", changed)
        with pytest.raises(DataError, match="the words of torrente do not mean what they did"):
            read_protocol().check("quick", composer)


def test_draws_lie_between_their_ends_and_are_the_same_every_time():
    worlds = read_protocol().families["draws"].worlds
    assert worlds == read_protocol().families["draws"].worlds and len(worlds) == 17
    masses = [float(worlds[f"payload_{i}"][1].partition("=")[2]) for i in range(1, 5)]
    assert len({*masses}) == 4 and all(0.2 <= mass <= 0.4 for mass in masses)


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


def test_seeds_are_not_those_that_tune():
    assert max(seed for *_, seed in cells(read_protocol(), "full")) < FIRST_SEED
