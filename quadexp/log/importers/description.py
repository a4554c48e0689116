"""A proposed mapping as a whole, and as YAML with the evidence behind every line."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from quadexp.log.importers.proposal import Proposal


@dataclass
class Description:
    """fields: top key -> (value as YAML, confidence, why). warnings: what a user has to know."""

    path: Path
    fields: dict[str, Proposal]
    warnings: list[str] = field(default_factory=list)
    format: str = "text"

    def yaml(self) -> str:
        """The mapping, as `--mapping` takes it, with the confidence behind every line."""
        lines = [
            f"# {self.path.name}: proposed by `quadexp import --describe`; check what is not sure.",
            f"format: {self.format}",
        ]
        for key, made in self.fields.items():
            lines += [f"# {key}: {made.sureness} ({made.confidence:.0%}): {made.why}", f"{key}: {flow(made.value)}"]
        return "\n".join([*lines, *(f"# note: {text}" for text in self.warnings), ""])

    def record(self) -> dict[str, Any]:
        return {
            "path": self.path,
            "mapping": {"format": self.format, **{key: made.value for key, made in self.fields.items()}},
            "fields": {
                key: {"confidence": made.confidence, "sureness": made.sureness, "why": made.why}
                for key, made in self.fields.items()
            },
            "warnings": self.warnings,
        }


def flow(value: Any) -> str:
    """A value as YAML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {flow(item)}" for key, item in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(flow, value)) + "]"
    if isinstance(value, str):
        plain = value and all(c.isalnum() or c in "_./^" for c in value) and not value[0].isdigit()
        words = ("y", "n", "yes", "no", "on", "off", "true", "false", "null")
        return (
            value
            if plain and value.lower() not in words
            else '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
        )
    return f"{value:.10g}" if isinstance(value, float) else str(value)
