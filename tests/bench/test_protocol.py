"""A version of the protocol never changes: neither its words, nor what they mean."""

from __future__ import annotations

import pytest

from quadexp.bench.entries import configs_of, read_entries
from quadexp.bench.protocol import Protocol, read_protocol, with_fewer_seeds
from quadexp.errors import DataError
from quadexp.parts.compose import session
from quadexp.tune.preset import provenance_of
from quadexp.tune.search import FIRST_SEED
from tests.docs.commands import ROOT

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
