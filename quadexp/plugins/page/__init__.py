"""Figures, HTML pages and moving pictures of flights and results."""

BRINGS = {
    "commands": {
        "table": "quadexp.plugins.page.commands:table",
        "plot": "quadexp.plugins.page.commands:plot",
        "report": "quadexp.plugins.page.commands:report",
        "compare": "quadexp.plugins.page.commands:compare",
        "animate": "quadexp.plugins.page.commands:animate",
    },
    "alternatives": {
        "results --html": "quadexp.plugins.page.commands:results_html",
        "evaluate --watch": "quadexp.plugins.page.commands:evaluate_watched",
    },
    "services": {
        "paper_texts": "quadexp.plugins.page.sweep_latex:paper_texts",
        "plot_results": "quadexp.plugins.page.draw:plot_results",
        "plot_flight": "quadexp.plugins.page.flight_figures:plot_flight",
        "sweep_figures": "quadexp.plugins.page.sweep_figures:SweepFigures",
    },
    "sections": {
        "numbers": "quadexp.plugins.page.report.sections:numbers_section",
        "swept": "quadexp.plugins.page.report.sections:swept_section",
        "worst": "quadexp.plugins.page.report.sections:worst_section",
        "origin": "quadexp.plugins.page.report.sections:origin_section",
    },
}
