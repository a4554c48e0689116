"""Which settings are varied, what a number of an axis makes of them, and in which order the trials stand."""

import math

import pytest

from quadexp.errors import UsageError
from quadexp.parts.compose import compose
from quadexp.parts.options import OptionFiles
from quadexp.plugins.tune.objective import worth
from quadexp.plugins.tune.space import default_space, overrides, read_axes

CONFIG = compose(["controller=nominal_mpc", "controller.position_weight=[6,6,15]"])


def varied(*texts, numbers):
    return overrides(read_axes(texts, CONFIG), numbers)


def test_a_list_keeps_its_proportions_and_its_zeros():
    assert varied("controller.position_weight=1..100", numbers=[12.0]) == [
        "controller.position_weight=[12.0,12.0,30.0]"
    ]
    assert varied("controller.attitude_weight=0.01..1:log", numbers=[0.2]) == [
        "controller.attitude_weight=[0.0,0.2,0.2,0.2]"
    ]


def test_entries_of_a_list_are_axes_of_their_own():
    axes = "controller.position_weight.xy=1..100", "controller.position_weight.z=1..100"
    assert varied(*axes, numbers=[7.0, 3.0]) == ["controller.position_weight=[7.0,7.0,3.0]"]
    assert varied("controller.attitude_weight.z=0.01..1", numbers=[0.5]) == [
        "controller.attitude_weight=[0.0,0.1,0.1,0.5]"
    ]


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["controller.positon_weight=1..2"], "no such key; did you mean controller.position_weight"),
        (["plant.mass=1..2"], "what is tuned is the controller and what is around it"),
        (["controller.horizon=0..2"], r"controller.horizon=0.0: must be in \(0, 10\] s"),
        (["controller.horizon=0.5..20"], r"20.0: must be in \(0, 10\] s"),
        (["controller.horizon=2..3"], "must contain 1, which it is now"),
        (["controller.horizon=1..1"], "the range is empty"),
        (["controller.horizon=1-2"], "expected LOW..HIGH"),
        (["controller.horizon=0..2:log"], "a logarithmic range begins above 0"),
        (["controller.nodes=5.5..20"], "is a whole number"),
        (["controller.terminal_weight"], "is 0 now: give its range"),
        (["controller.residual=1..2"], "is none, not a number"),
        (["controller.feedforward=0..1"], "is True, not a number"),
        (["controller.attitude_weight.w=0..1"], "not a number|no such key"),
        (["controller.horizon=0.5..2", "controller.horizon=0.5..3"], "is varied twice"),
        (["controller.position_weight=1..9", "controller.position_weight.z=1..90"], "is varied twice"),
        (["controller.input_weight=0.01..2e6"], r"must be in \(0, 1e6\]"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(texts, message):
    with pytest.raises(UsageError, match=message) as error:
        read_axes(texts, CONFIG)
    assert "\n" not in str(error.value)


def test_proportions_are_within_the_range_of_the_setting():
    with pytest.raises(UsageError, match="must be in"):
        read_axes(["controller.position_weight=1..999999"], CONFIG)  # z is 2.5 times that


OPTIONS = OptionFiles().options("controller")
REMEDY_OPTIONS = ["observer=disturbance", "observer=wind", "adaptive=l1", "rate_loop=indi"]


@pytest.mark.parametrize("option", [name for name in OPTIONS if not name.endswith("_tuned")])
def test_default_spaces_contain_the_settings(option):
    config = compose([f"controller={option}"])
    if option in ("raptor", "policy", "exported"):
        with pytest.raises(UsageError, match="its keys say no ranges to tune it in"):
            default_space(config)
        return
    axes = read_axes([], config)
    assert axes and all(axis.low < axis.start < axis.high for axis in axes)


def test_parts_of_a_list_have_ranges_of_their_own():
    assert [axis.text() for axis in read_axes([], compose(["controller=pid"]))][1:3] == [
        "controller.velocity_proportional.xy=0.5..15:log",
        "controller.velocity_proportional.z=1..20:log",
    ]


@pytest.mark.parametrize("remedy", REMEDY_OPTIONS)
def test_default_spaces_of_remedies_join_that_of_the_controller(remedy):
    axes = read_axes([], compose(["controller=nominal_mpc", remedy]))
    own = [axis for axis in axes if axis.key.startswith(f"{remedy.partition('=')[0]}.")]
    assert own and len(axes) > len(own) and all(axis.low < axis.start < axis.high for axis in axes)


def flight(error, outcome="ok", duration=20.0):
    return {"mean_error": error, "rmse": 2 * error, "outcome": outcome, "duration": duration}


def value(*rows, **options):
    return worth(rows, [20.0] * len(rows), **options).value


def test_it_is_the_logarithm_of_the_geometric_mean():
    found = worth([flight(0.001), flight(0.1)], [20.0, 20.0])
    assert math.exp(found.value) == pytest.approx(0.01) and found.error == pytest.approx(0.01) and found.lost == 0
    assert worth([flight(0.001), flight(0.1)], [20.0, 20.0], metric="rmse").error == pytest.approx(0.02)


def test_lost_flights_are_worse_than_any_error_and_the_earlier_the_worse():
    flights = [flight(1e-4) for _ in range(3)]
    late, early = flight(0.3, "lost", 19.0), flight(0.3, "lost", 1.0)
    never = flight(math.nan, "infeasible", 0.0)
    order = [
        value(*flights, flight(1e-4)),
        value(*flights, flight(9.9)),
        value(*flights[:2], flight(9.9), flight(9.9)),
        value(*flights, late),
        value(*flights, early),
        value(*flights, never),
        value(*flights[:2], late, late),
    ]
    assert order == sorted(order) and len(set(order)) == len(order)
    assert worth([*flights, never], [20.0] * 4).lost == 1


def test_a_margin_that_is_too_small_orders_the_trials_below_all_others():
    def with_margin(margin, error=0.01):
        return value(flight(error), margins=[margin, 1.0], least_margin=0.05)

    assert with_margin(0.05) == value(flight(0.01)) < with_margin(0.049, 1e-4) < with_margin(0.02) < with_margin(0.0)
