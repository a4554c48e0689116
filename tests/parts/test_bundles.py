"""Bundles and presets: options of several parts at once, of the group `world` and of the horizon's grid."""

from pathlib import Path

import pytest

from quadexp.errors import UsageError
from quadexp.parts.cells import varied
from quadexp.parts.compose import compose, expand, session
from quadexp.parts.options import OptionFiles
from quadexp.parts.schema import world_parts
from quadexp.parts.settings import record
from tests.deleted import needs
from tests.parts.test_compose import hydra_composes

# No part, all of them, a few, one; values of a part, of the vehicle, and of what is given late.
OF_EVERY_SHAPE = ("clean", "everything", "only_wind", "sun_com_10", "sun_late_50")
QUICK = ["experiment=quick", "controller=gp_mpc"]
FILES = OptionFiles()
BUNDLES = FILES.options("world")


@pytest.mark.parametrize("more", [["wind=constant", "wind.velocity=[1,2,3]"], QUICK], ids=len)
@pytest.mark.parametrize("name", OF_EVERY_SHAPE[1:])
def test_composed_as_hydra_itself_does(name, more):
    choices = [*more, f"world={name}"]
    composed, expected = record(compose(choices)), hydra_composes(choices)
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


@needs()
def test_a_sweep_over_bundles():
    cells = expand([f"world={','.join(BUNDLES)}", "seed=0,1"])
    assert {cell.config.world for cell in cells} == set(BUNDLES) and set(varied(cells)) == {""}


MPCS = ["nominal_mpc", "linear_drag_mpc", "gp_mpc", "perfect_mpc", "rls_mpc"]
GRID = ("first_node", "horizon", "nodes", "input_hold")


def grid(*overrides: str, conf: Path | None = None) -> tuple[float | str, ...]:
    controller = compose(list(overrides), conf).controller
    return tuple(getattr(controller, name) for name in GRID)


@pytest.mark.parametrize("controller", MPCS)
def test_the_presets(controller):
    """Published is the paper's grid, for every MPC, and what is flown when nothing is said."""
    published = (0.0, 1.0, 10, None)  # which is the command
    assert grid(f"controller={controller}") == grid(f"controller={controller}", "horizon=published") == published
    assert grid(f"controller={controller}", "horizon=precise") == (0.02, 0.6, 10, "deviation")
    assert grid(f"controller={controller}", "horizon=robust") == (0.06, 0.8, 10, "deviation")
    assert grid(f"controller={controller}", "horizon=firm") == (0.04, 0.8, 10, "deviation")
    assert grid(f"controller={controller}", "horizon=stiff") == grid(f"controller={controller}", "horizon=precise")


def test_a_key_of_ones_own_is_over_the_preset():
    assert grid("horizon=precise", "controller.first_node=0.04", "controller.nodes=12") == (0.04, 0.6, 12, "deviation")
    assert grid("controller.horizon=0.9", "horizon=robust") == (0.06, 0.9, 10, "deviation")


@pytest.mark.parametrize("name, observer", [("wind", "wind"), ("offset_free", "disturbance")])
def test_a_bundle_of_remedies_chooses_the_horizon_too(name, observer):
    """And what is chosen beside it is over the bundle."""
    config = compose([f"remedies={name}", "controller=gp_mpc"])
    assert config.observer.name == observer and config.controller.position_weight == (200.0, 200.0, 200.0)
    config = compose([f"remedies={name}", "controller=gp_mpc", "horizon=firm", "observer.torque_bandwidth=7"])
    assert config.controller.position_weight == (50.0, 50.0, 50.0) and config.observer.torque_bandwidth == 7
    assert record(compose([f"remedies={name}"])) == hydra_composes([f"remedies={name}"])


def test_a_bundle_sets_values_of_the_part_that_it_chooses():
    """Not of another one that is chosen over it."""
    with pytest.raises(
        UsageError, match=r"wind_tuned: sets observer.wind_walk, which observer=disturbance does not have"
    ):
        compose(["observer=disturbance", "remedies=gp_mpc_wind_tuned"])


@pytest.mark.parametrize(
    ("others", "horizon"),
    [([], "published"), ([], "robust"), (["experiment=torrente_table1"], "precise"), (["remedies=wind"], "firm")],
)
def test_presets_are_composed_as_hydra_itself_does(others, horizon):
    choices = [*others, "controller=gp_mpc", f"horizon={horizon}"]
    assert record(compose(choices)) == hydra_composes(choices)


def test_what_has_no_horizon_takes_none():
    assert compose(["controller=rls_feedback", "horizon=published"]).controller.former_kind == "feedback"
    for others in ([], ["experiment=families"]):
        with pytest.raises(
            UsageError, match=r"^horizon=precise: sets controller\.\w+, which controller=rls_feedback does"
        ):
            compose([*others, "controller=rls_feedback", "horizon=precise"])
    with pytest.raises(UsageError, match=r"^remedies=wind: sets controller\.\w+, which controller=pid does not have$"):
        compose(["controller=pid", "remedies=wind"])
    with pytest.raises(UsageError, match=r"horizon=precize: no such horizon; did you mean precise"):
        compose(["horizon=precize"])


def test_sweeps_vary_it_and_say_so():
    cells = expand(["horizon=published,precise", "controller=nominal_mpc,gp_mpc", "seed=0,1"])
    assert len(cells) == 8
    assert set(varied(cells)) == {"horizon=published", "horizon=precise"}
    for cell in cells:
        assert cell.config.controller.first_node == (0.02 if "horizon=precise" in cell.overrides else 0.0)
