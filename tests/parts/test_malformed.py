"""Overrides that are no overrides: each is one line, with none of the words of the libraries beneath."""

from __future__ import annotations

import random
import re

import pytest

from quadexp.errors import UsageError
from quadexp.parts.compose import session

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


def test_what_is_suggested_exists():
    """Each key that is named for another option composes with that option."""
    with session() as composer:
        for key, options in composer.having("velocity").items():
            for option in options:
                assert composer.compose([option, f"{key}=[1,0,0]"])
