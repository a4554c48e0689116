"""Completion of groups, options, keys and words, without Hydra."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace

import pytest

from quadexp.completion import complete, groups, keys
from quadexp.compose import compose
from quadexp.config import Config


def typed(*words, conf=None):
    *before, incomplete = words
    return complete(SimpleNamespace(params={"overrides": list(before), "conf": conf}), incomplete)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (
            ("contr",),
            ["controller=gp_mpc", "controller=linear_drag_mpc", "controller=nominal_mpc", "controller=perfect_mpc"],
        ),
        (("controller=n",), ["controller=nominal_mpc"]),
        (("trajectory=circle,le",), ["trajectory=circle,lemniscate"]),
        (("trajectory.sp",), ["trajectory.speed="]),
        (
            ("controller.back",),
            ["controller.backend=auto", "controller.backend=compiled", "controller.backend=interpreted"],
        ),
        (("controller.feed",), ["controller.feedforward=true", "controller.feedforward=false"]),
        (("seed=0", "experiment=q"), ["experiment=quick"]),
        # bash splits words at "=" and wants the value alone back
        (("controller", "=", "gp"), ["gp_mpc"]),
        (("controller", ""), ["gp_mpc", "linear_drag_mpc", "nominal_mpc", "perfect_mpc"]),
        (("nothing_like_it",), []),
    ],
)
def test_candidates(words, expected):
    assert typed(*words) == expected


def test_an_empty_word_offers_groups_and_plain_keys():
    offered = typed("")
    assert {"vehicle=", "controller=", "model=", "seed="} <= set(offered)
    assert not [name for name in offered if "." in name]


def test_a_folder_of_ones_own(tmp_path):
    (tmp_path / "trajectory").mkdir()
    (tmp_path / "trajectory" / "mine.yaml").touch()
    assert typed("trajectory=m", conf=tmp_path) == ["trajectory=mine"]


def test_every_key_offered_can_be_set():
    config = compose([])
    assert isinstance(config, Config)
    for key in keys():
        node, _, name = key.rpartition(".")
        if node in ("controller", "collect", "gp", "drag", "evaluate", "vehicle", "plant"):
            assert hasattr(getattr(config, node), name), key
    assert set(groups()) >= {"vehicle", "plant", "trajectory", "controller", "collect", "gp", "drag", "experiment"}


def test_hydra_is_not_imported():
    code = (
        "import sys; from types import SimpleNamespace; from quadexp.completion import complete;"
        "complete(SimpleNamespace(params={}), 'contr'); print('hydra' in sys.modules, 'numpy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.split() == ["False"] * 2
