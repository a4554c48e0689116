"""The two families of controllers on both plants, as a table and as a figure.

Learned residuals (GP, linear drag) and identified physics (RLS on the blade-element model), with feedback and with MPC.
`perfect_mpc` and `oracle_feedback` know the plant and are the bounds of their kinds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from quadexp.report.ladder import means_by_place, means_figure, means_table
from quadexp.report.style import Figure

ORDER = (
    "nominal_mpc", "linear_drag_mpc", "gp_mpc", "rls_mpc", "perfect_mpc", "static_feedback", "rls_feedback",
    "oracle_feedback",
)  # fmt: skip
TITLE = (
    "Mean position error over the flight (mm), over seeds; bold: least error of a line over the flights that all ended"
    " well, significantly less than every other (corrected for the choice among them and for the lines), by a"
    " controller with no fewer flights; bounds are not ranked"
)

Row = Mapping[str, Any]


def families_table(rows: Sequence[Row]) -> str:
    """Markdown: mean position error (mm) by condition and controller; bold by the rule of report/winner.py."""
    return means_table(means_by_place(rows, "plant", ORDER), "plant", TITLE, bold=True).markdown()


def families_figure(rows: Sequence[Row]) -> Figure:
    """Mean position error over speed; a panel for each plant and trajectory."""
    return means_figure(means_by_place(rows, "plant", ORDER), "plant")
