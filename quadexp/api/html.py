"""How notebooks show what the API returns, without colours of its own: dark and light themes both apply."""

from __future__ import annotations

import functools
import io
from collections.abc import Iterable
from html import escape
from typing import Any

from quadexp.messages import clean


def safe(text: object) -> str:
    """Text for HTML, without control characters."""
    return escape(clean(str(text)))


def preformatted(lines: Iterable[str]) -> str:
    return f"<pre>{safe(chr(10).join(lines))}</pre>"


def displayed(figure: Any) -> Any:
    """The figure, shown by notebooks also where matplotlib.pyplot is not in use."""
    figure._repr_png_ = functools.partial(_png, figure)
    return figure


def _png(figure: Any) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=72, bbox_inches="tight")
    return stream.getvalue()
