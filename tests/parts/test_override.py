"""Overrides: what is plain is read without Hydra, as Hydra reads it; what is none is one line in plain words."""

import random
import re

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given, settings
from hypothesis import strategies as st

from quadexp.errors import UsageError
from quadexp.parts.compose import compose, expand, session
from quadexp.parts.override import plain_override

WORDS = [
    "circle", "gp_mpc", "models/gp", "a.b", "v1.2", "a-b", "TRUE", "False", "null", "None", "NaN", "Inf", "-inf", "e5",
    "0", "-0", "00", "7", "-12", "+3", "1_000", "0.10", "-0.0", "2.50", "1.", ".5", "1e3", "1e-3", "12.30", "1a", "./a",
    "../a", "a/", "a b", "", "range(3)", "range(1,4)", "range(2, 5)", "range(5,2)", "range(0,1,0.5)", "[1,2]", "'a'",
    "glob(*)", "${seed}", "{a: 1}", "123456789012345678901", "a:b", "x=y",
]  # fmt: skip
value = st.sampled_from(WORDS) | st.text("aeZ019_./-+ ,()nulltrueinf", min_size=1, max_size=6)
texts = st.builds(
    lambda key, values: f"{key}={','.join(values)}",
    st.sampled_from(["seed", "trajectory.speed", "a._target_", "x.Y.z1"]),
    st.lists(value, min_size=1, max_size=3),
)


@settings(max_examples=400, deadline=None)
@given(texts)
def test_what_is_plain_means_the_same_to_hydra(text):
    found = plain_override(text)
    if found is None:
        return
    override = OverridesParser.create().parse_override(text)  # it may not refuse what is read here
    assert override.key_or_group == found.key and override.package is None
    assert not (override.is_add() or override.is_force_add() or override.is_delete())
    if found.sweep is not None:
        assert override.is_discrete_sweep()
        assert list(map(str, override.sweep_string_iterator())) == list(map(str, found.sweep))
    else:
        assert not override.is_sweep_override()
        assert type(override.value()) is type(found.value) and override.value() == found.value
        assert found.text == f"{found.key}={override.get_value_element_as_str()}"


KEYS = (
    "trajectory.speed", "seed", "controller", "controller.nodes", "model", "vehicle.inertia", "gp.features.a_x",
    "trajectory", "experiment", "plant.linear_drag", "x", "", "trajectory.", "a b", "é", "trajectory@x", "+seed",
    "~seed", "++trajectory.speed", "hydra.run", "wind.path", "evaluate", "vehicle", "sweep", "world", "collect.mode",
)  # fmt: skip
PIECES = (
    "'", '"', "[", "]", "{", "}", "(", ")", ",", "=", ":", "$", "${", "${seed}", "${oc.env:HOME}", "${nope}", "${.}",
    "${..x}", "${a:b}", "é", "飛", "\u200b", "\\", "\n", "\t", " ", "", "null", "nan", "1e999", "-", "???", "range(1)",
    "range(", "choice(1,2)", "glob(*)", "glob([", "interval(1,2)", "sort(1)", "shuffle(2)", "int(x)", "float(1)", "8",
    "1_000", "0x1", "circle", "true", "@", "/", "../x", "!", "#", "%", "*", "~", "\0", "{a:1}", "[1,2", "'a", "a'",
    "dict(a=1)", "9" * 400, "1" * 5000,
)  # fmt: skip
LIBRARIES = re.compile(
    r"antlr|omegaconf|mismatched|extraneous|token recognition|no viable|Config(Key|Attribute)|interpolation|full_key"
    r"|object_type|Traceback|\n",
    re.IGNORECASE,
)


@pytest.mark.parametrize("seed", range(2))
def test_any_text_is_an_override_or_one_plain_line(seed):
    rng, refused = random.Random(seed), 0
    with session() as composer:
        for _ in range(120):
            value = "".join(rng.choice(PIECES) for _ in range(rng.randint(0, 4)))
            text = f"{rng.choice(KEYS)}={value}" if rng.random() < 0.95 else value
            for use in (composer.compose, composer.expand):
                try:
                    use([text])
                except UsageError as error:
                    own = str(error).replace(repr(text), "").replace(text, "").replace(value or text, "")
                    assert not LIBRARIES.search(own), (text, str(error))
                    refused += 1
    assert refused > 75  # the texts are mostly wrong, and some are right
    assert refused < 240


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        (["seed=range(1e9)"], "'seed=range(1e9)': 1000000000 values; a sweep has at most 1000000 cells"),
        (["seed=range(2000000)"], "'seed=range(2000000)': 2000000 values; a sweep has at most 1000000 cells"),
        (["seed=shuffle(range(3e6))"], "'seed=shuffle(range(3e6))': 3000000 values; a sweep has at most 1000000 cells"),
        (["trajectory.speed=range(0,9,1e-7)"], "90000000 values; a sweep has at most 1000000 cells"),
        (["seed=range(1001)", "trajectory.speed=range(1,2,.001)"], "1001000 combinations; a sweep has at most 1000000"),
        (["seed=range(0,3,0)"], "'seed=range(0,3,0)': a range has a finite start and stop, and a step other than 0"),
        (["seed=range(0,3,0.0)"], "a range has a finite start and stop, and a step other than 0"),
        (["seed=range(nan,3)"], "a range has a finite start and stop, and a step other than 0"),
        (["seed=range(0,inf)"], "a range has a finite start and stop, and a step other than 0"),
    ],
)
def test_a_range_that_no_memory_holds_or_that_has_no_end_is_refused(texts, said):
    with session() as composer, pytest.raises(UsageError) as error:
        composer.expand(texts, check=False)
    assert said in str(error.value)


def test_what_is_suggested_exists():
    """Each key that is named for another option composes with that option."""
    with session() as composer:
        for key, options in composer._files.having("velocity").items():
            for option in options:
                assert composer.compose([option, f"{key}=[1,0,0]"])


TEXTS = {
    "2024_01,'a b',1e3,1.10": ["2024_01", "a b", "1e3", "1.10"],
    "'1,0' , 1_0": ["1,0", "1_0"],
    "'it\\'s (a)',1_0": ["it's (a)", "1_0"],
}


@pytest.mark.parametrize("values", TEXTS)
def test_texts_beside_a_quoted_one_stay_what_they_are(values):
    """2024_01 was 202401, and 1e3 1000.0, where another one of the values had quotes."""
    cells = expand([f"controller.name={values}"])
    assert [cell.config.controller.name for cell in cells] == TEXTS[values]
    assert compose([f"controller.models=[{values}]"]).controller.models == tuple(TEXTS[values])
