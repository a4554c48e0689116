"""What a user's own trajectory or plant gives is checked before the flight: one line says what is wrong, and where."""

import casadi as ca
import numpy as np
import pytest

from quadexp.errors import UsageError
from quadexp.reference.base import FlatOutput, check_own
from quadexp.world.integrator import STEP_INPUTS, Equations, SimulatedPlant
from tests.cli.command import run


class Path:
    duration, peak_speed = 2.0, 1.0

    def __init__(self, **changed):
        self.position, self.yaw = np.zeros((3, 5, 3)), np.zeros((3, 3))
        vars(self).update(changed)

    def flat_output(self, t):
        return self.output if hasattr(self, "output") else FlatOutput(self.position, self.yaw)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"duration": None}, "duration is None; a positive number is needed"),
        ({"duration": 0.0}, "duration is 0.0"),
        ({"duration": float("nan")}, "duration is nan"),
        ({"peak_speed": "fast"}, "peak_speed is fast"),
        ({"position": np.zeros((3, 3, 3))}, r"position of 3 times has the shape \(3, 3, 3\); \(3, 5, 3\) is needed"),
        ({"yaw": np.zeros(3)}, r"yaw of 3 times has the shape \(3,\); \(3, 3\) is needed"),
        ({"position": np.full((3, 5, 3), np.nan)}, "position is not finite"),
        ({"output": np.zeros((3, 5, 3))}, "flat_output must give a FlatOutput, not ndarray"),
    ],
)
def test_a_trajectory(changed, said):
    check_own(Path(), "mine")
    check_own(Path(yaw=None), "mine")
    with pytest.raises(UsageError, match=f"trajectory=mine: {said}"):
        check_own(Path(**changed), "mine")


class Line(Path):
    """At 1 m/s in x. speed: that it says."""

    calls = 0

    def __init__(self, speed=1.0):
        super().__init__(speed=speed)

    def flat_output(self, t):
        position = np.zeros((len(t), 5, 3))
        position[:, 0, 0] = t
        position[:, 1, 0] = self.speed
        return self.changed(t, position)

    def changed(self, t, position):
        return FlatOutput(position, None)


class Forgetful(Line):
    def changed(self, t, position):
        self.calls += 1
        return FlatOutput(position + self.calls, None)


class Writing(Line):
    def changed(self, t, position):
        t *= 0.5
        return FlatOutput(position, None)


def test_a_derivative_that_is_none_is_noted(capsys):
    """A wrong one was flown without a word, and the error was the controller's."""
    check_own(Line(), "right")
    check_own(Line(speed=2.0), "mine")
    said = "note: trajectory=mine: flat_output: its derivative of order 1 is not that of order 0, differentiated\n"
    assert capsys.readouterr().err == said


def test_a_path_that_is_another_at_every_call_or_changes_the_times_is_refused():
    with pytest.raises(UsageError, match="trajectory=mine: position of one time differs from call to call"):
        check_own(Forgetful(), "mine")
    with pytest.raises(ValueError, match="read-only"):
        check_own(Writing(), "mine")


def step(sizes, results):
    """A step with inputs of some sizes, whose outputs have others."""
    inputs = [ca.SX.sym(name, size) for name, size in zip(STEP_INPUTS, sizes, strict=False)]
    return ca.Function("mine", inputs, [ca.SX.zeros(size) for size in results])


@pytest.mark.parametrize(
    ("sizes", "results", "said"),
    [
        (
            (17, 4, 0, 0),
            (17, 3),
            "must be a function s, held, noise, parameters, step -> s_next, specific_force; it has",
        ),
        (
            (17, 4, 0, 0, 1),
            (17,),
            "must be a function s, held, noise, parameters, step -> s_next, specific_force; it has",
        ),
        ((17, 4, 0, 0, 1), (13, 3), "its output s_next has 13 numbers; 17 are needed"),
        ((17, 4, 0, 0, 1), (17, 2), "its output specific_force has 2 numbers; 3 are needed"),
    ],
)
def test_the_step_of_a_plant(sizes, results, said):
    with pytest.raises(UsageError, match=said):
        Equations(step(sizes, results))


def test_inner_states_of_a_plant(vehicle):
    class Lagging(SimulatedPlant):
        given = np.zeros(4)

        def initial(self, thrust):
            return self.given

    equations = Equations(step((17, 4, 0, 0, 1), (17, 3)))
    Lagging(vehicle, equations, step=0.01, backend="interpreted")
    Lagging.given = np.zeros(2)
    with pytest.raises(UsageError, match=r"Lagging: initial gives inner states of shape \(2,\); \(4,\) is needed"):
        Lagging(vehicle, equations, step=0.01, backend="interpreted")


def test_where_an_error_came_up_is_said(here):
    assert run("new", "plant", "soft", "--to", "parts")[0] == 0
    file = here / "parts" / "soft.py"
    text = file.read_text().replace("- thrust) / time_constant", "- thrust)[:2] / time_constant")
    file.write_text(text)
    line = next(n for n, words in enumerate(text.splitlines(), 1) if 'integrate("rk4"' in words)
    code, _, errors = run("simulate", "--conf", "parts", "plant=soft", "controller=geometric", "--out", "a.parquet")
    assert code == 1 and f"error: soft.py, line {line}: RuntimeError: " in errors and errors.count("\n") == 1, errors
