"""Sheets: several options in one file, of the program and of a user, are options like any other."""

import pytest

from quadexp.errors import UsageError
from quadexp.parts.compose import compose, expand
from quadexp.parts.listing import listed
from quadexp.parts.options import OptionFiles
from quadexp.parts.settings import record

LAB = """
controller:
  brisk: {of: pid, meaning: Ours., velocity_integral: [1.0, 1.0, 2.0]}
world:
  heavy: {meaning: 30 % more mass, wind: gust, wind.onset: 3.0, truth.mass: 1.3}
remedies:
  both: {observer: wind, observer.wind_walk: 2.0, controller.rate: 100.0, horizon: precise}
"""


@pytest.fixture
def lab(tmp_path):
    def write(text=LAB, name="lab"):
        (tmp_path / "options").mkdir(exist_ok=True)
        (tmp_path / "options" / f"{name}.yaml").write_text(text)
        return tmp_path

    return write


@pytest.mark.parametrize(
    ("chosen", "typed"),
    [
        ("controller=brisk", ["controller=pid", "controller.velocity_integral=[1,1,2]", "controller.name=brisk"]),
        ("world=heavy", ["wind=gust", "wind.onset=3", "wind.name=heavy", "truth.mass=1.3", "truth.name=heavy"]),
        ("remedies=both", ["observer=wind", "observer.wind_walk=2", "controller.rate=100", "horizon=precise"]),
    ],
)
def test_an_entry_is_what_it_says(lab, chosen, typed):
    """In one configuration and as a cell of a sweep."""
    folder = lab()
    expected = record(compose(typed)) | {"world": ""}
    assert record(compose([chosen], folder)) | {"world": ""} == expected
    cells = expand([chosen, "seed=0,1"], folder)
    assert record(cells[0].config) | {"world": "", "sweep": None} == expected


def test_what_is_chosen_beside_it_counts(lab):
    folder = lab()
    config = compose(["world=heavy", "wind=constant"], folder)
    assert config.world == "heavy,wind=constant" and config.truth.mass == 1.3
    assert compose(["world=heavy"], folder).world == "heavy"


def test_it_is_listed(lab):
    assert {"option": "world=heavy", "meaning": "30 % more mass"} in listed("world", lab())
    assert {"key": "wind", "value": "heavy", "allowed": "", "meaning": ""} in listed("world=heavy", lab())
    assert {"option": "wind=heavy", "meaning": "30 % more mass"} in listed("wind", lab())


def test_an_own_option_comes_first_and_a_file_before_a_sheet(lab):
    folder = lab("controller: {pid_tuned: {of: dfbc}, pid: {of: dfbc}}")
    (folder / "controller").mkdir()
    (folder / "controller" / "pid_tuned.yaml").write_text("defaults: [geometric, _self_]\n")
    for name, base in (("pid", "dfbc"), ("pid_tuned", "geometric")):
        own = compose([f"controller={name}"], folder).controller
        assert {**record(own), "name": base} == record(compose([f"controller={base}"]).controller)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("contoller: {a: {of: pid}}", "contoller: must be a group that holds options; groups are vehicle, plant"),
        ("controller: [pid]", "controller: must be a group that holds options"),
        ("controller: {mine: 3}", "controller: mine: must hold keys and values"),
        ("controller: {mine: {of: [}}", "not valid YAML"),
        ("controller: {mine: {of: pid, models: ['${oc.env:HOME}']}}", "a reference is"),
    ],
)
def test_what_is_no_sheet_is_said(lab, text, message):
    with pytest.raises(UsageError, match=message):
        OptionFiles(lab(text))


def test_two_sheets_with_the_same_option(lab):
    lab()
    with pytest.raises(UsageError, match=r"more.yaml: controller/brisk: stands in lab.yaml too"):
        OptionFiles(lab("controller: {brisk: {of: pid}}", "more"))
