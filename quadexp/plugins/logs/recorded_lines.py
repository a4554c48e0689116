"""What `quadexp show` says of a recorded flight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np


def recorded_lines(record: Mapping[str, Any], columns: Mapping[str, np.ndarray], summary: dict[str, Any]) -> list[str]:
    """The source of a recorded flight, and the findings of the quality check."""
    source = record.get("source", {})
    findings = record.get("findings", [])
    t = columns["t"]
    summary |= {"source": record.get("source"), "findings": findings}
    rate = source.get("rate")
    hertz = f" at {rate:.4g} Hz" if isinstance(rate, (int, float)) else ""
    seconds = float(t[-1] - t[0]) if len(t) else 0.0
    lines = [f"recorded    {source.get('file')} ({source.get('format')}), {seconds:.1f} s{hertz}"]
    velocity = [columns[name] for name in ("v_x", "v_y", "v_z") if name in columns]
    if len(velocity) == 3 and len(t):
        lines.append(f"peak speed  {np.linalg.norm(velocity, axis=0).max():.2f} m/s")
    return lines + [f"finding     {finding['message']}" for finding in findings]
