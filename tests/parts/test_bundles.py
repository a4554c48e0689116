"""Bundles of the group `world`: options of several parts at once."""

from __future__ import annotations

import pytest

from quadexp.parts.compose import compose, expand, session
from quadexp.parts.options import OptionFiles
from quadexp.parts.schema import world_parts
from quadexp.parts.settings import record
from tests.parts.test_compose import hydra_composes

# No part, all of them, a few, one; values of a part, of the vehicle, and of what is told late.
OF_EVERY_SHAPE = ("clean", "everything", "only_wind", "sun_com_10", "sun_late_50")
QUICK = ["experiment=quick", "controller=gp_mpc"]
FILES = OptionFiles()
BUNDLES = FILES.options("world")


@pytest.mark.parametrize("more", [["wind=constant", "wind.velocity=[1,2,3]"], QUICK], ids=len)
@pytest.mark.parametrize("name", OF_EVERY_SHAPE[1:])
def test_composed_as_hydra_itself_does(name, more):
    choices = [*more, f"world={name}"]
    expected, composed = hydra_composes(choices), record(compose(choices))
    assert {**composed, "world": ""} == {**expected, "world": ""}


def test_their_names():
    with session() as composer:
        for name in BUNDLES:
            config = composer.compose([f"world={name}"])
            assert config.world == name and bool(world_parts(config)) == (name != "clean")
            assert composer.compose([f"world={name}", "seed=3"]).world == name
        for name in OF_EVERY_SHAPE[1:]:
            assert composer.compose([f"world={name}", "seed=3", "controller=gp_mpc"]).world == name
            part = next(iter(world_parts(composer.compose([f"world={name}"]))))
            gusty = "wind=gust" if part != "wind" else "wind=constant"
            assert composer.compose([f"world={name}", gusty]).world == f"{name},{gusty}"


def test_a_sweep_over_bundles():
    cells = expand([f"world={','.join(BUNDLES)}", "seed=0,1"])
    assert {cell.config.world for cell in cells} == set(BUNDLES) and {cell.varied for cell in cells} == {""}
