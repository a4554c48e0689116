"""Mistakes in a user's part: each is said in one line that names it, and nothing is flown.

Python and CasADi take most of these without a word: a misspelt hook does nothing, float of an expression is NaN.
"""

import numpy as np
import pytest

import quadexp as qx
from tests.cli.command import run
from tests.deleted import needs
from tests.parts.test_own_seams import METRIC, QUICK, option

LAW = """
import math
from dataclasses import dataclass
import casadi as ca
from quadexp.control.law import Law
from quadexp.parts.settings import key

@dataclass(frozen=True, kw_only=True)
class Mine(Law):
    stiff: float = key(4.0, "stiffness", "[0, 100]", "1/s^2")
    memory = {"sum": 1}
    logged = ("sum",)

    def start(self, vehicle, x):
        return {"sum": 0.0}

    def equations(self, vehicle, inputs, memory):
        height = inputs.state[2] - inputs.path[2, 0]
        lift = vehicle.mass * (vehicle.gravity - self.stiff * height - 3.0 * inputs.state[9])
        thrusts = ca.repmat(lift / vehicle.n_rotors, vehicle.n_rotors, 1)
        return {"command": thrusts, "sum": memory.sum + inputs.period * height}
"""
LAYER = """
from dataclasses import dataclass
import casadi as ca
from quadexp.control.layer import LayerPart

@dataclass(frozen=True, kw_only=True)
class Mine(LayerPart):
    prefix = "adaptive."
    logged = {"sum": ("sum",)}

    def remembers(self, inputs):
        return {"sum": 1}

    def start(self, inputs, x, thrust):
        return {"sum": [0.0]}

    def before(self, vehicle, inputs, memory):
        return {"state": inputs.state}

    def after(self, vehicle, inputs, memory, found):
        return {"command": inputs.command, "sum": memory.sum + inputs.state[2]}
"""
WIND = """
import math
from dataclasses import dataclass
import casadi as ca
from quadexp.world.effect import Effect, Sizes

@dataclass(frozen=True, kw_only=True)
class Mine(Effect):
    stage = "wind"

    def sizes(self, clock, vehicle):
        return Sizes(inner=1)

    def start(self, rng, start):
        return (0.0,), ()

    def columns(self, clock, vehicle):
        return {"blown": 0}

    def wind(self, at):
        return ca.vertcat(3, 0, 0)

    def measure(self, at, measured):
        return at.inner, measured | {"state": measured["state"]}
"""
HOVER = ("trajectory=hover", "trajectory.duration=0.3", *QUICK)
LAW_MISTAKES = (
    (
        "        lift =@        height = height if height > 0 else 0\n        lift =",
        "mine.py, line 19: RuntimeError: ",
        "ca.if_else(",
    ),
    ("height - 3@max(height, 0) - 3", "mine.py, line 19: RuntimeError: ", "ca.fmax"),
    ("stiff * height@stiff * math.sqrt(height)", "a number in them is NaN", "write ca.sqrt"),
    ('"sum": 0.0@"som": 0.0', "start of Mine: 'som' is not remembered; did you mean sum?"),
    ('"sum": 0.0@"sum": [1.0, 2.0]', "start of Mine: 'sum' is [1.0, 2.0]; 1 finite numbers are needed"),
    ('"sum": 0.0@"sum": math.nan', "start of Mine: 'sum' is nan; 1 finite numbers are needed"),
    ('return {"sum": 0.0}@pass', "start of Mine: must return a dict of names and numbers, not NoneType"),
    ("sum@sent", "memory of Mine: 'sent' is the command that was sent last: choose another name"),
    ("sum@held", "memory of Mine: 'held' is the number of rotors at a limit: choose another name"),
    ("sum@thrust", "inputs.period@inputs.delivered[0]", "inputs.delivered remembers thrust of its own"),
    ("inputs.state[9]@inputs.command[0]", "inputs.command is that of the controller inside"),
    ('"command": thrusts@"held": thrusts, "command": thrusts', "must give 'held', 1 numbers; it has 4"),
    (
        "dataclass(frozen=True, kw_only=True)@needs_no_keys",
        "import math@import math\nneeds_no_keys = lambda kind: kind",
        "mine.Mine: stiff: a class with keys needs",
    ),
    ("(frozen=True, kw_only=True)@", "mine.py, line 8: TypeError: ", "the decorator is: dataclass(frozen=True"),
    ("stiff@name", "mine.Mine.name: every part has it, the name in tables"),
    ("key(4.0@key([4.0]", "mine.py, line 10: a key (stiffness): its default is a list; write a tuple"),
    ("stiff: float@stiff: list", "Mine.stiff: its type is a list; write tuple[float, ...]"),
    ("[0, 100]@0..100", "Mine.stiff: its range is '0..100'; write [0, 100], or (0, 100] without 0"),
    ("import math@from . import helper", "mine.py, line 2: ImportError: ", "by its name: import helper"),
)
LAYER_MISTAKES = (
    (
        "def after@def aftr",
        "def before@def befor",
        "mine.Mine: does nothing: it needs one of before, after; it has befor, aftr",
    ),
    ('"sum": [0.0]@"som": [0.0]', "start of Mine: 'som' is not remembered"),
    ('"state": inputs.state@"belief": ca.DM(11, 1)', "the class must say so, `believes = True`"),
    (
        '"state": inputs.state@"belief": ca.DM(11, 1)',
        '"adaptive."@"adaptive."\n    believes = True',
        "the controller inside reads none",
    ),
    ('"state": inputs.state@"state": inputs.state + inputs.command[0]', "which only `after` of a layer knows"),
)
WIND_MISTAKES = (
    (
        "def wind@def winds",
        "def measure@def measures",
        "mine.Mine: does nothing: it needs one of begin, wind,",
        "it has winds, measures",
    ),
    ("3, 0, 0@3, 0", "wind=mine: wind returns 2 numbers; 3 are needed"),
    ("3, 0, 0@math.sin(at.t), 0, 0", "equations of wind=mine: wind: a number in them is NaN"),
    ('stage = "wind"@stage = "winds"', "mine.Mine: its stage is 'winds'; it must be one of truth, wind,"),
    ('"blown"@"p_x"', "columns: p_x is a column of every flight: choose another name for it"),
    (
        'measured | {"state":@measured | {"stat":',
        "wind=mine: measure gives 'stat', which nothing reads; did you mean 'state'?",
    ),
    ("return at.inner, @return ", "wind=mine: measure must return at.inner, as it is now, and the dict"),
    (
        '"state": measured["state"]@"state": measured["state"][:12]',
        "measure gives 12 numbers for 'state'; 13 are needed",
    ),
)


def flown(folder, group, text, *words):
    """Exit code and errors of a short flight with a part of that text."""
    option(folder, group, "mine", "mine", text, "Mine")
    code, _, errors = run(
        "simulate", "--conf", folder, f"{group}=mine", *words, "--out", folder / "a.parquet", "--force"
    )
    return code, errors


def check(folder, group, text, mistake, *words):
    """mistake: changes of the text, FROM@TO, and then what is said of them, all in one line."""
    changes = [each for each in mistake if "@" in each]
    for change in changes:
        before, _, after = change.partition("@")
        assert before in text
        text = text.replace(before, after)
    code, errors = flown(folder, group, text, *words)
    said = [each for each in mistake if each not in changes]
    line = next(line for line in errors.splitlines() if line.startswith("error: "))
    assert code == 2 and all(each in line for each in said), errors
    assert "Traceback" not in errors and not (folder / "a.parquet").exists()


@pytest.mark.parametrize("mistake", LAW_MISTAKES, ids=lambda mistake: mistake[0][:30])
def test_of_a_law(mistake, tmp_path):
    check(tmp_path, "controller", LAW, mistake, *HOVER)


@pytest.mark.parametrize("mistake", LAYER_MISTAKES, ids=lambda mistake: mistake[0][:30])
@needs("laws")
def test_of_a_layer(mistake, tmp_path):
    check(tmp_path, "adaptive", LAYER, mistake, "controller=pid", *HOVER[:2])


@pytest.mark.parametrize("mistake", WIND_MISTAKES, ids=lambda mistake: mistake[0][:30])
def test_of_a_part_of_the_world(mistake, tmp_path):
    check(tmp_path, "wind", WIND, mistake, *HOVER)


@needs("laws")
def test_what_is_right_flies(tmp_path):
    assert flown(tmp_path / "law", "controller", LAW, *HOVER) == (0, "")
    assert flown(tmp_path / "layer", "adaptive", LAYER, "controller=pid", *HOVER[:2]) == (0, "")
    assert flown(tmp_path / "wind", "wind", WIND, *HOVER) == (0, "")
    kept = LAW.replace('stiff: float = key(4.0, "stiffness", "[0, 100]", "1/s^2")', 'k: dict = key({"z": 4.0}, "k")')
    assert flown(tmp_path / "dict", "controller", kept.replace("self.stiff", 'self.k["z"]'), *HOVER) == (0, "")
    of_this_program = LAW.replace("import Law", "import Law\nfrom quadexp.plugins.laws.geometric import Geometric")
    only_keys = f"{of_this_program.partition('class Mine')[0]}class Mine(Geometric):\n    pass\n"
    assert flown(tmp_path / "keys", "controller", only_keys, *HOVER[:2]) == (0, "")


def test_a_name_that_nothing_calls_is_said_unless_the_class_uses_it(tmp_path):
    code, errors = flown(tmp_path, "controller", LAW.replace("logged = ", "loged = "), *HOVER)
    assert code == 0 and errors == "note: mine.Mine: nothing calls loged; did you mean logged?\n"
    helped = LAW.replace("    def equations", "    def memories(self):\n        return 0\n\n    def equations")
    used = helped.replace("* height", "* (height + self.memories())")
    assert flown(tmp_path, "controller", used, *HOVER) == (0, "")


@needs("margins")
@pytest.mark.parametrize("factor", ["-1", "100"])
def test_a_loop_whose_rotors_are_at_their_limits_is_not_said_to_tolerate_anything(factor, tmp_path):
    """A law of the wrong sign, or in another unit, was said to tolerate over 500 ms of delay."""
    option(tmp_path, "controller", "mine", "mine", LAW.replace("thrusts, ", f"{factor} * thrusts, "), "Mine")
    flight = qx.simulate("controller=mine", *HOVER, conf=tmp_path)
    assert flight.record["margins"] == {"unknown": "the rotors follow no command, such as one beyond their limits"}


class TestMetric:
    def test_it_cannot_change_the_flight_that_is_stored(self, tmp_path):
        """`error = flight["p_z"]; error -= ..` changed the column, and the file had it."""
        text = METRIC.replace(
            "return np", 'height = flight["p_z"]\n        height -= flight["ref_p_z"]\n        return np'
        )
        folder = option(tmp_path / "lab", "metric", "offset", "offset_of_mine", text, "HeightError")
        words = ("simulate", "--conf", folder, "controller=nominal_mpc", *HOVER, "--out", tmp_path / "a.parquet")
        code, _, error = run(*words)
        assert (
            code == 2 and "metric=offset: of(flight): offset_of_mine.py, line 10: ValueError: output array is" in error
        )
        copied = text.replace('flight["p_z"]\n', 'flight["p_z"].copy()\n')
        (folder / "offset_of_mine.py").write_text(copied)
        assert run(*words)[0] == 0
        np.testing.assert_array_equal(qx.load(tmp_path / "a.parquet")["p_z"] > 0.5, True)

    @pytest.mark.parametrize("factor", ['"1e3"', "0", "None"])
    def test_its_unit_is_checked_before_anything_is_flown(self, factor, tmp_path):
        text = METRIC.replace("1e3", factor)
        folder = option(tmp_path / "lab", "metric", "bad", "bad_of_mine", text, "HeightError")
        code, _, error = run("evaluate", "--conf", folder, "evaluate.metric=bad", *HOVER, "--out", tmp_path / "r")
        assert (
            code == 2
            and "metric=bad: title 'height error', unit 'mm', factor" in error
            and not (tmp_path / "r").exists()
        )

    def test_one_that_is_infinite_is_no_number(self, tmp_path):
        text = METRIC.replace("return ", "return np.inf + ")
        folder = option(tmp_path / "lab", "metric", "far", "far_of_mine", text, "HeightError")
        words = ("evaluate", "--conf", folder, "controller=nominal_mpc", "evaluate.metric=far", "--no-figures")
        code, out, error = run(*words, *HOVER, "--out", tmp_path / "r")
        assert code == 0 and "far is no number in 1 of 1 completed flights" in out, error
