"""Mistakes in a user's part: each is said in one line that names it, and nothing is flown.

Python and CasADi take most of these without a word: a misspelt hook does nothing, float of an expression is NaN.
"""

import json

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
STEP = """
from dataclasses import dataclass
import numpy as np
from quadexp.control.part import ControllerPart

@dataclass(frozen=True, kw_only=True)
class Mine(ControllerPart):
    def build(self, context):
        return Lifting(context.vehicle)

class Lifting:
    control_period, reference_period, node_times = 0.01, 0.0, np.zeros(1)
    residual, residual_name, source, backend = None, "none", "", "python"

    def __init__(self, vehicle):
        self.vehicle = vehicle

    def forget(self):
        pass

    def reset(self, x, window):
        pass

    def step(self, measurement, window):
        height = measurement.state[2] - window.position[0, 2]
        lift = self.vehicle.mass * (self.vehicle.gravity - 4.0 * height - 3.0 * measurement.state[9])
        return np.full(4, lift / 4)

    def log(self):
        return {}
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
    ("self.stiff * height@np.random.rand() * height", "import math@import numpy as np", "differ from call to call"),
    (
        "        height =@        CALLS.append(1)\n        height =",
        "self.stiff * height@len(CALLS) * height",
        "import math@CALLS = []",
        "equations of Mine: differ from call to call; let them follow from keys, inputs and memory alone",
    ),
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
    ('"blown"@"wind_x"', "wind=mine: columns: wind_x is a column of another part: choose another name"),
    ('"blown": 0@"blown": 1', "wind=mine: columns: blown is inner state 1, of 1 that it has, from 0"),
    ("(0.0,), ()@(0.0, 1.0), ()", "wind=mine: start gives [2, 0] numbers; 1 inner states and 0 parameters"),
    ("return (0.0,), ()@pass", "wind=mine: start gives [] numbers; 1 inner states"),
    ("return at.inner, @return ", "wind=mine: measure must return at.inner, as it is now, and the dict"),
    (
        '"state": measured["state"]@"state": measured["state"][:12]',
        "measure gives 12 numbers for 'state'; 13 are needed",
    ),
)


STEP_MISTAKES = (
    ("return np@np", "step of Lifting: gives None; 4 thrusts (N) are needed"),
    ("full(4@full(3", "step of Lifting: gives [2.45", "; 4 thrusts (N) are needed"),
    ("return np.full(4, lift / 4)@return 'up'", "step of Lifting: gives up; 4 thrusts (N) are needed"),
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


@pytest.mark.parametrize("mistake", STEP_MISTAKES, ids=lambda mistake: mistake[0][:30])
def test_of_a_step_in_python(mistake, tmp_path):
    check(tmp_path, "controller", STEP, mistake, *HOVER[:2], HOVER[-1])


def test_what_a_step_in_python_writes_into_is_its_own(tmp_path):
    """It moved the plant."""
    folder = option(tmp_path, "controller", "mine", "mine", STEP, "Mine")
    asked = ("controller=mine", *HOVER[:2], HOVER[-1])
    right = qx.simulate(*asked, conf=folder)
    writes = "        measurement.state[:] += 1.0\n        window.position[:] += 1.0\n        return np.full"
    option(folder, "controller", "mine", "mine", STEP.replace("        return np.full", writes), "Mine")
    for _ in range(2):
        np.testing.assert_array_equal(qx.simulate(*asked, conf=folder)["p_z"], right["p_z"])


def test_a_part_that_ends_python_is_an_error_and_one_that_prints_leaves_the_results(tmp_path):
    """The command ended with exit code 0, without a word and a file."""
    asked = (*HOVER[:2], HOVER[-1])
    code, errors = flown(
        tmp_path, "controller", STEP.replace("return np.full", "raise SystemExit(0)\n        "), *asked
    )
    assert code == 1 and errors.startswith("error: mine.py, line ") and "SystemExit: 0" in errors
    option(
        tmp_path,
        "controller",
        "mine",
        "mine",
        STEP.replace("return np.full", "print(1)\n        return np.full"),
        "Mine",
    )
    words = ("--conf", tmp_path, "controller=mine", *asked, "--json", "--force", "--out")
    for command in (("simulate", *words, tmp_path / "a.parquet"), ("evaluate", "--sweep", *words, tmp_path / "r")):
        code, out, errors = run(*command)
        assert code == 0 and json.loads(out), errors


def test_what_is_drawn_from_the_global_generator_is_the_flights_own(tmp_path):
    """Each flight had other noise, and its command could not make it again."""
    drawn = STEP.replace("lift / 4)", "lift / 4) + 0.01 * np.random.randn(4)")
    folder = option(tmp_path, "controller", "mine", "mine", drawn, "Mine")
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    asked = ("controller=mine", *HOVER[:2], HOVER[-1])
    one, same, other = (qx.simulate(*asked, f"seed={seed}", conf=folder)["u_0"].to_numpy() for seed in (0, 0, 1))
    assert (one == same).all() and not (one == other).any()
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


PLANT = """
from dataclasses import dataclass
import numpy as np
from quadexp.models.linear_drag import linear_drag_residual
from quadexp.world.base import PlantPart

@dataclass(frozen=True, kw_only=True)
class Mine(PlantPart):
    def build(self, context):
        return Standing(context.vehicle)

class Standing:
    def __init__(self, vehicle):
        self.vehicle = vehicle

    def reset(self):
        pass

    def advance(self, x, u, duration, rng):
        return x, np.array([0.0, 0.0, 9.81])

    def residual(self):
        return linear_drag_residual(self.vehicle, (0.0, 0.0, 0.0), source="mine")
"""
PLANT_MISTAKES = (("return x, @return x[:12], ", "state: (12,) numbers are given, (13,) are needed"),)


@pytest.mark.parametrize("mistake", PLANT_MISTAKES, ids=lambda mistake: mistake[0][:30])
def test_of_a_plant(mistake, tmp_path):
    check(tmp_path, "plant", PLANT, mistake, *HOVER[:-1])


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
