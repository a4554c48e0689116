"""Keys: whatever can change a flight changes its key, and nothing else does."""

from dataclasses import fields, is_dataclass, replace

import pytest

from quadexp.experiment.identity import FLIGHT_GROUPS, find_model, flight_identity
from quadexp.parts.cells import Cells
from quadexp.parts.compose import compose, expand, session
from quadexp.parts.schema import WORLD, Config
from quadexp.parts.settings import keys_of
from quadexp.sweeps.plan import plan_cells, too_few_seeds
from tests.sweeps.test_sweep import key_of

OPTIONS = [
    [],
    ["vehicle=lei_li", "plant=blade_element", "controller=rls_mpc", "trajectory=lei_li_circle", "sensor=lei_li"],
    ["vehicle=lei_li", "plant=blade_element", "controller=rls_feedback", "trajectory=rectangle"],
    ["trajectory=random", "plant=ideal", "controller=perfect_mpc"],
    ["trajectory=step", "engine=dask"],
    ["trajectory=hover", "engine=jobs"],
    ["truth.mass=1.2", "payload=slung", "wind=dryden", "external=push", "ground=cheeseman_bennett"],
    ["payload=fixed", "wind=file", "wind.path=wind.csv"],
    ["wind=gust", "truth.inertia=[1.1,1,1]"],
]
PLACES = {("controller", "models")}  # where a checkpoint is looked for: what is found decides


def another(value):
    """A value of the same type that is not the same."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return value + 1
    if isinstance(value, str):
        return value + "x"
    if isinstance(value, tuple | list):
        return (another(value[0]), *value[1:]) if value else (1.0,)
    return 0.123 if value is None else {}


def leaves(node, path=()):
    for name in keys_of(type(node)):
        value = getattr(node, name)
        if is_dataclass(value):
            yield from leaves(value, (*path, name))
        else:
            yield (*path, name)


def changed(node, path):
    name, *below = path
    other = object.__new__(type(node))  # without the checks: the key alone is tested
    vars(other).update({f.name: getattr(node, f.name) for f in fields(node)})
    vars(other)[name] = changed(vars(other)[name], below) if below else another(vars(other)[name])
    return other


@pytest.mark.parametrize("overrides", OPTIONS, ids=lambda o: o[0] if o else "defaults")
def test_every_setting_of_a_flight_is_in_the_key_and_no_other(overrides):
    config = compose(overrides)
    key = key_of(config)
    relevant = {*FLIGHT_GROUPS, "model", "seed"}
    seen = set()
    for path in leaves(config):
        other = changed(config, path)
        acts = path[0] in WORLD and not all(getattr(one, path[0]).idle for one in (config, other))
        differs = key_of(other) != key
        assert differs == ((path[0] in relevant or acts) and path not in PLACES), path
        seen.add(path[0])
    assert seen == {f.name for f in fields(Config)}


def test_the_plan_knows_the_same_keys(tmp_path, monkeypatch):
    from tests.models.by_hand import make_checkpoint

    monkeypatch.chdir(tmp_path)
    make_checkpoint(tmp_path / "models/drag")
    grid = expand(["controller=nominal_mpc,linear_drag_mpc", "trajectory=circle,random,hover", "seed=range(3)"])
    jobs = plan_cells(grid)
    assert len(jobs) == len(grid)
    for key, job in jobs.items():
        model = find_model(job.cell.config)
        assert job.model == model
        assert key == job.key == key_of(job.cell.config, flight_identity(job.cell.config).inputs)


def test_another_content_of_a_checkpoint_is_another_cell(tmp_path):
    from tests.models.by_hand import make_checkpoint

    grid = expand(["controller=linear_drag_mpc", f"model={tmp_path}/m"])
    make_checkpoint(tmp_path / "m")
    (first,) = plan_cells(grid).values()
    (again,) = plan_cells(grid).values()
    (tmp_path / "m/model.json").write_text((tmp_path / "m/model.json").read_text() + " ")
    (other,) = plan_cells(grid).values()
    assert first.key == again.key != other.key
    assert first.condition == other.condition


class TestCells:
    def test_they_are_made_when_asked_for(self):
        made = []
        grids = [(("a=1", "a=2"), ("seed=0", "seed=1", "seed=2")), (("a=3",), ("seed=9",))]
        grid = Cells(grids, lambda overrides: made.append(overrides) or overrides)
        assert len(grid) == 7 and made == []
        expected = [(f"a={a}", f"seed={s}") for a in (1, 2) for s in (0, 1, 2)] + [("a=3", "seed=9")]
        assert [cell.overrides for cell in grid] == expected == made
        assert grid[-1].overrides == expected[-1] and [c.overrides for c in grid[2:4]] == expected[2:4]
        with pytest.raises(IndexError):
            grid[7]

    @pytest.mark.parametrize(
        "overrides",
        [
            ["trajectory=random,circle", "seed=0,7", "plant=simplified,ideal"],
            ["controller=gp_mpc,perfect_mpc", "controller.nodes=10,20", "trajectory=random", "trajectory.seed=1,2"],
            ["trajectory.radius='${trajectory.speed}'", "seed=1,2"],
            ["experiment=quick", "seed=3"],
            ["experiment=torrente_table1", "seed=0"],
        ],
        ids=lambda o: " ".join(o),
    )
    def test_each_is_what_it_would_be_alone(self, overrides):
        with session() as composer:
            grid = composer.expand(overrides)
        with session() as another_one:
            for cell in grid[:: len(grid) // 3 + 1]:  # also when the session is over
                alone = another_one.compose(cell.overrides)
                alone = replace(alone, sweep=None)
                assert cell.config == alone


@pytest.mark.parametrize(
    ("asked", "comparisons"),
    [
        (["controller=nominal_mpc,gp_mpc"], 1),
        (["controller=nominal_mpc,gp_mpc,perfect_mpc", "trajectory.speed=4,6", "trajectory=circle,lemniscate"], 8),
    ],
)
def test_before_a_sweep_it_is_said_how_many_seeds_could_show_a_difference(asked, comparisons):
    enough = next(n for n in range(2, 99) if comparisons * 2 / 2**n < 0.05)
    for seeds in range(2, 14):
        said = too_few_seeds(expand([*asked, f"seed=range({seeds})"]).grids, "nominal_mpc", 0.95)
        expected = f"{seeds} seeds cannot show a significant difference in a line; seed='range({enough})' can"
        assert said == (expected if seeds < enough else "")
    assert not too_few_seeds(expand(["controller=gp_mpc", "seed=0,1"]).grids, "nominal_mpc", 0.95)  # no comparison
