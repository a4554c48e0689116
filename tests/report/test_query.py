"""Conditions on flights: each is compared with a Python expression; none is ever run as code."""

import pytest

from quadexp.errors import UsageError
from quadexp.report.condition import chosen
from quadexp.report.frame import SweepFrame

NAMES = ("nominal_mpc", "gp_mpc", "perfect_mpc")


@pytest.fixture(scope="module")
def frame(tmp_path_factory):
    """Twelve rows without files: names, speeds (one missing), an error, a swept key."""
    rows = []
    for i in range(12):
        row = {"controller": NAMES[i % 3], "trajectory": "circle", "speed": None if i == 11 else 4.0 * (1 + i // 4)}
        row |= {
            "plant": "simplified",
            "vehicle": "torrente",
            "model": "",
            "seed": i // 6,
            "outcome": "ok" if i else "lost",
        }
        row |= {"mean_error": 0.001 * i, "variant": f"controller.nodes={5 * (1 + i % 2)}", "key": str(i), "cause": ""}
        rows.append(row)
    return SweepFrame(rows, tmp_path_factory.mktemp("none"))


@pytest.mark.parametrize(
    ("condition", "holds"),
    [
        ("controller == gp_mpc and speed > 6", lambda r: r["controller"] == "gp_mpc" and (r["speed"] or 0) > 6),
        ("controller = 'gp_mpc' && speed >= 8", lambda r: r["controller"] == "gp_mpc" and (r["speed"] or 0) >= 8),
        ("4 < speed <= 8", lambda r: r["speed"] == 8),
        ("speed in [4, 12]", lambda r: r["speed"] in (4, 12)),
        ("trajectory.speed not in (4, 12)", lambda r: r["speed"] not in (4, 12)),
        ("mean_error == 5 mm OR mean_error = 7", lambda r: round(1e3 * r["mean_error"]) in (5, 7)),
        ("2 < mean_error <= 0.005 m and speed < 9", lambda r: r["mean_error"] in (0.003, 0.004, 0.005)),
        ("seed == 1 and (mean_error in (6, 8) or speed < 5)", lambda r: r["mean_error"] in (0.006, 0.008)),
        ("controller.nodes == 10", lambda r: r["variant"].endswith("=10")),
        ("outcome != ok", lambda r: r["outcome"] != "ok"),
        ("seed == 0 or seed == 1 and speed == 8", lambda r: r["seed"] == 0 or (r["seed"] == 1 and r["speed"] == 8)),
        ("speed != 4", lambda r: r["speed"] != 4),  # a missing value differs from all, as in pandas
        ("speed < -1", lambda r: False),
        ("gp_mpc == controller", lambda r: r["controller"] == "gp_mpc"),
    ],
)
def test_conditions(frame, condition, holds):
    assert chosen(frame, condition) == [holds(row) for row in frame.rows]


@pytest.mark.parametrize(
    ("condition", "said"),
    [
        ("sped > 6", "--where: sped: no such key or column; did you mean speed"),
        ("controler == gp_mpc", "--where: controler: no such key or column; did you mean controller"),
        ("speed > sped", "--where: sped: no such key"),
        ("speed >", "cannot be read: invalid syntax"),
        ("speed", "a comparison such as"),
        ("(speed > 4", "cannot be read"),
        ("speed > 4 controller", "cannot be read: invalid syntax"),
        ("speed in 4", "cannot be read: only list-like"),
        ("controller like 'gp_*'", "cannot be read: invalid syntax"),  # which KEY=VALUE has
        ("", "cannot be read"),
        ("__import__('os').system('true')", "cannot be read"),
        ("speed(4) > 1", "cannot be read"),
        ("speed.__class__ == 1", "no such key"),
        ("@pd.io > 4", "cannot be read"),
        ("(" * 300 + "speed > 4" + ")" * 300, "cannot be read"),
        ("speed > 4; import os", "cannot be read"),
    ],
)
def test_what_cannot_be_read_is_one_line(frame, condition, said):
    with pytest.raises(UsageError, match=said) as caught:
        chosen(frame, condition)
    assert "\n" not in str(caught.value) and caught.value.exit_code == 2
