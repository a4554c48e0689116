"""What is known of delays is said once, in `timing=`, and means what the keys of each part mean."""

import pytest

from quadexp.errors import UsageError
from quadexp.experiment.identity import flight_record
from quadexp.parts.compose import compose, session
from tests.deleted import needs

SAME = (
    ("horizon=robust timing.dead_time=0.02", "horizon=robust controller.dead_time=0.02"),
    ("motor=states timing.motor_lag=0.02", "motor=states controller.motor_lag=0.02"),
    ("motor=lead timing.motor_lag=0.02 observer=wind", "motor=lead controller.motor_lead=0.02 observer=wind"),
    ("motor=dead_time timing.motor_lag=0.03 timing.dead_time=0.02", "motor=dead_time controller.dead_time=0.05"),
    ("controller=sun_mpc timing.motor_lag=0.02", "controller=sun_mpc controller.motor_lead=0.02"),
    ("adaptive=l1 timing.dead_time=0.03", "adaptive=l1 controller.dead_time=0.03"),
    ("adaptive=l1 adaptive.dead_time=0.01", "adaptive=l1 adaptive.dead_time=0.01 timing=none"),
    (
        "controller=pid delay=prediction timing.age=0.02 timing.dead_time=0.01",
        "controller=pid delay=prediction delay.time=0.02 delay.dead_time=0.01",
    ),
    ("controller=dfbc rate_loop=indi timing.motor_lag=0.03", "controller=dfbc rate_loop=indi rate_loop.motor_lag=0.03"),
    (
        "controller=pid observer=disturbance timing.dead_time=0.01",
        "controller=pid observer=disturbance observer.dead_time=0.01",
    ),
    ("timing.dead_time=0.02 controller.dead_time=0.01", "controller.dead_time=0.01"),
)  # fmt: skip


@pytest.mark.parametrize(("together", "apart"), SAME)
def test_it_stands_for_the_keys_of_the_parts(together, apart):
    assert flight_record(compose(together.split())) == flight_record(compose(apart.split()))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("controller=pid timing.dead_time=0.01", "timing.dead_time=0.01: nothing in this configuration uses it"),
        pytest.param(
            "timing.age=0.01",
            "timing.age=0.01: nothing in this configuration uses it; parts that do: delay=prediction",
            marks=needs("remedies"),
        ),
        pytest.param(
            "controller=geometric timing.age=0.01 delay=auto",
            "^timing.age=0.01: delay=auto finds delays itself; leave it out$",
            marks=needs("auto", "laws"),
        ),
        ("timing.dead_time=2", "must be in"),
        ("timing.dead=1", "did you mean timing.dead_time"),
    ],
)
def test_what_nobody_takes_is_refused(words, said):
    with pytest.raises(UsageError, match=said):
        compose(words.split())


def test_an_option_of_ones_own_serves_every_controller(tmp_path):
    (tmp_path / "timing").mkdir()
    text = "_target_: quadexp.parts.timing.Timing\ndead_time: 0.02\nage: 0.01\n"
    (tmp_path / "timing" / "lab.yaml").write_text(text)
    with session([tmp_path]) as composer:
        mpc = composer.compose(["timing=lab", "delay=strapdown"])
        pid = composer.compose(["timing=lab", "controller=pid"])  # which has no use for it
    assert mpc.controller.dead_time == 0.02 and mpc.delay.time == 0.01
    assert flight_record(pid) == flight_record(compose(["controller=pid"]))


def test_it_counts_for_what_a_flight_recorded():
    from quadexp.plugins.margins.recorded import recorded_words

    with session() as composer:
        flown = flight_record(composer.compose(["controller.dead_time=0.02", "motor=lead"]))
        again = composer.compose(recorded_words(composer, flown, ["timing.dead_time=0.05"]))
    assert (again.controller.dead_time, again.controller.motor_lead) == (0.05, 0.03)
