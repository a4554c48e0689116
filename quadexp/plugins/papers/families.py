"""Both families of controllers, MPC and Lei & Li's feedback, on both plants: a table and a figure."""

from __future__ import annotations

from pathlib import Path

from quadexp.plugins.papers.ladder import means_by_place, means_figure, means_table
from quadexp.plugins.papers.lei_li.report import without_corridor
from quadexp.report.pairing import Rows
from quadexp.report.paper import Drawn

ORDER = (  # learned residuals and identified physics, with MPC and with feedback; perfect and oracle are bounds
    "nominal_mpc",
    "linear_drag_mpc",
    "gp_mpc",
    "rls_mpc",
    "perfect_mpc",
    "static_feedback",
    "rls_feedback",
    "oracle_feedback",
)
TITLE = (
    "Mean position error over the flight (mm), over seeds; bold: least error of a line over the flights that all ended"
    " well, significantly less than every other (corrected for the choice among them and for the lines), by a"
    " controller with no fewer flights; oracles are not ranked"
)


def draw(rows: Rows, out: Path) -> Drawn:
    """Means by condition and controller; bold by the rule of report/winner.py."""
    means = means_by_place(without_corridor(rows), "plant", ORDER)
    return {"families": means_table(means, TITLE, bold=True).markdown()}, {"families": means_figure(means)}
