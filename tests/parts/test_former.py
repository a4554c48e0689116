"""Names of the release before: read, said once, and with the same hashes."""

import importlib

import pytest

from quadexp.experiment.identity import flight_identity
from quadexp.parts import former
from quadexp.parts.compose import compose
from quadexp.sweeps.plan import cell_key
from tests.deleted import needs


@pytest.fixture(autouse=True)
def unsaid():
    former.said.cache_clear()


@needs("remedies", "laws")
def test_the_group_of_the_rate_loop(capsys):
    old = compose(["controller=dfbc", "inner=indi", "inner.cutoff=8"])
    assert "inner: is called rate_loop now" in capsys.readouterr().err
    new = compose(["controller=dfbc", "rate_loop=indi", "rate_loop.cutoff=8"])
    assert capsys.readouterr().err == ""
    assert old == new and old.rate_loop.cutoff == 8


def test_hashes_have_the_group_that_stored_cells_have():
    identity = flight_identity(compose(["controller=dfbc", "rate_loop=indi"]))
    stored = {("inner" if key == "rate_loop" else key): value for key, value in identity.record.items()}
    assert "rate_loop" in identity.record and former.now(stored) == identity.record
    assert cell_key(identity.record, identity.inputs) == cell_key(stored, identity.inputs)


@needs("remedies")
def test_what_an_option_brings():
    assert former.setting("controller=pid,dfbc inner=indi inner.cutoff=8") == (
        "controller=pid,dfbc rate_loop=indi rate_loop.cutoff=8"
    )


@pytest.mark.parametrize("old", former.MODULES)
def test_modules(old, capsys):
    module, new = importlib.import_module(old), importlib.import_module(former.MODULES[old])
    assert module is new and new.__name__ == former.MODULES[old]


@pytest.mark.parametrize(("module", "old"), [(m, old) for m, names in former.NAMES.items() for old in names])
def test_names(module, old, capsys):
    home, _, new = former.NAMES[module][old].partition(":")
    assert getattr(importlib.import_module(module), old) is getattr(importlib.import_module(home), new)
    assert f"{old}: is called {new} now" in capsys.readouterr().err
