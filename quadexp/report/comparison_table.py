"""Every contestant against the baseline, condition by condition, as a long table in Markdown and LaTeX."""

from __future__ import annotations

import math
from collections.abc import Sequence

from quadexp.report.metrics import SHOWN
from quadexp.report.statistics import Statistic
from quadexp.report.tables import TITLES, column_labels, escape, pipes, table_rows
from quadexp.report.wording import said_p, with_interval

NOTE = (
    "difference: contestant less baseline over the pairs; reduction: positive where better; effect: matched-pairs"
    " rank-biserial in [-1, 1]; p: paired permutation test, then corrected by Holm over {count} comparisons"
)


def _cells(statistics: Sequence[Statistic]) -> tuple[list[str], list[list[str]], str]:
    """Heading, rows of text, and the note below."""
    metric = statistics[0].metric
    factor, unit = SHOWN[metric]
    heading = ["trajectory", "speed (m/s)", "controller", "pairs", f"difference ({unit})"]
    heading += ["reduction (%)", "effect", "p", "p (Holm)", "left out"]
    rows = []
    for statistic, label in zip(statistics, column_labels(table_rows(statistics)), strict=True):
        if not statistic.baseline:
            continue
        difference, reduction = "-", "-"
        if statistic.pairs:
            values = (statistic.difference, statistic.difference_low, statistic.difference_high)
            difference = "".join(with_interval(*(factor * value for value in values)))
            reduction = "".join(with_interval(statistic.reduction, statistic.reduction_low, statistic.reduction_high))
        rows.append(
            [
                statistic.trajectory,
                "" if math.isnan(statistic.speed) else f"{statistic.speed:g}",
                label,
                str(statistic.pairs),
                difference,
                reduction,
                "-" if math.isnan(statistic.effect) else f"{statistic.effect:.2f}",
                said_p(statistic.p),
                said_p(statistic.p_holm),
                statistic.left_out or "-",
            ]
        )
    return heading, rows, NOTE.format(count=max((s.comparisons for s in statistics), default=0))


def _title(statistics: Sequence[Statistic]) -> str:
    baselines = dict.fromkeys(statistic.baseline for statistic in statistics if statistic.baseline)
    return f"{TITLES[statistics[0].metric]} against {', '.join(baselines)}"


def comparison_markdown(statistics: Sequence[Statistic]) -> str:
    """Of one metric's statistics; "" where nobody is compared."""
    heading, rows, note = _cells(statistics)
    if not rows:
        return ""
    rule = ["---" if name in ("trajectory", "controller", "left out") else "---:" for name in heading]
    return "\n".join([_title(statistics), "", *map(pipes, [heading, rule, *rows]), "", note, ""])


def comparison_latex(statistics: Sequence[Statistic]) -> str:
    """Of one metric's statistics; "" where nobody is compared."""
    heading, rows, note = _cells(statistics)
    if not rows:
        return ""
    lines = [rf"% {_title(statistics)}; needs \usepackage{{booktabs}}", f"% {note}"]
    lines += [r"\begin{tabular}{lrl" + "r" * (len(heading) - 4) + "l}", r"\toprule"]
    lines += [" & ".join(map(escape, heading)) + r" \\", r"\midrule"]
    lines += [" & ".join(map(escape, row)) + r" \\" for row in rows]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])
