"""What there is to choose is listed and completed from files and classes, with what an option sets and inherits."""

from types import SimpleNamespace

import pytest

from quadexp.errors import UsageError
from quadexp.parts.compose import compose
from quadexp.parts.listing import candidates, key_words, listed
from quadexp.parts.options import OptionFiles, groups
from quadexp.parts.schema import CLASSES, PARTS, PRESETS
from quadexp.parts.settings import plain
from tests.deleted import needs


def keys(option):
    return {one["key"]: one for one in listed(option)}


def test_every_group_and_option_is_listed():
    groups = {one["group"]: one["options"].split() for one in listed()}
    assert {*PARTS, "model", *PRESETS, "experiment", "world", "remedies"} <= groups.keys()
    for group, options in groups.items():
        found = listed(group)
        assert [one["option"] for one in found if "option" in one] == [f"{group}={option}" for option in options]
        assert all(one["meaning"] for one in found), group


def test_the_values_are_those_that_fly():
    """Of an option that extends another one: its own, the other one's, and the defaults of the class."""
    config = compose(["controller=linear_drag_mpc"]).controller
    shown = keys("controller=linear_drag_mpc")
    assert shown["controller.residual"]["value"] == config.residual == "linear_drag"
    assert shown["controller.nodes"] == {
        "key": "controller.nodes", "value": str(config.nodes), "allowed": "[2, 200] nodes",
        "meaning": "number of intervals of the horizon",
    }  # fmt: skip
    for option in ("wind=gust", "trajectory=circle", "estimator=late", "link=radio"):
        group = option.partition("=")[0]
        part = getattr(compose([option]), group)
        for key, one in keys(option).items():
            value = getattr(part, key.removeprefix(f"{group}."))
            assert one["value"] == (
                "null" if value is None else str(list(value) if isinstance(value, tuple) else value).replace(" ", "")
            ), key


@needs("remedies")
def test_a_group_has_all_keys_of_its_options_with_the_values_that_fly_by_default():
    shown, usual = keys_of_group("sensor"), compose().sensor
    assert {*keys("sensor=perfect"), *keys("sensor=imu_gnss")} <= shown.keys()
    assert shown["sensor.pose_rate"] == keys("sensor=perfect")["sensor.pose_rate"]
    assert float(shown["sensor.pose_rate"]["value"]) == usual.pose_rate == 0.0
    assert "wind.onset" in keys_of_group("wind") and "observer.wind_walk" in keys_of_group("wind")


def keys_of_group(group):
    return {one["key"]: one for one in listed(group) if "key" in one}


def test_a_preset_says_what_it_sets():
    assert keys("horizon=precise")["first_node"]["value"] == "0.02"


@needs("remedies", "laws")
def test_a_word_is_looked_for_in_options_keys_and_meanings():
    found = [one.get("option") or one["key"] for one in listed("delay")]
    assert "delay=strapdown" in found and "estimator.delay" in found and "sensor.pose_delay" in found
    found = [one.get("option") or one["key"] for one in listed("dead_time")]
    assert "motor=dead_time" in found and "controller.dead_time" in found and "rate_loop.dead_time" in found
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


def typed(*words, conf=None):
    *before, incomplete = words
    return candidates(before, incomplete, conf)


@pytest.mark.parametrize(
    ("words", "expected", "prefix"),
    [
        (("contr",), {"controller=linear_drag_mpc", "controller=nominal_mpc"}, "controller="),
        (("controller=n",), {"controller=nominal_mpc"}, "controller=n"),
        (("trajectory=circle,le",), {"trajectory=circle,lemniscate"}, "trajectory=circle,le"),
        (("trajectory.sp",), {"trajectory.speed="}, "trajectory.sp"),
        (("controller.backe",), {"controller.backend=auto", "controller.backend=interpreted"}, "controller.backend="),
        (("controller.feedf",), {"controller.feedforward=true", "controller.feedforward=false"}, "controller.feedf"),
        (("seed=0", "horizon=pr"), {"horizon=precise"}, "horizon=pr"),
        # bash splits words at "=" and wants the value alone back
        (("controller", "=", "lin"), {"linear_drag_mpc"}, "lin"),
        (("controller", ""), {"linear_drag_mpc", "nominal_mpc", "perfect_mpc"}, ""),
    ],
)
def test_candidates(words, expected, prefix):
    offered = typed(*words)
    assert expected <= set(offered)
    assert all(word.startswith(prefix) for word in offered)


def test_an_empty_word_offers_groups_and_plain_keys():
    offered = typed("")
    assert {"vehicle=", "controller=", "model=", "seed="} <= set(offered)
    assert not [name for name in offered if "." in name]


def test_a_folder_of_ones_own(tmp_path):
    (tmp_path / "trajectory").mkdir()
    (tmp_path / "trajectory" / "mine.yaml").touch()
    assert typed("trajectory=m", conf=tmp_path) == ["trajectory=mine"]


def test_every_key_offered_can_be_set_with_some_option():
    files, root = OptionFiles(), key_words("")
    keys = {f"{group}.{name}" for group in CLASSES for part in files.parts(group).values() for name in plain(part)}
    assert {key if key in root else ".".join(key.split(".")[:2]) for key in key_words()} <= keys | set(root)
    assert set(groups()) >= {"vehicle", "plant", "trajectory", "controller", "collect", "model", "experiment"}


@needs("bench")
def test_controllers_of_the_leaderboard_are_completed():
    from quadexp.plugins.bench.commands import _controllers

    context = SimpleNamespace(params={"conf": None})
    assert _controllers(context, "linear_") == ["linear_drag_mpc", "linear_drag_mpc_tuned"]


def test_what_is_there_is_listed_without_the_packages_that_an_option_needs(monkeypatch):
    """By name and meaning; its keys are those of the others, and asked for itself it says which package."""
    monkeypatch.setattr("quadexp.plugins.exchange.crazyflies.FILES", {})
    options = {record.get("option") for record in listed("vehicle")}
    assert {"vehicle=cf2x_L250", "vehicle=torrente"} <= options
    keys = {record.get("key") for record in listed("vehicle") + listed("plant")}
    assert {"vehicle.mass", "plant.linear_drag"} <= keys
    assert "vehicle=cf2x_L250" in candidates(["simulate"], "vehicle=cf")
    with pytest.raises(UsageError, match="pip install crazyflow"):
        listed("vehicle=cf2x_L250")
