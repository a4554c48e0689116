"""Configuration of other people is data: it is read at once, is of bounded size, and refers to keys alone."""

import os
import re
import socket
from itertools import pairwise

import pytest

from quadexp.errors import UsageError
from quadexp.parts.compose import compose
from quadexp.parts.yaml_files import MOST_VALUES, read_data

BASE = "defaults: [circle, _self_]\nname: mine\n"
LEVELS = "\n".join(f"{name}: &{name} [{', '.join([f'*{below}'] * 9)}]" for below, name in pairwise("abcdefgh"))
SECRETS = ("oc.env:SECRET", "oc.select:seed", "hydra:run.dir", ".speed", "a[0]")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A --conf folder, an environment with a secret, and nothing kept of earlier compositions."""
    monkeypatch.setenv("SECRET", "hunter2")
    monkeypatch.setenv("QUADEXP_CACHE", str(tmp_path / "cache"))
    (tmp_path / "mine" / "trajectory").mkdir(parents=True)
    return tmp_path / "mine"


def refused(overrides, folder):
    with pytest.raises(UsageError) as error:
        compose(overrides, folder)
    said = str(error.value)
    assert "\n" not in said and "hunter2" not in said
    return said


@pytest.mark.parametrize("resolver", SECRETS)
def test_no_resolver_is_asked(folder, resolver):
    file = folder / "trajectory" / "mine.yaml"
    file.write_text(f"{BASE}start: ${{{resolver}}}\n")
    assert str(file) in refused(["trajectory=mine"], folder)
    assert "trajectory.name: refers to what cannot be read" in refused([f"trajectory.name='${{{resolver}}}'"], folder)
    file.write_text(f"defaults: ['circle', {{/vehicle: '${{{resolver}}}'}}, _self_]\n")
    assert str(file) in refused(["trajectory=mine"], folder)
    file.write_text(BASE.replace("circle, ", "circle, base, "))
    (folder / "trajectory" / "base.yaml").write_text(f"speed: ${{{resolver}}}\n")
    assert "base.yaml" in refused(["trajectory=mine"], folder), "a file that another one extends"


def test_references_to_keys_are_read(folder):
    (folder / "trajectory" / "mine.yaml").write_text(f"{BASE}speed: ${{trajectory.radius}}\nradius: 6\n")
    config = compose(["trajectory=mine", "seed=4", "trajectory.name=a${seed}b${trajectory.speed}"], folder)
    assert config.trajectory.speed == 6.0 and config.trajectory.name == "a4b6"


@pytest.mark.parametrize(
    "text",
    {
        "in a circle": "name: ${trajectory.speed}\nspeed: ${trajectory.radius}\nradius: ${trajectory.name}\n",
        "to itself": "name: ${trajectory.name}\n",
    }.values(),
)
def test_references_end(folder, text):
    (folder / "trajectory" / "mine.yaml").write_text(BASE.replace("name: mine\n", text))
    refused(["trajectory=mine"], folder)
    chain = [f"model={'x' * 900}", "evaluate.baseline=${model}${model}", "vehicle.name=${evaluate.baseline}"]
    assert "too long to be referred to" in refused(chain, folder)


@pytest.mark.parametrize(
    "text",
    {
        "bomb": f"a: &a [x, x]\n{LEVELS}\n",
        "deep": "a: " + 100_000 * "[",
        "within itself": "a: &a [*a]\n",
        "many": "a: [" + MOST_VALUES * "1, " + "1]\n",
        "large": "a: '" + 1_100_000 * "x" + "'\n",
        "list": "[1, 2]\n",
        "defaults": "defaults: 5\n",
        "binary": "\x00\x01",
    }.items(),
    ids=lambda pair: pair[0],
)
def test_a_file_that_is_more_than_data_is_named(folder, text):
    file = folder / "trajectory" / "mine.yaml"
    file.write_text(text[1])
    assert str(file) in refused(["trajectory=mine"], folder)


def test_aliases_of_a_usual_size_are_read(tmp_path):
    (tmp_path / "a.yaml").write_text("a: &a {x: 1}\nb: {<<: *a, y: 2}\nc: [*a, *a]\n")
    assert read_data(tmp_path / "a.yaml") == {"a": {"x": 1}, "b": {"x": 1, "y": 2}, "c": [{"x": 1}, {"x": 1}]}


def test_what_is_no_file_is_not_waited_for(folder, tmp_path, monkeypatch):
    """A pipe, a device and a socket beside the options, which nobody chose, and as an option."""
    places = [folder / name / "odd.yaml" for name in ("vehicle", "trajectory", "wind")]
    for place in places:
        place.parent.mkdir(exist_ok=True)
    os.mkfifo(places[0])
    places[1].symlink_to("/dev/zero")
    monkeypatch.chdir(places[2].parent)
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(places[2].name)
        assert compose(["trajectory=circle"], folder).trajectory.name == "circle"
        for group in ("vehicle", "trajectory", "wind"):
            assert f"no such {group}" in refused([f"{group}=odd"], folder)
    with pytest.raises(OSError):
        read_data(places[0])


@pytest.mark.parametrize(
    ("file", "text", "place"),
    [
        ("trajectory/mine.yaml", f"{BASE}radius: 4\nspeed: 3\nradius: 6\n", "line 5, column 1: .* radius is there"),
        ("options/a.yaml", "trajectory:\n  mine: {of: circle, speed: 3, speed: 4}\n", "line 2, .* speed is there"),
        ("options/a.yaml", "trajectory:\n  mine: {of: circle}\n  mine: {of: hover}\n", "mine is there"),
        ("options/a.yaml", "trajectory: {mine: {of: circle}}\nvehicle: {}\ntrajectory: {}\n", "trajectory is there"),
    ],
)  # fmt: skip
def test_a_key_that_is_there_twice_is_refused(folder, file, text, place):
    """The first value would be dropped without a word."""
    (folder / "options").mkdir()
    (folder / file).write_text(text)
    said = refused(["trajectory=mine"], folder)
    assert str(folder / file) in said
    assert re.search(place, said)


def test_a_key_of_a_merged_mapping_may_be_given_anew(folder):
    (folder / "trajectory" / "mine.yaml").write_text("a: &a {speed: 3, radius: 4}\nb: {<<: *a, speed: 5}\n")
    assert read_data(folder / "trajectory" / "mine.yaml")["b"] == {"speed": 5, "radius": 4}
