"""Without a plug-in its options are not there, nor those that need one of them; who asks for one is told why."""

import importlib

import pytest

from quadexp.errors import UsageError
from quadexp.parts import absent
from quadexp.parts.compose import Composer, compose
from quadexp.parts.listing import candidates, listed
from quadexp.parts.options import absent_options, groups
from quadexp.plugin import shipped_plugins


@pytest.fixture
def without(monkeypatch):
    """The options as they are without a plug-in."""

    def delete(plugin):
        others = tuple(name for name in shipped_plugins() if name != plugin)
        monkeypatch.setattr(absent, "shipped_plugins", lambda: others)
        absent_options.cache_clear()

    yield delete
    absent_options.cache_clear()


@pytest.mark.parametrize(
    ("plugin", "override", "reason"),
    [
        ("laws", "controller=pid", "the plug-in quadexp/plugins/laws is not there"),
        ("laws", "controller=dfbc_tuned", "controller=dfbc: the plug-in quadexp/plugins/laws is not there"),
        ("worlds", "wind=gusty", "wind=dryden: the plug-in quadexp/plugins/worlds is not there"),
        ("worlds", "world=only_wind", "wind=gusty: wind=dryden: the plug-in quadexp/plugins/worlds is not there"),
        ("auto", "remedies=auto", "delay=auto: the plug-in quadexp/plugins/auto is not there"),
        ("exchange", "vehicle=cf2x_L250", "the plug-in quadexp/plugins/exchange is not there"),
        ("exchange", "plant=drone_models", "the plug-in quadexp/plugins/exchange is not there"),
        (
            "gaussian_process",
            "controller=gp_mpc",
            "model=gaussian_process: the plug-in quadexp/plugins/gaussian_process is not there",
        ),
        ("neural", "controller=sum_mpc", "model=neural: the plug-in quadexp/plugins/neural is not there"),
        ("papers", "experiment=adaptation", "controller=rls_mpc: the plug-in quadexp/plugins/papers is not there"),
    ],
)
def test_one_line_says_why_it_is_not_there(without, plugin, override, reason):
    without(plugin)
    with pytest.raises(UsageError) as refused:
        compose([override])
    said = str(refused.value)
    assert said.startswith(f"{override}: ") and said.endswith(reason) and "\n" not in said
    group, _, option = override.partition("=")
    assert option not in groups()[group] and override not in candidates([], f"{group}=")
    assert override not in [record.get("option") for record in listed(group)]
    with pytest.raises(UsageError, match="is not there"):
        listed(override)


def test_what_needs_nothing_of_it_stays(without):
    there = groups()
    without("laws")
    left = groups()
    assert {"nominal_mpc", "linear_drag_mpc"} <= {*left["controller"]} < {*there["controller"]}
    assert left["wind"] == there["wind"] and left["vehicle"] == there["vehicle"]


def test_a_model_that_is_not_there_is_not_fitted(without):
    without("gaussian_process")
    with pytest.raises(UsageError, match=r"^fit gp_full: .*model=gaussian_process: the plug-in \S+ is not there$"):
        Composer().fitted("gp_full")


def test_an_own_option_of_its_name_is_there_and_one_that_extends_it_says_why_not(without, tmp_path):
    without("laws")
    (tmp_path / "controller").mkdir()
    (tmp_path / "controller" / "pid.yaml").write_text("defaults: [nominal_mpc, _self_]\n")
    (tmp_path / "controller" / "mine.yaml").write_text("defaults: [dfbc, _self_]\n")
    assert compose(["controller=pid"], tmp_path).controller.name == "pid"
    with pytest.raises(UsageError, match=r"^controller=dfbc: the plug-in quadexp/plugins/laws is not there$"):
        compose(["controller=mine"], tmp_path)


def test_with_all_plugins_there_every_option_is_there():
    assert absent_options() == {} or len(shipped_plugins()) < 20


def test_a_plugin_that_another_one_needs_is_named():
    """Where code of a plug-in imports from one that is not there: as an error of import, and in one line."""
    for name in ("quadexp.plugins.nowhere", "quadexp.plugins.nowhere.deeper"):
        with pytest.raises(UsageError, match=r"^the plug-in quadexp/plugins/nowhere is not there$") as refused:
            importlib.import_module(name)
        assert isinstance(refused.value, ImportError) and refused.value.exit_code == 2
