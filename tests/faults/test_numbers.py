"""Numbers that no experiment has: refused in one line that names the key, before anything is flown."""

import dataclasses

import pytest

from quadexp.errors import UsageError
from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import session
from quadexp.parts.settings import declared

BASES = (
    ["trajectory=circle", "plant=simplified", "controller=nominal_mpc"],
    ["trajectory=random"],
    ["trajectory=step"],
    ["vehicle=lei_li", "plant=blade_element", "sensor=lei_li", "trajectory=rectangle", "controller=rls_feedback"],
    ["vehicle=lei_li", "plant=blade_element", "sensor=lei_li", "trajectory=lei_li_circle", "controller=rls_mpc"],
)
# No number, none that a machine can hold, and none of the right kind. A word for a list is refused by its type.
WRONG = ("nan", "-inf", "1e999", "abc", "[nan,nan,nan]", "{a: 1}")


@pytest.fixture(scope="module")
def composer():
    with session() as composer:
        yield composer


def numbers(node, prefix=""):
    """Keys of all fields that declare an interval."""
    settings = declared(type(node))
    for field in dataclasses.fields(node):
        value = getattr(node, field.name)
        if dataclasses.is_dataclass(value):
            yield from numbers(value, f"{prefix}{field.name}.")
        elif field.name in settings and settings[field.name].setting.interval:
            yield f"{prefix}{field.name}"


def test_no_key_takes_what_is_no_number(composer):
    seen: set[str] = set()
    for overrides in BASES:
        keys = set(numbers(composer.compose(overrides))) - seen
        seen |= keys
        for key in sorted(keys):
            for value in WRONG:
                with pytest.raises(UsageError) as caught:
                    composer.compose([*overrides, f"{key}={value}"])
                line = str(caught.value)
                assert "\n" not in line and key.rpartition(".")[2] in line, (key, value, line)
    assert len(seen) > 90


@pytest.mark.parametrize(
    "override",
    [
        "vehicle.rotor_spin=[nan,1,-1,1]",
        "vehicle.inertia=[[nan,0,0],[0,1,0],[0,0,1]]",
        "vehicle.rotor_position=[[inf,0,0],[0,1,0],[0,0,1],[1,1,1]]",
        "plant.step=1e-9",  # a function of twenty million steps
    ],
)
def test_numbers_inside_lists_and_steps_without_end(composer, override):
    with pytest.raises(UsageError, match=override.partition("=")[0]):
        composer.compose([override])


@pytest.mark.parametrize(
    "overrides", [["trajectory=circle", "trajectory.acceleration=1e-9"], ["trajectory=random", "trajectory.speed=1e-9"]]
)
def test_flights_of_years_are_refused(composer, overrides):
    """Not by the terabytes that their samples would take."""
    with pytest.raises(UsageError, match="the trajectory takes"):
        fly_one(composer.compose([*overrides, "controller.backend=interpreted", "plant.backend=interpreted"]))


def test_a_path_too_small_to_be_flown(composer):
    with pytest.raises(UsageError, match="extent"):
        fly_one(composer.compose(["trajectory=random", "trajectory.extent=1e-300", "controller.backend=interpreted"]))
