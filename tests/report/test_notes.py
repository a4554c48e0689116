"""Notes on rows: what their columns say, where they are, and nothing where they are not."""

import math

from quadexp.report.notes import notes
from tests.deleted import needs
from tests.report.test_tables import row


def test_plain_rows_have_no_notes():
    assert notes([row(seed=s) for s in range(3)]) == []
    assert notes([row() | {"outside_data": math.nan, "reference_residual": None, "program": ""}]) == []


def test_samples_outside_the_data_of_a_learned_model():
    rows = [row("gp_mpc", speed=v) | {"outside_data": share} for v, share in ((4.0, 0.0), (8.0, 0.06), (18.0, 0.3))]
    rows[-1]["outside_where"] = "4 to 7 s"
    rows += [row("nominal_mpc", speed=v) | {"outside_data": math.nan} for v in (4.0, 8.0, 18.0)]
    assert notes(rows) == [
        "gp_mpc: 12 % of samples outside the data its model was fitted to (most: 30 %, circle 18 m/s; longest 4 to 7 s)"
    ]
    assert notes([row("gp_mpc") | {"outside_data": 0.0}]) == []


def test_references_without_all_of_the_residual():
    values = [1.0] * 15 + [0.5] * 3 + [0.0] * 2
    rows = [row("gp_mpc", seed=s) | {"reference_residual": v} for s, v in enumerate(values)]
    assert notes(rows) == [
        "gp_mpc: 3 of 20 references contain the residual only in part, 2 of 20 references do not contain the residual"
    ]


def test_large_heading_errors_of_completed_flights():
    """And not of the tilt, which wind and drag demand: a position error shows one that they do not."""
    rows = [
        row("static_feedback", seed=s) | {"heading_rmse": math.radians(a)} for s, a in enumerate((2, 9.9, 11, 51.5))
    ]
    rows.append(row("static_feedback", seed=4, outcome="lost") | {"heading_rmse": math.radians(170)})
    rows.append(row("static_feedback", seed=5, attitude_rmse=math.radians(47)) | {"heading_rmse": None})
    assert notes(rows) == [
        "static_feedback: heading error above 10 degrees in 2 of 4 flights (most: 51.5 degrees, circle 8 m/s)"
    ]


def test_several_versions_of_the_program():
    rows = [row(seed=s) | {"program": "1.0" if s < 2 else "1.1", "sources": "aa"} for s in range(5)]
    assert notes(rows) == [
        "flights of 2 programs stand side by side: 3 by quadexp 1.1, sources aa; 2 by quadexp 1.0, sources aa"
    ]


@needs("auto")
def test_commands_that_change_far_more_with_auto_are_named():
    """A13: three to four times in the median, and nobody was given."""

    def pairs(factor):
        alone = [row("geometric", seed=s) | {"command_change": 0.02, "charge_used": 0.1} for s in range(3)]
        auto = [
            {**one, "command_change": factor * 0.02, "charge_used": 0.15, "variant": "remedies=auto"} for one in alone
        ]
        return [*({**one, "variant": "remedies=none"} for one in alone), *auto]

    assert notes(pairs(1.9)) == []
    swept = [one | {"controller": "geometric" + "+auto" * (one["variant"][-4:] == "auto")} for one in pairs(3.4)]
    (line,) = notes([one | {"variant": ""} for one in swept])  # as a sweep over remedies names them
    assert line.startswith("geometric+auto: commands change 3.4 times as much as of geometric,")
    (line,) = notes(pairs(3.4))
    assert line.startswith("geometric remedies=auto: commands change 3.4 times as much as of geometric remedies=none")
    assert line.endswith("in the median of 3 pairs")
