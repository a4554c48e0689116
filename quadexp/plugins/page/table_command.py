"""`quadexp table`: a table of a sweep for a paper. Only light modules are imported at the top."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from quadexp.cli.command import Answer, Ask, Force, OptionalOut, command
from quadexp.errors import UsageError
from quadexp.writer import check_output, write_text

HEADING = "Look"

Keys = tuple[str, ...]


@command
def table(
    results: Annotated[Path, Ask("A folder of `quadexp evaluate`.", "DIR")],
    rows: Annotated[Keys, Ask("Keys down, commas between; repeatable.", "KEYS")] = (),
    columns: Annotated[Keys, Ask("Keys across, commas between; repeatable.", "KEYS")] = (),
    metric: Annotated[str | None, Ask("A number of the flights, such as rmse; or success.", "NAME")] = None,
    label: Annotated[Keys, Ask("A text of your own for a key, a value or the metric; repeatable.", "KEY=TEXT")] = (),
    where: Annotated[str | None, Ask("Only these flights, such as 'speed > 6'.", "CONDITION")] = None,
    intervals: Annotated[Literal["none", "pm", "brackets"], Ask("How an interval is written.")] = "none",
    digits: Annotated[int | None, Ask("Significant digits of a mean.", "N", least=1)] = None,
    width: Annotated[Literal["column", "page"], Ask("What LaTeX fits: 252 or 516 pt of the IEEE.")] = "column",
    out: OptionalOut = None,
    force: Force = False,
    form: str = "text",
) -> Answer:
    """Print or write a table for a paper: any keys down and across, one metric.

    Without keys, conditions are down and controllers across. A cell is the mean over the common flights, as in every
    table and figure; k/n: only k of n flights were completed. LaTeX of a table that is too wide or too long is several
    tabulars below each other. The suffix of --out (tex, md, csv) chooses the format where --format does not.

    \b
    quadexp table results/x --format latex
    quadexp table results/x --rows trajectory,speed --columns controller --intervals pm --digits 3 --out table.tex
    quadexp table results/x --metric rmse --label gp_mpc="GP (ours)" --width page --out table.md
    """
    from quadexp.plugins.page.paper_table import paper_table
    from quadexp.plugins.page.view import SUCCESS
    from quadexp.report.fitted import WIDTHS, fitted_latex
    from quadexp.report.frame import SweepFrame, chosen, is_metric

    names = dict(text.partition("=")[::2] for text in label)
    for name, text in names.items():
        if not text:
            raise UsageError(f"--label {name}: give KEY=TEXT")
    suffixes = {".tex": "latex", ".md": "markdown", ".csv": "csv"}
    if out is not None:
        out = check_output(out, force=force)
        form = suffixes.get(out.suffix, "") if form == "text" else form
        if form not in suffixes.values():
            raise UsageError(f"--out {out}: end it in .tex, .md or .csv, or give --format latex, markdown or csv")
    frame = SweepFrame.read(results)
    if where:
        frame = frame.where(chosen(frame, where))
        if not frame.rows:
            raise UsageError(f"--where {where!r}: no flight fulfils it")
    metric = metric or str(frame.record.get("metric", "mean_error"))
    if metric != SUCCESS and not (is_metric(metric) and metric in frame.names):
        known = [*filter(is_metric, frame.names), SUCCESS]
        raise UsageError(f"--metric {metric}: no number of a flight{_suggestion(metric, known)}")
    rendered = paper_table(
        frame, metric, rows=_keys(rows), columns=_keys(columns), names=names, intervals=intervals, digits=digits
    )
    latex = fitted_latex(rendered, WIDTHS[width])
    record = {"columns": rendered.columns, "rows": rendered.rows, "title": rendered.title, "notes": rendered.notes}
    if out is None:
        return Answer(record, [rendered], [rendered], texts={"latex": lambda: latex})
    write_text(out, latex if form == "latex" else rendered.rendered(form), force=force)
    return Answer(record | {"path": out}, [rendered], [out], notes=rendered.notes)


def _suggestion(name: str, known: list[str]) -> str:
    from quadexp.messages import suggestion

    return suggestion(name, known)


def _keys(words: Keys) -> list[str] | None:
    """Keys of an option that is repeatable, also with commas between; None where there are none."""
    return [key.strip() for text in words for key in text.split(",") if key.strip()] or None
