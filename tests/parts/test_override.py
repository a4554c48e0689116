"""Plain overrides are read without Hydra, and as Hydra reads them."""

from __future__ import annotations

from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given, settings
from hypothesis import strategies as st

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
