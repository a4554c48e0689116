"""A page of headings, sentences and tables that opens without a network, in light and dark, on a phone and in print."""

from __future__ import annotations

from quadexp.messages import html
from quadexp.report.table import Table

STYLE = """
:root{color-scheme:light dark;font:16px/1.5 system-ui,sans-serif}
body{max-width:76rem;margin:0 auto;padding:1.2rem}h1{font-size:1.4rem;overflow-wrap:anywhere}
h2{font-size:1.15rem;margin-top:2rem}p{max-width:80ch}progress{width:100%}.scroll{overflow-x:auto;margin:1rem 0}
table{border-collapse:collapse;font-variant-numeric:tabular-nums}caption{text-align:left;font-weight:600}
th,td{padding:.25rem .7rem;border-bottom:1px solid #8888;white-space:nowrap}
@media print{tr{break-inside:avoid}}
"""


def plain_page(title: str, body: str, head: str = "") -> str:
    """The page. title: plain text. body, head: HTML."""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">{head}
<link rel="icon" href="data:,"><title>{html(title)}</title><style>{STYLE}</style></head>
<body><main><h1>{html(title)}</h1>
{body}
</main></body></html>
"""


def paragraph(text: str) -> str:
    """A sentence, as plain text."""
    return f"<p>{html(text)}</p>"


def scrolled(table: Table) -> str:
    """A table that may be wider than the page."""
    return f'<div class="scroll">{table.html()}</div>'
