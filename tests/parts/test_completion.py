"""Completion of groups, options, keys and words, without Hydra."""

from __future__ import annotations

import pytest

from quadexp.parts.listing import candidates, key_words
from quadexp.parts.options import OptionFiles, groups
from quadexp.parts.schema import PARTS
from quadexp.parts.settings import plain


def typed(*words, conf=None):
    *before, incomplete = words
    return candidates(before, incomplete, conf)


@pytest.mark.parametrize(
    ("words", "expected", "prefix"),
    [
        (("contr",), {"controller=gp_mpc", "controller=nominal_mpc"}, "controller="),
        (("controller=n",), {"controller=nominal_mpc"}, "controller=n"),
        (("trajectory=circle,le",), {"trajectory=circle,lemniscate"}, "trajectory=circle,le"),
        (("trajectory.sp",), {"trajectory.speed="}, "trajectory.sp"),
        (("controller.backe",), {"controller.backend=auto", "controller.backend=interpreted"}, "controller.backend="),
        (("controller.feedf",), {"controller.feedforward=true", "controller.feedforward=false"}, "controller.feedf"),
        (("seed=0", "experiment=q"), {"experiment=quick"}, "experiment=q"),
        # bash splits words at "=" and wants the value alone back
        (("controller", "=", "gp"), {"gp_mpc"}, "gp"),
        (("controller", ""), {"gp_mpc", "linear_drag_mpc", "nominal_mpc", "perfect_mpc"}, ""),
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
    keys = {f"{group}.{name}" for group in PARTS for part in files.parts(group).values() for name in plain(part)}
    assert {key if key in root else ".".join(key.split(".")[:2]) for key in key_words()} <= keys | set(root)
    assert set(groups()) >= {"vehicle", "plant", "trajectory", "controller", "collect", "gp", "drag", "experiment"}
