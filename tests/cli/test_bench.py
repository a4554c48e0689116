"""`quadexp bench` as a user meets it: wrong requests are one line, before anything is flown."""

from types import SimpleNamespace

import pytest

from quadexp.cli.fly import _controllers
from tests.cli.command import run


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trajectory=circle"], "what is flown is the protocol's"),
        (["--only"], "nobody takes part"),
        (["--controller", "nominal_mcp"], "no such controller; did you mean nominal_mpc"),
        (["--add", "nothing.parquet"], "no such file (made by `quadexp bench`)"),
        (["--conf", "nowhere"], "no such folder"),
    ],
)
def test_wrong_requests_are_one_line(here, words, message):
    code, out, err = run("bench", *words)
    assert code == 2 and out == "" and err.startswith("error: ") and err.count("\n") == 1 and message in err, err


def test_controllers_are_completed():
    assert _controllers(SimpleNamespace(params={"conf": None}), "gp_") == ["gp_mpc", "gp_mpc_tuned"]
