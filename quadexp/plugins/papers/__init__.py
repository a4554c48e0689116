"""What single publications and experiments draw of a sweep (quadexp/report/paper.py), and what they flew."""

BRINGS = {
    "parts": {
        "ellipse": "quadexp.plugins.papers.ellipse",
        "plant": "quadexp.plugins.papers.lei_li.plant",
        "feedback": "quadexp.plugins.papers.lei_li.feedback",
        "rls_mpc": "quadexp.plugins.papers.lei_li.rls_mpc",
        "paths": "quadexp.plugins.papers.lei_li.paths",
    },
    "modules": {"quadexp.reference.ellipse": "quadexp.plugins.papers.ellipse"},
    "columns": {"lei_li": "quadexp.plugins.papers.lei_li.columns:COLUMNS"},
    "papers": {
        "adaptation": "quadexp.plugins.papers.adaptation",
        "families": "quadexp.plugins.papers.families",
        "ladder": "quadexp.plugins.papers.ladder",
        "lei_li": "quadexp.plugins.papers.lei_li.report",
        "sun": "quadexp.plugins.papers.sun",
    },
}
