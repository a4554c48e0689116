"""What there is to choose is listed from the files and the classes, with what an option sets and what it inherits."""

from __future__ import annotations

import pytest

from quadexp.errors import UsageError
from quadexp.parts.compose import compose
from quadexp.parts.listing import listed
from quadexp.parts.options import OptionFiles
from quadexp.parts.schema import PARTS, PRESETS


def keys(option):
    return {one["key"]: one for one in listed(option)}


def test_every_group_and_option_is_listed():
    groups = {one["group"]: one["options"].split() for one in listed()}
    assert {*PARTS, *PRESETS, "experiment", "world", "remedies"} <= groups.keys()
    for group, options in groups.items():
        found = listed(group)
        assert [one["option"] for one in found if "option" in one] == [f"{group}={option}" for option in options]
        assert all(one["meaning"] for one in found), group


def test_the_values_are_those_that_fly():
    """Of an option that extends another one: its own, the other one's, and the defaults of the class."""
    config = compose(["controller=gp_mpc"]).controller
    shown = keys("controller=gp_mpc")
    assert shown["controller.residual"]["value"] == config.residual == "gaussian_process"
    assert shown["controller.nodes"] == {
        "key": "controller.nodes", "value": str(config.nodes), "allowed": "[2, 200] nodes",
        "meaning": "number of intervals of the horizon",
    }  # fmt: skip
    for option in ("wind=gust", "trajectory=ellipse", "estimator=late", "observer=wind"):
        group = option.partition("=")[0]
        part = getattr(compose([option]), group)
        for key, one in keys(option).items():
            value = getattr(part, key.removeprefix(f"{group}."))
            assert one["value"] == (
                "null" if value is None else str(list(value) if isinstance(value, tuple) else value).replace(" ", "")
            ), key


def test_a_preset_says_what_it_sets():
    assert keys("horizon=precise")["first_node"]["value"] == "0.02"


def test_a_word_is_looked_for_in_options_keys_and_meanings():
    found = [one.get("option") or one["key"] for one in listed("delay")]
    assert "delay=identified" in found and "estimator.delay" in found and "sensor.pose_delay" in found
    found = [one.get("option") or one["key"] for one in listed("dead_time")]
    assert "motor=dead_time" in found and "controller.dead_time" in found and "inner.dead_time" in found
    with pytest.raises(UsageError, match="no group, option or key has this word"):
        listed("zzz")
    with pytest.raises(UsageError, match="wind=guts: no such wind; did you mean gust"):
        listed("wind=guts")


def test_a_part_of_ones_own_is_listed_like_the_others(tmp_path, monkeypatch):
    (tmp_path / "wind").mkdir()
    (tmp_path / "wind" / "steady.yaml").write_text(
        "# Mine.\n_target_: quadexp.world.constant_wind.ConstantWind\nvelocity: [1, 0, 0]\n"
    )
    assert OptionFiles(tmp_path).part_of("wind", "steady").__name__ == "ConstantWind"
    assert {"option": "wind=steady", "meaning": "Mine"} in listed("wind", tmp_path)
    assert listed("wind=steady", tmp_path)[0]["value"] == "[1,0,0]"
