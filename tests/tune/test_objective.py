"""The order in which the objective puts trials."""

from __future__ import annotations

import math

import pytest

from quadexp.tune.objective import worth


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
